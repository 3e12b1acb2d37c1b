"""Files that are written whole or not at all, and folders that are listed without what is being written.

All that must survive a kill or a full disk goes through `write`, `sync`, `rename` and `remove`, so that tests can make
each of these operations fail, or be the last one of a process (`tests/faults.py`).
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError


def write(path: Path, content: bytes) -> None:
    """Write a file, and wait until the disk has it."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(folder: Path) -> None:
    """Wait until the disk has the names in a folder; does nothing on Windows, where folders cannot be opened."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename(path: Path, target: Path) -> None:
    """Give a file another name; a file of that name is replaced."""
    path.replace(target)


def remove(path: Path) -> None:
    """Remove a file, if it is there."""
    path.unlink(missing_ok=True)


def check_place(path: str | Path) -> None:
    """Whether a file or folder can come to be at ``path``, to be asked before any long work.

    Folders that are missing on the way will be made by what writes there. Nothing is made now.

    Raises:
        InputError: what shall be a folder on the way is a file, or may not be written.
    """
    above = Path(path).absolute().parent
    while not (above.exists() or above.is_symlink()):  # the root is there at the latest
        above = above.parent
    if not above.is_dir():
        raise InputError(f"{path}: {above} is no folder; choose another place")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"{path}: the folder {above} may not be written; choose another place")


_LONG_WORD = re.compile(r"\S{200,}")  # of a file, quoted: what it says is clear from its beginning


@contextmanager
def damage(path: str | Path, remedy: str) -> Iterator[None]:
    """A block that reads a file which others made: whatever it trips over becomes one line, and nothing else is said.

    Numbers that overflow are those of the file; whoever reads it says of results what must be said. The
    exception itself is kept as the cause.

    Args:
        path: the file, which the message names.
        remedy: what to do about it.

    Raises:
        InputError: the block raised anything that is no `InputError`.
    """
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except InputError as error:
        line = _LONG_WORD.sub(lambda word: word[0] if word[0] in str(path) else f"{word[0][:40]}…", str(error))
        if line == str(error):
            raise
        raise InputError(line) from error
    except MemoryError as error:
        raise InputError(f"{path}: claims more than fits into the memory; {remedy}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check its permissions") from error
    except Exception as error:
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: damaged ({type(error).__name__}: {reason}); {remedy}") from error


def partial_of(path: Path) -> Path:
    """What ``path`` is called while it is written: hidden, with the number of the process and the same extension."""
    return path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A temporary file beside ``path``, for the block to write, that takes its name when the block ends.

    It has the extension of ``path``, by which many writers choose the format. After an error or Ctrl-C it is gone, and
    an older file is as it was. Folders that are missing on the way are made.

    Raises:
        InputError: the block, or the renaming, raised an OSError: the disk is full, a folder is a file.

    Example:
        >>> with whole_file("mesh.ply") as partial:
        ...     write_slowly(partial)  # doctest: +SKIP
    """
    path = Path(path)
    partial = partial_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            rename(partial, path)
        finally:
            remove(partial)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be written ({reason}); choose another place") from error


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write bytes, or text in UTF-8 with its line ends as they are, through `whole_file`.

    Raises:
        InputError: see `whole_file`.
    """
    with whole_file(path) as partial:
        write(partial, content.encode() if isinstance(content, str) else content)


def json_bytes(data: Any) -> bytes:
    """Data as JSON, indented by two."""
    return (json.dumps(data, indent=2) + "\n").encode()


def write_json(path: str | Path, data: Any) -> None:
    """Write data as `json_bytes` through `whole_file`.

    Raises:
        InputError: see `whole_file`.
    """
    write_whole(path, json_bytes(data))


def natural(name: str) -> tuple[list[str | int], str]:
    """A key that sorts names with their numbers as numbers: ``2.png`` comes before ``10.png``."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)], name


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """What a folder holds with one of these extensions (lower case), in natural order of names; no hidden files."""
    files = (file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.name[0] != ".")
    return sorted(files, key=lambda file: natural(file.name))
