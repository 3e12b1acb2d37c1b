"""Plots as SVG, written by hand: small, sharp at any size, and readable by a test."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Plot", "Series", "ticks"]

WIDTH, HEIGHT = 720.0, 400.0
LEFT, RIGHT, TOP, BOTTOM = 78.0, 14.0, 40.0, 84.0
COLORS = ("#1b6ca8", "#d1495b", "#edae49", "#66a182", "#6f4a8e", "#8d6a4a", "#3a3a3a", "#5bbcd6", "#a3a500", "#e377c2")
LEGEND_STEP = 118.0
LEGEND_COLUMNS = 5


@dataclass(frozen=True)
class Series:
    """One set of marks.

    Attributes:
        name: in the legend.
        values: one per place on the horizontal axis; None where there is none.
    """

    name: str
    values: tuple[float | None, ...]


@dataclass(frozen=True)
class Plot:
    """Figures over named places, on a logarithmic vertical axis.

    Attributes:
        name: of its file.
        title: above it.
        places: labels of the horizontal axis, at even distances.
        series: what is drawn.
        label: of the vertical axis.
        lines: whether the marks of a series are joined.

    Raises:
        ValueError: a series has another number of values than there are places, or one is not positive.
    """

    name: str
    title: str
    places: tuple[str, ...]
    series: tuple[Series, ...]
    label: str
    lines: bool = False

    def __post_init__(self) -> None:
        for series in self.series:
            if len(series.values) != len(self.places):
                raise ValueError(f"{series.name}: {len(series.values)} values for {len(self.places)} places")
            if any(value is not None and not 0 < value < math.inf for value in series.values):
                raise ValueError(f"{series.name}: {series.values}; a logarithmic axis takes finite numbers > 0")


def ticks(low: float, high: float) -> list[float]:
    """Powers of ten around ``[low, high]``, and 2 and 5 times them where they are few.

    Example:
        >>> ticks(2e-5, 3e-3)
        [1e-05, 0.0001, 0.001, 0.01]
        >>> ticks(2.5, 4.0)
        [2.0, 5.0]
    """
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first < 2 else (1,)
    marks = [float(f"{step}e{power}") for power in range(first, last + 1) for step in steps]
    below = max((i for i, mark in enumerate(marks) if mark <= low), default=0)
    above = min((i for i, mark in enumerate(marks) if mark >= high), default=len(marks) - 1)
    return marks[below : max(above, below + 1) + 1]
