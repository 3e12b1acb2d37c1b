"""Files that are written whole or not at all.

All that must survive a kill or a full disk goes through `write`, `sync`, `rename` and `remove`; tests let them fail.
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
    """Write a file, and wait until it is on the disk."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(folder: Path) -> None:
    """Wait until the names in a folder are on the disk; nothing on Windows, which cannot open folders."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def rename(path: Path, target: Path) -> None:
    """Rename a file; one of that name is replaced."""
    path.replace(target)


def remove(path: Path) -> None:
    """Remove a file, if it exists."""
    path.unlink(missing_ok=True)


def check_place(path: str | Path) -> None:
    """Raise InputError unless a file or folder can be made at ``path``; makes nothing."""
    above = Path(path).absolute().parent
    while not (above.exists() or above.is_symlink()):  # the root is there at the latest
        above = above.parent
    if not above.is_dir():
        raise InputError(f"{path}: {above} is no folder; choose another place")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"{path}: the folder {above} may not be written; choose another place")


_LONG_WORD = re.compile(r"\S{200,}")  # quoted from a file; cut in messages


@contextmanager
def damage(path: str | Path, remedy: str) -> Iterator[None]:
    """Turn any error of a block that reads the file ``path`` into one line, with ``remedy`` as the fix.

    Warnings and floating-point errors are silenced. Raises InputError; the original error is its cause.
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
    """The name of ``path`` while it is written: hidden, with the process id and the same extension."""
    return path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A temporary file beside ``path`` for the block to write, renamed to ``path`` when the block ends.

    It has the extension of ``path``. After an error or Ctrl-C it is removed, and an older file stays as it was. Missing
    folders are made. Raises InputError for any OSError.

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
    """Write bytes, or text as UTF-8, through `whole_file`."""
    with whole_file(path) as partial:
        write(partial, content.encode() if isinstance(content, str) else content)


def json_bytes(data: Any) -> bytes:
    """Data as JSON, indented by two."""
    return (json.dumps(data, indent=2) + "\n").encode()


def write_json(path: str | Path, data: Any) -> None:
    """Write data as `json_bytes` through `whole_file`."""
    write_whole(path, json_bytes(data))


def natural(name: str) -> tuple[list[str | int], str]:
    """A sort key that compares numbers in names as numbers: ``2.png`` before ``10.png``."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)], name


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of these lower-case extensions, in natural order; no hidden ones."""
    files = (file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.name[0] != ".")
    return sorted(files, key=lambda file: natural(file.name))
