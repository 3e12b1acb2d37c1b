"""Who writes a run, or a file: a lock beside it that names the process, for as long as it writes.

Two things hold a lock: the kernel's lock of the file, which ends with its process whatever ends that, and what the file
says, for file systems and machines that the kernel's lock does not reach. The first makes sure that of two who find a
lock of the dead only one takes it over.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from ...neural_fields import InputError

__all__ = ["Holder", "check_unlocked", "is_running", "lock_file", "locked"]

# A lock is made and filled in two steps; one that stays empty for so many seconds belongs to nobody.
FILLED_WITHIN = 1.0
GRABBED_WITHIN = 0.3  # who only looks holds it for a moment
STILL_ACTIVE = 259  # what Windows says of a process that has not ended


@dataclass(frozen=True)
class Holder:
    """Who holds a lock.

    Attributes:
        pid: the process.
        host: its machine.
        since: local time, ISO 8601.
        started: when the process began, by its machine's own count; None where that is not known. Numbers of processes
            are used again, these are not.
    """

    pid: int
    host: str
    since: str
    started: int | None = None

    @staticmethod
    def this_process() -> Holder:
        """Who asks, now."""
        since = datetime.now().astimezone().isoformat(timespec="seconds")
        return Holder(os.getpid(), socket.gethostname(), since, _started(os.getpid()))

    @property
    def gone(self) -> bool:
        """Whether it was a process of this machine that has ended; of other machines nobody knows."""
        if self.host != socket.gethostname():
            return False
        return not is_running(self.pid) or (self.started is not None and _started(self.pid) != self.started)


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
        raise _in_use(target, file, holder)


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Be the only one who writes a run directory, or a file, until the block ends.

    A lock whose process has died on this machine is taken over.

    Raises:
        InputError: somebody else writes there, or the lock cannot be made.
    """
    file = lock_file(target)
    try:
        descriptor = _taken(target, file)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{file}: cannot be written ({reason}); choose another place") from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes nothing that is open; whoever comes next finds nobody's lock
            if _is_same(descriptor, file):
                file.unlink()
        os.close(descriptor)


def _taken(target: Path, file: Path) -> int:
    """Take the lock → its open file.

    Raises:
        InputError: somebody else has it.
        OSError: it cannot be made.
    """
    patience = time.monotonic() + GRABBED_WITHIN
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            grabbed = _grab(descriptor)
            if grabbed and _is_same(descriptor, file):
                holder = _holder(file, filled_within=0.0)  # nobody fills it while we have it
                if holder is not None and not holder.gone:
                    raise _in_use(target, file, holder)
                os.ftruncate(descriptor, 0)
                os.write(descriptor, json.dumps(asdict(Holder.this_process())).encode())
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
        if not grabbed and time.monotonic() > patience:
            raise _in_use(target, file, _holder(file))
        time.sleep(0.01)


def _in_use(target: Path, file: Path, holder: Holder | None) -> InputError:
    who = "another process" if holder is None else f"process {holder.pid} on {holder.host} since {holder.since}"
    return InputError(
        f"{target}: is being written by {who}; wait until it ends, choose another -o, or remove {file} if it has ended"
    )


def _grab(descriptor: int) -> bool:
    """Take the kernel's lock of a file, if nobody has it; what has no such locks is everybody's."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(descriptor, 1 << 30, os.SEEK_SET)  # far behind what others read
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)
    return True


def _is_same(descriptor: int, file: Path) -> bool:
    """Whether the file is still the one that was opened: who held it before may have removed it since."""
    try:
        return os.path.samestat(os.fstat(descriptor), file.stat())
    except FileNotFoundError:
        return False


def _holder(file: Path, filled_within: float | None = None) -> Holder | None:
    """Who holds a lock; None if nobody does, or the file is not one."""
    patience = time.monotonic() + (FILLED_WITHIN if filled_within is None else filled_within)
    while True:
        try:
            facts = json.loads(file.read_text(encoding="utf-8"))
            return Holder(int(facts["pid"]), str(facts["host"]), str(facts["since"]), facts.get("started"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError):
            if time.monotonic() > patience:
                return None
            time.sleep(0.05)


def _started(pid: int) -> int | None:
    """When a process of this machine began, in ticks since the machine did; None where Linux is not there to say so."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
        return int(text.rpartition(")")[2].split()[19])  # the name before it may hold anything
    except (OSError, ValueError, IndexError):
        return None


def is_running(pid: int) -> bool:
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
