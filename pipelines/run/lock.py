"""Who writes a run, or a file: a lock beside it that names the process, for as long as it writes."""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from ...neural_fields import InputError

__all__ = ["Holder", "check_unlocked", "lock_file", "locked"]

# A lock is made and filled in two steps; one that stays empty for so many seconds belongs to nobody.
FILLED_WITHIN = 1.0
STILL_ACTIVE = 259  # what Windows says of a process that has not ended


@dataclass(frozen=True)
class Holder:
    """Who holds a lock.

    Attributes:
        pid: the process.
        host: its machine.
        since: local time, ISO 8601.
    """

    pid: int
    host: str
    since: str

    @staticmethod
    def this_process() -> Holder:
        """Who asks, now."""
        return Holder(os.getpid(), socket.gethostname(), datetime.now().astimezone().isoformat(timespec="seconds"))

    @property
    def gone(self) -> bool:
        """Whether it was a process of this machine that has ended; of other machines nobody knows."""
        return self.host == socket.gethostname() and not _runs(self.pid)


def lock_file(target: Path) -> Path:
    """The lock of a run directory, which lies in it, or of a file, beside it."""
    return target / "run.lock" if target.is_dir() else target.with_suffix(".lock")


def check_unlocked(target: Path) -> None:
    """Refuse a run directory, or a file, that somebody writes.

    Raises:
        InputError: names it and who writes it.
    """
    file = lock_file(target)
    holder = _holder(file)
    if holder is not None and not holder.gone:
        raise InputError(
            f"{target}: is being written by process {holder.pid} on {holder.host} since {holder.since}; wait until "
            f"it ends, choose another -o, or remove {file} if it has ended"
        )


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Be the only one who writes a run directory, or a file, until the block ends.

    A lock whose process has died on this machine is taken over.

    Raises:
        InputError: somebody else writes there, or the lock cannot be made.
    """
    file, mine = lock_file(target), Holder.this_process()
    while True:
        try:
            with file.open("x", encoding="utf-8") as new:
                json.dump(asdict(mine), new)
            break
        except FileExistsError:
            check_unlocked(target)
            file.unlink(missing_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{file}: cannot be written ({reason}); choose another place") from error
    try:
        yield
    finally:
        if _holder(file) == mine:
            file.unlink(missing_ok=True)


def _holder(file: Path) -> Holder | None:
    """Who holds a lock; None if nobody does, or the file is not one."""
    patience = time.monotonic() + FILLED_WITHIN
    while True:
        try:
            facts = json.loads(file.read_text(encoding="utf-8"))
            return Holder(int(facts["pid"]), str(facts["host"]), str(facts["since"]))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError):
            if time.monotonic() > patience:
                return None
            time.sleep(0.05)


def _runs(pid: int) -> bool:
    """Whether a process of this machine has not ended."""
    if sys.platform == "win32":  # where signal 0 is Ctrl-C
        import ctypes

        kernel, code = ctypes.windll.kernel32, ctypes.c_ulong()
        process = kernel.OpenProcess(0x1000, False, pid)  # PROCESS_QUERY_LIMITED_INFORMATION
        found = bool(process) and kernel.GetExitCodeProcess(process, ctypes.byref(code)) and code.value == STILL_ACTIVE
        kernel.CloseHandle(process)
        return bool(found)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # somebody else's
    return True
