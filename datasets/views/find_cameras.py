"""Photographs without cameras, or a film, to a COLMAP project: structure from motion by pycolmap."""

from __future__ import annotations

import hashlib
import itertools
import json
import multiprocessing
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ...neural_fields import InputError
from ...neural_fields.files import check_place
from .shots import IMAGE_SUFFIXES, image_size, list_images

__all__ = ["FILM_SUFFIXES", "FoundCameras", "check_colmap", "find_cameras"]

FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
RECORD_FILE, DATABASE_FILE, LOG_FILE = "cameras.json", "database.db", "colmap.log"
LEAST = 3  # photographs; two say little of a surface
LARGEST_SIDE = 1600  # pixels in which features are looked for
OVERLAP = 10  # frames of a film after each that it is matched with; and the 2^n-th ones after it
SHARPNESS_WIDTH = 480  # pixels across, in which the sharpness of frames is compared
POLL_SECONDS = 0.3
FEATURES, MATCHING, PLACING = "finding features", "matching", "placing cameras"

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class FoundCameras:
    """What was found.

    Attributes:
        project: the folder, which `read_posed_images` reads.
        photographs: how many there were.
        left_out: names of those that could not be placed.
        points: how many sparse points.
        error: mean distance of the points' projections from where they were seen, in pixels.
    """

    project: Path
    photographs: int
    left_out: tuple[str, ...]
    points: int
    error: float


def check_colmap() -> None:
    """Ask, before any long work, whether the extra ``mplicits[poses]`` is installed.

    Raises:
        InputError: it is not.
    """
    try:
        import pycolmap  # noqa: F401
    except ImportError as error:
        raise InputError("finding cameras needs pycolmap; pip install 'mplicits[poses]'") from error


def find_cameras(
    source: str | Path,
    project: str | Path,
    *,
    frames: int = 100,
    lens: Literal["auto", "one", "each"] = "auto",
    report: Report | None = None,
) -> FoundCameras:
    """Find where photographs were taken, and with which lens, by COLMAP's incremental structure from motion.

    The project gets ``images`` (links to the photographs, or frames of the film) and ``sparse/0``. Features, matches
    and what is done so far stay in it: the same call goes on where it was interrupted, and returns at once what was
    finished. Of a film the sharpest frames are taken, one from each of ``frames`` stretches of equal length.

    Args:
        source: a folder of photographs, or a film.
        project: the folder to be written.
        frames: of a film.
        lens: whether all photographs have one; auto is yes, where they have one size.
        report: called with a stage, how much of it is done, and of how much.

    Raises:
        InputError: there is nothing to be read, the project is another's, or the photographs do not hang together.
    """
    source, project = Path(source), Path(project)
    check_colmap()
    photographs = _photographs(source)
    asked = {"source": str(source.resolve()), "frames": frames, "lens": lens, "content": _fingerprint(photographs)}
    found = _begun(project, asked)
    if found is not None:
        return found
    report = report or (lambda stage, done, total: None)
    images = project / "images"
    if source.is_dir():
        _link(photographs, images)
    elif not images.is_dir():
        _sharpest(source, images, frames, report)
    names = [file.name for file in list_images(images)]
    one = len({image_size(images / name) for name in names}) == 1 if lens == "auto" else lens == "one"
    made = _solve(project, len(names), one=one, film=not source.is_dir(), report=report)
    placed = set(made.pop("names"))
    found = FoundCameras(project, len(names), tuple(name for name in names if name not in placed), **made)
    _write_record(project, asked | {"found": asdict(found) | {"project": ""}})
    return found


def _photographs(source: Path) -> list[Path]:
    if source.is_dir():
        files = list_images(source)
        if len(files) < LEAST:
            kinds = ", ".join(IMAGE_SUFFIXES)
            raise InputError(
                f"{source}: {len(files)} photographs ({kinds}) in it; {LEAST} are the least, 30 are better"
            )
        return files
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; check the path")
    if source.suffix.lower() not in FILM_SUFFIXES:
        raise InputError(f"{source}: neither a folder of photographs nor a film ({', '.join(FILM_SUFFIXES)})")
    return [source]


