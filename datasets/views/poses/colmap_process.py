"""COLMAP in a process of its own, with its progress, and projects that continue where they were interrupted."""

from __future__ import annotations

import hashlib
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
from typing import Any

from ....neural_fields import InputError
from ....neural_fields.backend.files import check_place, write_whole

RECORD_FILE, DATABASE_FILE, LOG_FILE = "cameras.json", "database.db", "colmap.log"
LARGEST_SIDE = 1600  # pixels; larger photographs are shrunk before features are extracted
OVERLAP = 10  # frames of a film that each is matched with, besides the 2^n-th ones after it
POLL_SECONDS = 0.3
FEATURES, MATCHING = "finding features", "matching"

Report = Callable[[str, int, int], None]
"""Takes the name of a stage, how much of it is done, and of how much."""

Job = Callable[[Path, Connection], dict[str, Any]]
"""Takes a project and a connection for ``("stage", (name, photographs done))``; returns what `solve` returns."""


@dataclass(frozen=True)
class Found:
    """The result of `find_cameras` or `find_points`."""

    project: Path  # the folder, which `read_posed_images` reads
    photographs: int
    points: int  # number of sparse points
    error: float  # mean reprojection error, pixels
    left_out: tuple[str, ...] | None = None  # photographs that could not be placed; None where cameras were known


def check_colmap() -> None:
    """Refuse to begin without the extra ``mplicits[poses]``."""
    try:
        import pycolmap  # noqa: F401
    except ImportError as error:
        raise InputError("finding cameras needs pycolmap; pip install 'mplicits[poses]'") from error


def fingerprint(files: list[Path]) -> str:
    """A hash of names, sizes and times of change: to read the contents would take minutes."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name} {file.stat().st_size} {file.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()


def begun(project: Path, asked: dict[str, Any]) -> Found | None:
    """The result of a finished project; else None, and a new project is begun.

    ``asked`` are the source and the settings. An InputError says that the folder was made of others.
    """
    record_file = project / RECORD_FILE
    if project.exists() and not project.is_dir():
        raise InputError(f"{project}: is a file; name a folder")
    if not record_file.is_file():
        if project.is_dir() and any(project.iterdir()):
            raise InputError(f"{project}: is not empty, and not a project of ours; name another folder")
        check_place(project)
        project.mkdir(parents=True, exist_ok=True)
        write_record(project, asked, None)
        return None
    try:
        record = json.loads(record_file.read_text(encoding="utf-8"))
        found = record.pop("found", None)
        same = record == asked
        if same and found is not None:
            values = {name: tuple(value) if isinstance(value, list) else value for name, value in found.items()}
            return Found(**{**values, "project": project})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{record_file}: damaged ({error}); remove the folder, or name another") from error
    if not same:
        raise InputError(
            f"{project}: holds the cameras of other photographs ({record.get('source')}), or of other settings; "
            "name another folder, or remove this one"
        )
    return None


def write_record(project: Path, asked: dict[str, Any], found: Found | None) -> None:
    """Write the request, and the result under ``found`` if there is one, in one step."""
    record = asked if found is None else asked | {"found": asdict(found)}
    text = json.dumps(record, indent=1, default=lambda _: "")  # the only path is that of the project, which may move
    write_whole(project / RECORD_FILE, text)


def solve(project: Path, job: Job, *, photographs: int, pairs: int, report: Report) -> dict[str, Any]:
    """The result of a job that runs in a process of its own, so that Ctrl-C ends it; its output goes to a file.

    ``pairs`` is the number of pairs of photographs that are matched. The job can be pickled.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(str(project), job, theirs), daemon=True)
    process.start()
    theirs.close()
    stage, done = FEATURES, 0
    try:
        while True:
            if ours.poll(POLL_SECONDS):
                kind, said = ours.recv()
                if kind == "done":
                    return said
                if kind == "failed":
                    raise InputError(f"{project}: {said}")
                stage, done = said
            report(stage, *_progress(project / DATABASE_FILE, stage, photographs, pairs, done))
    except EOFError as error:
        raise InputError(f"{project}: COLMAP ended while {stage}; see {project / LOG_FILE}") from error
    finally:
        process.terminate()
        process.join()
        ours.close()


def _progress(database: Path, stage: str, photographs: int, pairs: int, done: int) -> tuple[int, int]:
    """How much of a stage is done; the first two are counted in the database."""
    if stage == FEATURES:
        return min(_rows(database, "keypoints"), photographs), photographs
    if stage == MATCHING:
        return min(_rows(database, "two_view_geometries"), pairs), pairs
    return min(done, photographs), photographs


def film_pairs(count: int) -> int:
    """Number of pairs of ``count`` frames that are 1 to 10, or 16, 32, … frames apart."""
    return sum(max(count - step, 0) for step in {*range(1, OVERLAP + 1), *(2**power for power in range(OVERLAP))})


def _rows(database: Path, table: str) -> int:
    """How many rows are in COLMAP's database, without the last few megabytes that it has written.

    The file is opened as immutable, without a lock: COLMAP would end if it met one.
    """
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?immutable=1", uri=True)) as opened:
            return int(opened.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:  # not there yet, or being written
        return 0


def _work(project: str, job: Job, told: Connection) -> None:
    """Run a job in the other process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to both; the first one ends this one
    log = os.open(Path(project) / LOG_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    for stream in (1, 2):
        os.dup2(log, stream)
    try:
        told.send(("done", job(Path(project), told)))
    except InputError as error:
        told.send(("failed", str(error)))


def extract_features(project: Path, told: Connection, *, one: bool) -> None:
    """The first stage of a job: features of all photographs, which share ``one`` lens or have one each."""
    import pycolmap

    told.send(("stage", (FEATURES, 0)))
    mode = pycolmap.CameraMode.SINGLE if one else pycolmap.CameraMode.PER_IMAGE
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = LARGEST_SIDE
    pycolmap.extract_features(project / DATABASE_FILE, project / "images", camera_mode=mode, extraction_options=options)


def verification_options() -> Any:
    """Options for the geometric verification of matches, with a fixed seed."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0  # else every run has matches of its own
    return options


@contextmanager
def new_model(project: Path) -> Iterator[Path]:
    """A folder that becomes the project's ``sparse/0`` when the block ends without an error."""
    half = project / ".sparse"
    shutil.rmtree(half, ignore_errors=True)
    (half / "0").mkdir(parents=True)
    yield half / "0"
    shutil.rmtree(project / "sparse", ignore_errors=True)
    half.replace(project / "sparse")
