"""Several files of a folder replaced at once: after a kill at any moment all of them are old, or all are new.

The new contents are written into one file, the journal. Its renaming is the moment of the change. The files are then
written from it, and it is removed. If a kill came between, the next reader or writer repeats this (`recover`).
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save

from ...neural_fields import InputError
from ...neural_fields.backend import files as disk
from .lock import lock_file, locked

JOURNAL = ".journal"
PARTIAL = re.compile(r"\..*\.(\d+)\.partial(\.[^.]*)?")  # of `whole_file`


def replace_files(folder: Path, contents: Mapping[str, bytes], remove: Iterable[str] = ()) -> None:
    """Write files of a folder and remove others, all at once. The caller holds the folder's lock.

    Args:
        folder: exists.
        contents: by name of file.
        remove: names of files, which may be absent.

    Raises:
        InputError: the folder cannot be written. It is then unchanged, or the next `recover` ends the change.
    """
    packed = {name: np.asarray(bytearray(content)) for name, content in contents.items()}
    gone = sorted({*remove} - {*contents})
    disk.write_whole(folder / JOURNAL, save(packed, {"remove": json.dumps(gone)}))
    _carry_out(folder, contents, gone)


def recover(folder: Path) -> None:
    """End a change that was interrupted by a kill. The caller holds the folder's lock.

    Raises:
        InputError: the journal is damaged, or the folder cannot be written.
    """
    journal = folder / JOURNAL
    if not journal.is_file():
        return
    with disk.damage(journal, "remove it"):
        with safe_open(journal, framework="np") as file:
            gone = json.loads(file.metadata()["remove"])
            contents = {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
        if any(Path(name).name != name for name in [*contents, *gone]):
            raise ValueError("names a file outside of its folder")
    _carry_out(folder, contents, gone)


def _carry_out(folder: Path, contents: Mapping[str, bytes], gone: Iterable[str]) -> None:
    """Do what the journal says, and remove it."""
    try:
        disk.sync(folder)  # the journal lasts before anything else changes
        for name, content in contents.items():
            disk.write_whole(folder / name, content)
        for name in gone:
            disk.remove(folder / name)
        disk.sync(folder)
        disk.remove(folder / JOURNAL)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{folder}: cannot be written ({reason}); make room, or choose another -o") from error


def recovered(folder: Path) -> None:
    """Wait for a change that is under way, and end one that was interrupted.

    Raises:
        InputError: it takes longer than ten seconds, or see `recover`.
    """
    if (folder / ".ready").is_dir():
        raise InputError(
            f"{folder}: an older version was killed while it wrote; move the files of {folder / '.ready'} into {folder}"
        )
    until = time.monotonic() + 10
    while (folder / JOURNAL).is_file():
        try:
            with locked(folder):
                recover(folder)
        except InputError:  # the writer does it
            if time.monotonic() > until:
                raise
            time.sleep(0.05)


def prune(folder: Path) -> None:
    """`recover`, and remove partial files of killed processes. The caller holds the folder's lock.

    Raises:
        InputError: see `recover`.
    """
    recover(folder)
    for file in list(folder.iterdir()):
        found = PARTIAL.fullmatch(file.name)
        if found and _has_ended(int(found[1])):
            disk.remove(file)


def is_scratch(file: Path) -> bool:
    """Whether a file may be lost: a lock, or a partial file."""
    return file == lock_file(file.parent) or PARTIAL.fullmatch(file.name) is not None


def _has_ended(number: int) -> bool:
    """Whether there is no process of this number; False on Windows, which has no signal that only asks."""
    try:
        if os.name != "nt":
            os.kill(number, 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        pass
    return False
