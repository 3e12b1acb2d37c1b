"""What every benchmark needs: best-of-n times, the machine's matrix rate, and a table."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch

__all__ = ["best_seconds", "format_table", "sgemm_rate"]


def best_seconds(work: Callable[[], object], *, repeats: int = 5) -> float:
    """Least wall-clock seconds of ``repeats`` calls after one warm-up call.

    The minimum, because other processes can only ever make a run slower.
    """
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return min(times)


@torch.inference_mode()
def sgemm_rate(width: int = 512, *, rows: int = 2048, device: torch.device | str = "cpu", repeats: int = 20) -> float:
    """Measured float32 matrix-product rate ``(rows, width) @ (width, width)``, in FLOP/s: the limit of any SIREN."""
    a = torch.randn(rows, width, device=device)
    b = torch.randn(width, width, device=device)
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
