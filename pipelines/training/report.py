"""What a training reports about its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """How far a stage of the work is.

    Attributes:
        stage: name of the stage.
        step: steps done.
        steps: steps planned; 0 for a stage that does not count steps.
        fraction: of the stage, in [0, 1]; not step / steps when a time budget may end it earlier.
        losses: unweighted loss terms of the last reported step.
    """

    stage: str
    step: int
    steps: int
    fraction: float
    losses: Mapping[str, float]


Report = Callable[[Progress], None]


def silent(_: Progress, /) -> None:
    """A `Report` that ignores everything."""


@contextmanager
def reported(report: Report | None, stage: str) -> Iterator[None]:
    """Report the beginning and the end of a stage that does not count steps."""
    report = report or silent
    report(Progress(stage, 0, 0, 0.0, {}))
    yield
    report(Progress(stage, 0, 0, 1.0, {}))
