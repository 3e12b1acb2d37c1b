"""The most memory that this process has held."""

from __future__ import annotations

import sys
from pathlib import Path

__all__ = ["peak_memory"]

# Linux keeps the high-water mark of a process here. Not getrusage: its maximum survives exec, so that a child would
# report what its parent held when it was born.
STATUS = Path("/proc/self/status")


def peak_memory() -> int | None:
    """Largest resident set of this process so far, in bytes; None where the system does not keep it (Windows)."""
    try:
        status = STATUS.read_text(encoding="ascii")
    except OSError:
        status = ""
    for line in status.splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
