"""Cameras of photographs or of a film: structure from motion by pycolmap."""

from __future__ import annotations

import itertools
import shutil
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ....neural_fields import InputError
from ..formats.shots import IMAGE_SUFFIXES, image_size, list_images
from .colmap_process import (
    DATABASE_FILE,
    MATCHING,
    OVERLAP,
    Found,
    Report,
    begun,
    check_colmap,
    extract_features,
    film_pairs,
    fingerprint,
    new_model,
    solve,
    verification_options,
    write_record,
)

FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
FEWEST_PHOTOGRAPHS = 3
SHARPNESS_WIDTH = 480  # pixels; frames are shrunk to this width before their sharpness is compared
PLACING = "placing cameras"


def find_cameras(
    source: str | Path,
    project: str | Path,
    *,
    frames: int = 100,
    lens: Literal["auto", "one", "each"] = "auto",
    report: Report | None = None,
) -> Found:
    """Estimate poses and lenses of a folder of photographs, or of a film, by COLMAP's incremental mapping.

    The project gets ``images`` (links to the photographs, or frames of the film) and ``sparse/0``. The same call
    continues an interrupted project, and returns the result of a finished one at once. Of a film the sharpest frame is
    taken from each of ``frames`` stretches of equal length. With the ``lens`` "auto" photographs of one size share one.

    Raises:
        InputError: nothing can be read, the project is of something else, or too few photographs overlap.
    """
    source, project = Path(source), Path(project)
    check_colmap()
    photographs = _photographs(source)
    asked = {"source": str(source.resolve()), "frames": frames, "lens": lens, "content": fingerprint(photographs)}
    if (found := begun(project, asked)) is not None:
        return found
    report = report or (lambda stage, done, total: None)
    images = project / "images"
    if source.is_dir():
        _link(photographs, images)
    elif not images.is_dir():
        _sharpest(source, images, frames, report)
    names = [file.name for file in list_images(images)]
    one = len({image_size(images / name) for name in names}) == 1 if lens == "auto" else lens == "one"
    film, count = not source.is_dir(), len(names)
    pairs = film_pairs(count) if film else count * (count - 1) // 2
    made = solve(project, partial(_reconstructed, one=one, film=film), photographs=count, pairs=pairs, report=report)
    placed = set(made.pop("names"))
    left_out = tuple(name for name in names if name not in placed)
    found = Found(project, len(names), left_out=left_out, **made)
    write_record(project, asked, found)
    return found


def _photographs(source: Path) -> list[Path]:
    if source.is_dir():
        files = list_images(source)
        if len(files) < FEWEST_PHOTOGRAPHS:
            count = f"{len(files)} photographs ({', '.join(IMAGE_SUFFIXES)})"
            raise InputError(f"{source}: {count} in it; {FEWEST_PHOTOGRAPHS} are the least, 30 are better")
        return files
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; check the path")
    if source.suffix.lower() not in FILM_SUFFIXES:
        raise InputError(f"{source}: neither a folder of photographs nor a film ({', '.join(FILM_SUFFIXES)})")
    return [source]


def _link(photographs: list[Path], images: Path) -> None:
    """Make links to the photographs, or copies where links are refused."""
    images.mkdir(exist_ok=True)
    for file in photographs:
        place = images / file.name
        if not place.exists():
            try:
                place.symlink_to(file.resolve())
            except OSError:  # Windows requires a privilege
                shutil.copyfile(file, place)


def _sharpest(film: Path, images: Path, frames: int, report: Report) -> None:
    """Write the frames with the largest mean squared Laplacian, one of each stretch."""
    half = images.with_name(".images")
    shutil.rmtree(half, ignore_errors=True)
    half.mkdir()
    capture, count, best = cv2.VideoCapture(str(film)), 0, 0.0
    try:
        total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        if total < FEWEST_PHOTOGRAPHS:
            raise InputError(f"{film}: not a film that can be read; convert it to MP4, or give a folder of photographs")
        for index in range(total):
            read, frame = capture.read()
            if not read:
                break
            count += 1
            width = min(frame.shape[1], SHARPNESS_WIDTH)
            small = cv2.resize(frame, (width, max(1, round(frame.shape[0] * width / frame.shape[1]))))
            edges = cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32), cv2.CV_32F)
            sharpness = float(np.square(edges).mean())
            stretch = index * min(frames, total) // total
            place = half / f"{stretch:04d}.png"
            if not place.exists() or sharpness > best:
                best = sharpness
                written, data = cv2.imencode(".png", frame)
                if not written:
                    raise InputError(f"{film}: frame {index} cannot be written as PNG")
                place.write_bytes(data.tobytes())
            report("reading the film", index + 1, total)
    finally:
        capture.release()
    if count < FEWEST_PHOTOGRAPHS:
        raise InputError(f"{film}: {count} frames can be read; {FEWEST_PHOTOGRAPHS} are the least")
    half.replace(images)


def _reconstructed(project: Path, told: Connection, *, one: bool, film: bool) -> dict[str, Any]:
    """The job of `solve`."""
    import pycolmap

    database, images = project / DATABASE_FILE, project / "images"
    extract_features(project, told, one=one)
    told.send(("stage", (MATCHING, 0)))
    verification = verification_options()
    if film:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = OVERLAP, True
        pycolmap.match_sequential(database, pairing_options=pairing, verification_options=verification)
    else:
        pycolmap.match_exhaustive(database, verification_options=verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size, options.random_seed = FEWEST_PHOTOGRAPHS, 0
    placed = itertools.count(3)  # the first two are placed together and reported once
    told.send(("stage", (PLACING, 0)))
    (project / "models").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(
        database,
        images,
        project / "models",
        options=options,
        next_image_callback=lambda: told.send(("stage", (PLACING, next(placed)))),
    )
    if not models:
        raise InputError(
            "no photographs could be placed: too few things are seen in several of them; take more, from nearer to one "
            "another, of something with texture, and keep the lens"
        )
    model = max(models.values(), key=lambda model: model.num_reg_images())
    with new_model(project) as folder:
        model.write(folder)
    return {
        "names": sorted(image.name for image in model.images.values() if image.has_pose),
        "points": model.num_points3D(),
        "error": model.compute_mean_reprojection_error(),
    }
