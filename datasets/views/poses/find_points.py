"""Sparse points of photographs whose cameras are known, triangulated by pycolmap."""

from __future__ import annotations

import shutil
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ....neural_fields import InputError
from ....neural_fields.backend.files import files_in
from ..images import find_source, read_posed_images, read_shots
from ..writing import write_colmap
from .colmap_process import (
    DATABASE_FILE,
    MATCHING,
    Found,
    Report,
    begun,
    check_colmap,
    extract_features,
    fingerprint,
    new_model,
    solve,
    verification_options,
    write_record,
)

TRIANGULATING = "triangulating"
MATCHED_VIEWS = 20  # views that each is matched with: those with the nearest directions from the region
GIVEN, PAIRS_FILE = "given", "pairs.txt"  # input of COLMAP: a model with cameras and no points, and pairs of views


def find_points(source: str | Path, project: str | Path, *, report: Report | None = None) -> Found:
    """Triangulate sparse points from photographs with fixed cameras, as `read_posed_images` takes them.

    The project is a COLMAP model in the same world coordinates: photographs without lens distortion, masks as
    transparency, depth maps, the given cameras, and points with their observations. Each photograph is matched with the
    twenty whose directions from the region are nearest. The same call continues an interrupted project, and returns the
    result of a finished one at once.

    Raises:
        InputError: the photographs cannot be read, the project is of something else, or no two photographs match.
    """
    source, project = find_source(source), Path(project)
    shots = [shot for shot in read_shots(source) if shot.placed is not None]
    check_colmap()
    files = [file for shot in shots for file in (shot.image, shot.mask, shot.depth) if file is not None]
    files += [source] if source.is_file() else files_in(source, (".bin", ".txt"))
    asked = {"source": str(source.resolve()), "content": fingerprint([file for file in files if file.is_file()])}
    if (found := begun(project, asked)) is not None:
        return found
    report = report or (lambda stage, done, total: None)
    if not (project / GIVEN).is_dir():
        _write_given(source, project)
    pairs = (project / PAIRS_FILE).read_text(encoding="utf-8").count("\n")
    made = solve(project, _triangulated, photographs=len(shots), pairs=pairs, report=report)
    found = Found(project, len(shots), **made)
    write_record(project, asked, found)
    return found


def _write_given(source: Path, project: Path) -> None:
    """Write the input of COLMAP: photographs, cameras and pairs; the folder of the cameras appears last."""
    images = read_posed_images(source)
    half = project / ".half"
    shutil.rmtree(half, ignore_errors=True)
    write_colmap(half, images)
    names = sorted(file.name for file in (half / "images").iterdir())  # in the order of the views
    eyes = torch.stack([view.camera.eye for view in images.views]).numpy()
    pairs = neighbours(eyes - np.array(images.similarity.center))
    (project / PAIRS_FILE).write_text("".join(f"{names[a]} {names[b]}\n" for a, b in pairs), encoding="utf-8")
    for name in ("images", "depths"):
        if (half / name).is_dir():
            shutil.rmtree(project / name, ignore_errors=True)
            (half / name).replace(project / name)
    (half / "sparse" / "0").replace(project / GIVEN)
    shutil.rmtree(half)


def neighbours(away: NDArray[np.float64], nearest: int = MATCHED_VIEWS) -> list[tuple[int, int]]:
    """Sorted pairs of views: each with the ``nearest`` views in direction from the region, the smaller number first.

    ``away`` ``(V, 3)`` is from the middle of the region to the eyes.
    """
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    cosine = directions @ directions.T
    np.fill_diagonal(cosine, -2)  # no view is paired with itself
    order = np.argsort(-cosine, axis=1, kind="stable")[:, : min(nearest, len(away) - 1)]
    rows = np.repeat(np.arange(len(away)), order.shape[1])
    both = np.sort(np.column_stack((rows, order.reshape(-1))), axis=1)
    return [(int(a), int(b)) for a, b in np.unique(both, axis=0)]


def _triangulated(project: Path, told: Connection) -> dict[str, Any]:
    """The job of `solve`."""
    import pycolmap

    database, images = project / DATABASE_FILE, project / "images"
    extract_features(project, told, one=False)
    told.send(("stage", (MATCHING, 0)))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = project / PAIRS_FILE
    pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification_options())
    told.send(("stage", (TRIANGULATING, 0)))
    model = _with_numbers_of(database, pycolmap.Reconstruction(project / GIVEN))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    with new_model(project) as folder:
        model = pycolmap.triangulate_points(model, database, images, folder, options=options)
        if not model.num_points3D():
            raise InputError(
                "no two photographs show the same thing in the same place: the cameras may be wrong (see `mplicits "
                "check-cameras`), or there is nothing with texture"
            )
    return {"points": model.num_points3D(), "error": model.compute_mean_reprojection_error()}


def _with_numbers_of(path: Path, given: Any) -> Any:
    """A model with the cameras and poses of ``given``, and the numbers that a database has for images and cameras.

    The cameras that the database has guessed from the pictures are replaced.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    known = {image.name: image for image in given.images.values()}
    with pycolmap.Database.open(path) as database:
        for entry in database.read_all_images():
            image = known[entry.name]
            camera = given.cameras[image.camera_id]
            camera.camera_id = entry.camera_id
            database.update_camera(camera)
            model.add_camera_with_trivial_rig(camera)
            placed = pycolmap.Image(name=entry.name, camera_id=entry.camera_id, image_id=entry.image_id)
            model.add_image_with_trivial_frame(placed, image.cam_from_world())
    return model
