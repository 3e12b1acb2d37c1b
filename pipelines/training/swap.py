"""Several files of a folder replaced at once: after a kill at any moment all of them are old, or all are new.

The new files are written into a folder of their own, `NEXT`. That it is complete is said by one rename, to `READY`:
before it nothing has happened, after it all has, though the files have still to be moved to their places. Whoever comes
next, to write or to read, moves what a kill has left there (`settle`, `settled`).
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from ...neural_fields import InputError
from ...neural_fields.backend import disk
from .lock import is_running, lock_file, locked

__all__ = ["is_scratch", "settle", "settled", "swap", "sweep"]

NEXT, READY = ".next", ".ready"
PLAN = "remove.json"  # in them: the names that shall be gone
PARTIAL = re.compile(r"\..*\.(\d+)\.partial(\.[^.]*)?")  # of `whole_file`
PATIENCE = 10.0  # seconds that a reader waits for a writer who is at it
BEGUN = time.time()  # what bears our number and is older was left by another process of that number


def swap(folder: Path, files: Mapping[str, bytes | Path], remove: Iterable[str] = ()) -> None:
    """Replace files of a folder at once; to be called by who has its lock.

    Args:
        folder: exists.
        files: what each shall hold: bytes, or a file on the same disk that is moved there.
        remove: names that shall be gone; of files that may not be there.

    Raises:
        InputError: the disk is full, or says no in another way. The folder is then as it was, or settled by the next
            who comes.
    """
    following, ready = folder / NEXT, folder / READY
    try:
        disk.remove_tree(following)
        disk.make_folder(following)
        for name, content in files.items():
            if isinstance(content, Path):
                disk.rename(content, following / name)
            else:
                disk.write(following / name, content)
        gone = sorted({*remove} - {*files})
        if gone:
            disk.write(following / PLAN, json.dumps(gone).encode())
        disk.sync(following)
        disk.rename(following, ready)
        disk.sync(folder)
        settle(folder)
    except OSError as error:
        if not ready.is_dir():
            with suppress(OSError):
                disk.remove_tree(following)
        reason = error.strerror or error
        raise InputError(f"{folder}: cannot be written ({reason}); make room, or choose another -o") from error


def settle(folder: Path) -> None:
    """End what a kill has left half done in a folder; to be called by who has its lock.

    Raises:
        OSError: the disk says no.
    """
    ready = folder / READY
    if ready.is_dir():
        plan = ready / PLAN
        for file in sorted(ready.iterdir()):
            if file != plan:
                disk.rename(file, folder / file.name)
        for name in _plan(plan):
            disk.remove(folder / name)
        disk.sync(folder)
        disk.remove_tree(ready)
    disk.remove_tree(folder / NEXT)


def sweep(folder: Path) -> None:
    """Settle a folder, and remove files that a process was writing when it was killed; see `settle`.

    Raises:
        InputError: the disk says no.
    """
    try:
        settle(folder)
        for file in _left_over(folder):
            disk.remove(file)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{folder}: cannot be written ({reason}); make room, or choose another -o") from error


def settled(folder: Path) -> None:
    """Wait until nobody is in the middle of replacing files of a folder, and end what a kill has left there.

    Raises:
        InputError: somebody is, for longer than `PATIENCE`; or the folder may not be written.
    """
    until = time.monotonic() + PATIENCE
    while (folder / READY).is_dir():
        try:
            with locked(folder):
                settle(folder)
        except InputError:  # whoever writes there will do it
            if time.monotonic() > until:
                raise
            time.sleep(0.05)
        except OSError as error:
            raise InputError(
                f"{folder}: was left half written, and cannot be put right ({error.strerror or error}); "
                "make it writable and try again"
            ) from error


def is_scratch(file: Path) -> bool:
    """Whether what lies in a folder is of no worth to anybody: locks, and what a kill has left."""
    return file == lock_file(file.parent) or file.name == NEXT or PARTIAL.fullmatch(file.name) is not None


def _plan(file: Path) -> list[str]:
    """The names that shall be gone; of this folder only, whoever wrote the file."""
    if not file.is_file():
        return []
    try:
        names = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        return []
    names = names if isinstance(names, list) else []
    return [name for name in names if isinstance(name, str) and name and Path(name).name == name]


def _left_over(folder: Path) -> Iterator[Path]:
    """Files that a process was writing when it was killed."""
    for file in list(folder.iterdir()):
        found = PARTIAL.fullmatch(file.name)
        if found is None:
            continue
        number = int(found[1])
        if file.stat().st_mtime < BEGUN if number == os.getpid() else not is_running(number):
            yield file