def _fingerprint(files: list[Path]) -> str:
    """Of names, sizes and times of change; contents would be read for minutes."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name} {file.stat().st_size} {file.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _begun(project: Path, asked: dict[str, Any]) -> FoundCameras | None:
    """What was found in the project before; None where there is more to do. The project is then begun."""
    record_file = project / RECORD_FILE
    if project.exists() and not project.is_dir():
        raise InputError(f"{project}: is a file; name a folder")
    if not record_file.is_file():
        if project.is_dir() and any(project.iterdir()):
            raise InputError(f"{project}: is not empty, and not a project of ours; name another folder")
        check_place(project)
        project.mkdir(parents=True, exist_ok=True)
        _write_record(project, asked)
        return None
    try:
        record = json.loads(record_file.read_text(encoding="utf-8"))
        found = record.pop("found", None)
        same = record == asked
        if same and found is not None:
            return FoundCameras(**{**found, "project": project, "left_out": tuple(found["left_out"])})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{record_file}: damaged ({error}); remove the folder, or name another") from error
    if not same:
        raise InputError(
            f"{project}: holds the cameras of other photographs ({record.get('source')}), or of other settings; "
            "name another folder, or remove this one"
        )
    return None


def _write_record(project: Path, record: dict[str, Any]) -> None:
    half = project / f".{RECORD_FILE}"
    half.write_text(json.dumps(record, indent=1), encoding="utf-8")
    half.replace(project / RECORD_FILE)


def _link(photographs: list[Path], images: Path) -> None:
    """Links to the photographs; copies, where there can be no links."""
    images.mkdir(exist_ok=True)
    for file in photographs:
        place = images / file.name
        if not place.exists():
            try:
                place.symlink_to(file.resolve())
            except OSError:  # Windows asks for a right that few have
                shutil.copyfile(file, place)


def _sharpest(film: Path, images: Path, frames: int, report: Report) -> None:
    """Write the frames with the largest mean squared Laplacian, one of each stretch."""
    half = images.with_name(".images")
    shutil.rmtree(half, ignore_errors=True)
    half.mkdir()
    with _opened(film) as (capture, total):
        best, count = 0.0, 0
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
    if count < LEAST:
        raise InputError(f"{film}: {count} frames can be read; {LEAST} are the least")
    half.replace(images)


@contextmanager
def _opened(film: Path) -> Iterator[tuple[cv2.VideoCapture, int]]:
    capture = cv2.VideoCapture(str(film))
    try:
        total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        if total < LEAST:
            raise InputError(f"{film}: not a film that can be read; convert it to MP4, or give a folder of photographs")
        yield capture, total
    finally:
        capture.release()


def _solve(project: Path, count: int, *, one: bool, film: bool, report: Report) -> dict[str, Any]:
    """COLMAP in a process of its own: it can be ended at any time, and what it prints goes into a file."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(str(project), one, film, theirs), daemon=True)
    process.start()
    theirs.close()
    stage, placed = FEATURES, 0
    try:
        while True:
            if ours.poll(POLL_SECONDS):
                kind, said = ours.recv()
                if kind == "done":
                    return said
                if kind == "failed":
                    raise InputError(f"{project}: {said}")
                stage, placed = said
            report(stage, *_progress(project / DATABASE_FILE, stage, count, placed, film=film))
    except EOFError as error:
        raise InputError(f"{project}: COLMAP ended while {stage}; see {project / LOG_FILE}") from error
    finally:
        process.terminate()
        process.join()
        ours.close()


def _progress(database: Path, stage: str, count: int, placed: int, *, film: bool) -> tuple[int, int]:
    """How much of a stage is done: for the first two that is what the database holds."""
    if stage == FEATURES:
        return min(_rows(database, "keypoints"), count), count
    if stage == MATCHING:
        pairs = _film_pairs(count) if film else count * (count - 1) // 2
        return min(_rows(database, "two_view_geometries"), pairs), pairs
    return min(placed, count), count


def _film_pairs(count: int) -> int:
    """Frames that are matched with one another: the next ones, and those that 2, 4, 8, … come later."""
    steps = {*range(1, OVERLAP + 1), *(2**power for power in range(OVERLAP))}
    return sum(max(count - step, 0) for step in steps)


def _rows(database: Path, table: str) -> int:
    """How many rows are in COLMAP's database, but for the last few megabytes that it has written.

    Read as immutable, no lock is taken. COLMAP does not wait for one: it would end, if it opened the file meanwhile.
    """
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?immutable=1", uri=True)) as opened:
            return int(opened.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # not there yet, or being written
        return 0


def _work(project: str, one: bool, film: bool, told: Connection) -> None:
    """What the other process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to both; the first one ends this one
    log = os.open(Path(project) / LOG_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    for stream in (1, 2):
        os.dup2(log, stream)
    try:
        told.send(("done", _reconstructed(Path(project), one, film, told)))
    except InputError as error:
        told.send(("failed", str(error)))


def _reconstructed(project: Path, one: bool, film: bool, told: Connection) -> dict[str, Any]:
    import pycolmap

    database, images = project / DATABASE_FILE, project / "images"
    told.send(("stage", (FEATURES, 0)))
    mode = pycolmap.CameraMode.SINGLE if one else pycolmap.CameraMode.PER_IMAGE
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = LARGEST_SIDE
    pycolmap.extract_features(database, images, camera_mode=mode, extraction_options=extraction)
    told.send(("stage", (MATCHING, 0)))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0  # else every run has matches of its own
    if film:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = OVERLAP, True
        pycolmap.match_sequential(database, pairing_options=pairing, verification_options=verification)
    else:
        pycolmap.match_exhaustive(database, verification_options=verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size, options.random_seed = LEAST, 0
    placed = itertools.count(3)  # two are placed together, of which one is told
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
    half = project / ".sparse"
    shutil.rmtree(half, ignore_errors=True)
    (half / "0").mkdir(parents=True)
    model.write(half / "0")
    shutil.rmtree(project / "sparse", ignore_errors=True)
    half.replace(project / "sparse")
    return {
        "names": sorted(image.name for image in model.images.values() if image.has_pose),
        "points": model.num_points3D(),
        "error": model.compute_mean_reprojection_error(),
    }
