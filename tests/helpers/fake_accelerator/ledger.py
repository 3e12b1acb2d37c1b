"""The kernels that a workload launches on the device, and the moments at which the host waits for them."""

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

ROOT = Path(__file__).parents[3]
OURS = tuple(f"{ROOT / name}/" for name in ("neural_fields", "datasets", "pipelines"))
# Frames of these say nothing about who asked.
UNDER = (f"{Path(torch.__file__).parent}/", f"{Path(__file__).parent}/")


@dataclass
class Ledger:
    """Counts of one workload.

    Attributes:
        waits: how often the host waited, by reason and line. Reasons are ``item`` (a number is read), ``size`` (a
            shape depends on numbers), ``download`` and ``upload`` (copies to and from the host that block).
        launches: kernels by name of the operation, one each; views and allocations launch none.
    """

    waits: Counter[tuple[str, str]] = field(default_factory=Counter)
    launches: Counter[str] = field(default_factory=Counter)

    @property
    def synchronisations(self) -> int:
        return self.waits.total()

    @property
    def kernels(self) -> int:
        return self.launches.total()

    def report(self, count: int = 20) -> str:
        """The most frequent waits, a line each."""
        return "\n".join(f"{times:6d}  {why:8}  {where}" for (why, where), times in self.waits.most_common(count))


_open: list[Ledger] = []


@contextmanager
def counted() -> Iterator[Ledger]:
    """Count launches and waits inside the ``with``; ledgers may be open inside each other."""
    ledger = Ledger()
    _open.append(ledger)
    try:
        yield ledger
    finally:
        _open.remove(ledger)


def note_launch(name: str) -> None:
    for ledger in _open:
        ledger.launches[name] += 1


def note_wait(why: str) -> None:
    if _open:
        where = _asking_line()
        for ledger in _open:
            ledger.waits[why, where] += 1


def _asking_line() -> str:
    """The innermost line of the library, else of whoever is neither torch nor we; autograd's threads have neither."""
    frame, other = sys._getframe(1), ""
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(OURS):
            return f"{Path(name).relative_to(ROOT)}:{frame.f_lineno}"
        if not other and not name.startswith(UNDER) and not name.endswith("contextlib.py"):
            other = f"{Path(name).name}:{frame.f_lineno}"
        frame = frame.f_back
    return other or "autograd"
