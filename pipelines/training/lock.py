"""One writer at a time for a run directory or a file: an operating-system lock, which ends with its process.

The lock file stays, empty: removing it would let two processes hold locks of two files of one name.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ...neural_fields import InputError


def lock_file(target: Path) -> Path:
    """The lock of a run directory, which lies in it, or of a file, beside it."""
    return target / "run.lock" if target.is_dir() else target.with_suffix(".lock")


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Be the only writer of a run directory, or of a file, until the block ends.

    Raises:
        InputError: another process writes there, or the lock cannot be made.
    """
    file = lock_file(target)
    if not file.parent.is_dir():
        raise InputError(f"{file}: cannot be written (no such folder); choose another place")
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"{target}: is being written by another process; wait until it ends, or choose another -o"
        ) from error
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror or error}); choose another place") from error
    try:
        yield
    finally:
        lock.release()


def check_unlocked(target: Path) -> None:
    """Refuse a run directory, or a file, that another process writes.

    Raises:
        InputError: see `locked`.
    """
    if lock_file(target).is_file():
        with locked(target):
            pass
