"""Sparse points of photographs whose cameras are known: what several of them show, triangulated by pycolmap."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ....neural_fields import InputError
from ....neural_fields.backend.files import files_in
from ..formats.reading import find_source, read_shots
from ..images import read_posed_images
from ..writing import write_colmap
from .colmap_process import (
    DATABASE_FILE,
    MATCHING,
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

__all__ = ["TRIANGULATING", "FoundPoints", "find_points", "neighbours"]

TRIANGULATING = "triangulating"
MATCHED_VIEWS = 20  # views that each is matched with: those that look at the region from most nearly the same side
GIVEN, PAIRS_FILE = "given", "pairs.txt"  # what COLMAP is given: a model with cameras and no points, and who is matched


@dataclass(frozen=True)
class FoundPoints:
    """What was found.

    Attributes:
        project: the folder, which `read_posed_images` reads.
        photographs: how many there were.
        points: how many sparse points.
        error: mean distance of the points' projections from where they were seen, in pixels.
    """

    project: Path
    photographs: int
    points: int
    error: float


def find_points(source: str | Path, project: str | Path, *, report: Report | None = None) -> FoundPoints:
    """Triangulate what several photographs show, with their cameras as they are.

    The project is a COLMAP model of the same world: photographs without lens distortion, masks as transparency, depth
    maps, the cameras as they were given, and points with the views that saw them. Each photograph is matched with the
    twenty that see the region from most nearly the same side. Features, matches and what is done so far stay in it:
    the same call goes on where it was interrupted, and returns at once what was finished.

    Args:
        source: posed photographs, as `read_posed_images` takes them.
        project: the folder to be written.
        report: called with a stage, how much of it is done, and of how much.

    Raises:
        InputError: the photographs cannot be read, the project is another's, or no two of them show the same.
    """
    source, project = find_source(source), Path(project)
    shots = read_shots(source)
    check_colmap()
    files = [file for shot in shots for file in (shot.image, shot.mask, shot.depth) if file is not None]
    files += [source] if source.is_file() else files_in(source, (".bin", ".txt"))
    asked = {"source": str(source.resolve()), "content": fingerprint([file for file in files if file.is_file()])}
    found = begun(project, asked, lambda was: FoundPoints(**{**was, "project": project}))
    if found is not None:
        return found
    report = report or (lambda stage, done, total: None)
    if not (project / GIVEN).is_dir():
        _write_given(source, project)
    pairs = (project / PAIRS_FILE).read_text(encoding="utf-8").count("\n")
    made = solve(project, _triangulated, photographs=len(shots), pairs=pairs, report=report)
    found = FoundPoints(project, len(shots), **made)
    write_record(project, asked | {"found": asdict(found) | {"project": ""}})
    return found


def _write_given(source: Path, project: Path) -> None:
    """Write what COLMAP is given: photographs, cameras and pairs; the folder of the cameras appears last."""
    images = read_posed_images(source)
    half = project / ".half"
    shutil.rmtree(half, ignore_errors=True)
    write_colmap(half, images)
    names = sorted(file.name for file in (half / "images").iterdir())  # in the order of the views
    eyes = torch.stack([view.camera.eye for view in images.views]).numpy()
    pairs = neighbours(eyes - np.array(images.similarity.center))
    lines = "".join(f"{names[a]} {names[b]}\n" for a, b in pairs)
    (project / PAIRS_FILE).write_text(lines, encoding="utf-8")
    for name in ("images", "depths"):
        if (half / name).is_dir():
            shutil.rmtree(project / name, ignore_errors=True)
            (half / name).replace(project / name)
    (half / "sparse" / "0").replace(project / GIVEN)
    shutil.rmtree(half)


def neighbours(away: NDArray[np.float64], nearest: int = MATCHED_VIEWS) -> list[tuple[int, int]]:
    """Pairs of views that may show the same: each with those whose directions from the region are nearest to its own.

    Args:
        away: ``(V, 3)`` from the middle of the region to the eyes.
        nearest: how many each is paired with, or more, since others may be paired with it.

    Returns:
        Pairs of numbers, the smaller one first, in order.
    """
    directions = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    cosine = directions @ directions.T
    np.fill_diagonal(cosine, -2)  # nobody is paired with itself
    order = np.argsort(-cosine, axis=1, kind="stable")[:, : min(nearest, len(away) - 1)]
    rows = np.repeat(np.arange(len(away)), order.shape[1])
    both = np.sort(np.column_stack((rows, order.reshape(-1))), axis=1)
    return [(int(a), int(b)) for a, b in np.unique(both, axis=0)]


def _triangulated(project: Path, told: Connection) -> dict[str, Any]:
    """What the other process does; see `solve`."""
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
    """A model with the cameras and poses of another one, by the numbers that a database has for images and cameras.

    The database gets its cameras: what it has guessed from the pictures is replaced.
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
