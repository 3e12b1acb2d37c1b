"""COLMAP in a process of its own, with its progress; and projects that are gone on with where they were interrupted."""

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
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ....neural_fields import InputError
from ....neural_fields.backend.files import check_place

__all__ = [
    "DATABASE_FILE",
    "FEATURES",
    "MATCHING",
    "OVERLAP",
    "Job",
    "Report",
    "begun",
    "check_colmap",
    "extract_features",
    "film_pairs",
    "fingerprint",
    "new_model",
    "solve",
    "verification_options",
    "write_record",
]

RECORD_FILE, DATABASE_FILE, LOG_FILE = "cameras.json", "database.db", "colmap.log"
LARGEST_SIDE = 1600  # pixels in which features are looked for
OVERLAP = 10  # frames of a film after each that it is matched with; and the 2^n-th ones after it
POLL_SECONDS = 0.3
FEATURES, MATCHING = "finding features", "matching"

Report = Callable[[str, int, int], None]
T = TypeVar("T")


class Job(Protocol):
    """What COLMAP is to do."""

    def __call__(self, project: Path, told: Connection, /) -> dict[str, Any]:
        """Do it in a process of its own.

        Args:
            project: the folder.
            told: takes ``("stage", (name, how many photographs are done))``.

        Returns:
            What was found; it travels to the first process.
        """
        ...


def check_colmap() -> None:
    """Ask, before any long work, whether the extra ``mplicits[poses]`` is installed.

    Raises:
        InputError: it is not.
    """
    try:
        import pycolmap  # noqa: F401
    except ImportError as error:
        raise InputError("finding cameras needs pycolmap; pip install 'mplicits[poses]'") from error


def fingerprint(files: list[Path]) -> str:
    """Of names, sizes and times of change; contents would be read for minutes."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.name} {file.stat().st_size} {file.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()


def begun(project: Path, asked: dict[str, Any], form: Callable[[dict[str, Any]], T]) -> T | None:
    """What was found in a project before; None where there is more to do. The project is then begun.

    Args:
        project: the folder.
        asked: from what, and how.
        form: makes of the record what is returned; may raise a ValueError, TypeError or KeyError.

    Raises:
        InputError: the folder is another's, or was made of something else.
    """
    record_file = project / RECORD_FILE
    if project.exists() and not project.is_dir():
        raise InputError(f"{project}: is a file; name a folder")
    if not record_file.is_file():
        if project.is_dir() and any(project.iterdir()):
            raise InputError(f"{project}: is not empty, and not a project of ours; name another folder")
        check_place(project)
        project.mkdir(parents=True, exist_ok=True)
        write_record(project, asked)
        return None
    try:
        record = json.loads(record_file.read_text(encoding="utf-8"))
        found = record.pop("found", None)
        same = record == asked
        if same and found is not None:
            return form(found)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{record_file}: damaged ({error}); remove the folder, or name another") from error
    if not same:
        raise InputError(
            f"{project}: holds the cameras of other photographs ({record.get('source')}), or of other settings; "
            "name another folder, or remove this one"
        )
    return None


def write_record(project: Path, record: dict[str, Any]) -> None:
    """Say in a project what was asked, and what was found, if it was: all at once."""
    half = project / f".{RECORD_FILE}"
    half.write_text(json.dumps(record, indent=1), encoding="utf-8")
    half.replace(project / RECORD_FILE)


def solve(project: Path, job: Job, *, photographs: int, pairs: int, report: Report) -> dict[str, Any]:
    """Let COLMAP work in a process of its own: it can be ended at any time, and what it prints goes into a file.

    Args:
        project: the folder.
        job: what is to be done; it can be pickled.
        photographs: how many there are.
        pairs: of them that are matched.
        report: called with a stage, how much of it is done, and of how much.

    Raises:
        InputError: the job raised it, or COLMAP has ended.
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
    """How much of a stage is done: for the first two that is what the database holds."""
    if stage == FEATURES:
        return min(_rows(database, "keypoints"), photographs), photographs
    if stage == MATCHING:
        return min(_rows(database, "two_view_geometries"), pairs), pairs
    return min(done, photographs), photographs


def film_pairs(count: int) -> int:
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


def _work(project: str, job: Job, told: Connection) -> None:
    """What the other process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to both; the first one ends this one
    log = os.open(Path(project) / LOG_FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    for stream in (1, 2):
        os.dup2(log, stream)
    try:
        told.send(("done", job(Path(project), told)))
    except InputError as error:
        told.send(("failed", str(error)))


def extract_features(project: Path, told: Connection, *, one: bool) -> None:
    """The first stage of a job: features of all photographs, taken with ``one`` lens or one each."""
    import pycolmap

    told.send(("stage", (FEATURES, 0)))
    mode = pycolmap.CameraMode.SINGLE if one else pycolmap.CameraMode.PER_IMAGE
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = LARGEST_SIDE
    pycolmap.extract_features(project / DATABASE_FILE, project / "images", camera_mode=mode, extraction_options=options)


def verification_options() -> Any:
    """How matches of two photographs are held against a camera's motion: as in every other run."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0  # else every run has matches of its own
    return options


@contextmanager
def new_model(project: Path) -> Iterator[Path]:
    """A folder for a model, which becomes the project's ``sparse/0`` when the block ends without an error."""
    half = project / ".sparse"
    shutil.rmtree(half, ignore_errors=True)
    (half / "0").mkdir(parents=True)
    yield half / "0"
    shutil.rmtree(project / "sparse", ignore_errors=True)
    half.replace(project / "sparse")
