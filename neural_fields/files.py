"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import InputError

__all__ = ["whole_file", "write_whole"]


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
