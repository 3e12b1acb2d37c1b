"""Files that are written whole or not at all, and folders that are listed without what is being written."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .errors import InputError

__all__ = ["files_in", "whole_file", "write_json", "write_whole"]


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A temporary file beside ``path``, for the block to write, that takes its name when the block ends.

    It has the extension of ``path``, by which many writers choose the format. After an error or Ctrl-C it is gone, and
    an older file is as it was.

    Raises:
        InputError: the block, or the renaming, raised an OSError: the disk is full, the folder is gone.

    Example:
        >>> with whole_file("mesh.ply") as partial:
        ...     write_slowly(partial)  # doctest: +SKIP
    """
    path = Path(path)
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot be written ({reason}); choose another place") from error
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write bytes, or text in UTF-8 with its line ends as they are, through `whole_file`.

    Raises:
        InputError: see `whole_file`.
    """
    with whole_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: str | Path, data: Any) -> None:
    """Write data as JSON, indented by two, through `whole_file`.

    Raises:
        InputError: see `whole_file`.
    """
    write_whole(path, json.dumps(data, indent=2) + "\n")


def files_in(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """What a folder holds with one of these extensions (lower case), by name; not half-written files, nor macOS's own.

    Both of these have names that begin with a dot.
    """
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.name[0] != ".")
