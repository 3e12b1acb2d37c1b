"""The machine under a run: its device, versions, speed and memory; and tables of what was measured on it."""

from __future__ import annotations

import functools
import importlib.metadata
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from ...neural_fields import InputError

# Linux keeps the high-water mark of a process here. Not getrusage: its maximum survives exec, so that a child would
# report what its parent held when it was born.
STATUS = Path("/proc/self/status")

_version = functools.cache(importlib.metadata.version)  # it reads files, and every record of a run asks


def best_seconds(work: Callable[[], object], *, repeats: int = 5, median: bool = False) -> float:
    """Least wall-clock seconds of ``repeats`` calls after a warm-up: other processes can only make a run slower.

    The ``median`` is for where it is their effect that is to be seen.
    """
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times) if median else min(times)


@torch.inference_mode()
def sgemm_rate(width: int = 512, *, rows: int = 2048, device: torch.device | str = "cpu", repeats: int = 20) -> float:
    """Measured float32 matrix-product rate ``(rows, width) @ (width, width)``, in FLOP/s: the limit of any SIREN."""
    random = torch.Generator().manual_seed(0)  # of its own: who measures in between draws the same afterwards
    a = torch.randn(rows, width, generator=random).to(device)
    b = torch.randn(width, width, generator=random).to(device)
    out = torch.empty(rows, width, device=device)
    return 2 * rows * width * width / best_seconds(lambda: torch.mm(a, b, out=out), repeats=repeats)


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Text in aligned columns, the first to the left and the others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, ["-" * width for width in widths], *rows]:
        cells = [
            cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


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


def choose_device(name: str, *, option: str = "--device") -> torch.device:
    """The device of this name; ``auto`` is CUDA where there is a working GPU, the CPU elsewhere.

    Raises:
        InputError: no such device here; the message names the ``option``.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{option} {name}: not usable here ({reason}); use auto or cpu") from error
    return device


def environment(device: torch.device) -> dict[str, Any]:
    """What the figures of a run depend on: versions, threads, machine."""
    names = ("mplicits", "torch", "numpy", "scipy", "safetensors")
    return {
        "versions": {name: _version(name) for name in names},
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "cpu_count": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
    }
