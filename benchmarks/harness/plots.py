"""Plots as SVG, written by hand: small, sharp at any size, and readable by a test."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass
from itertools import pairwise

__all__ = ["Plot", "Series", "across", "ticks", "to_svg", "up"]

WIDTH, HEIGHT = 720.0, 400.0
LEFT, RIGHT, TOP, BOTTOM = 78.0, 14.0, 40.0, 84.0
COLORS = ("#1b6ca8", "#d1495b", "#edae49", "#66a182", "#6f4a8e", "#8d6a4a", "#3a3a3a", "#5bbcd6", "#a3a500", "#e377c2")
LEGEND_STEP, LEGEND_ROW = 158.0, 18.0
LEGEND_COLUMNS = 4
CHARACTER = 7.0  # about its width
LONGEST = 12  # characters of a tilted label


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
        lines: whether the marks of a series are joined, over gaps as well.

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
    """Powers of ten from below ``low`` to above ``high``, and 2 and 5 times them where they would be few.

    Example:
        >>> ticks(2e-5, 3e-2)
        [1e-05, 0.0001, 0.001, 0.01, 0.1]
        >>> ticks(2.5, 40.0)
        [2.0, 5.0, 10.0, 20.0, 50.0]
    """
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    steps = (1, 2, 5) if last - first < 3 else (1,)
    marks = [float(f"{step}e{power}") for power in range(first, last + 1) for step in steps]
    below = max((i for i, mark in enumerate(marks) if mark <= low), default=0)
    above = min((i for i, mark in enumerate(marks) if mark >= high), default=len(marks) - 1)
    return marks[below : max(above, below + 1) + 1]


def across(index: int, count: int) -> float:
    """Horizontal middle of one of ``count`` places."""
    return LEFT + (index + 0.5) / count * (WIDTH - LEFT - RIGHT)


def up(value: float, low: float, high: float) -> float:
    """Vertical place of a value on the logarithmic axis from ``low`` (bottom) to ``high`` (top)."""
    share = (math.log10(value) - math.log10(low)) / (math.log10(high) - math.log10(low))
    return HEIGHT - BOTTOM - share * (HEIGHT - BOTTOM - TOP)


def to_svg(plot: Plot) -> str:
    """Draw a plot.

    Raises:
        ValueError: there is nothing in it to draw.
    """
    values = [value for series in plot.series for value in series.values if value is not None]
    if not values:
        raise ValueError(f"{plot.name}: no values")
    marks = ticks(min(values), max(values))
    rows = math.ceil(len(plot.series) / LEGEND_COLUMNS)
    height = HEIGHT + LEGEND_ROW * (rows - 1)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {height:g}" font-family="sans-serif" '
        'font-size="12" fill="#333">',
        f'<rect width="{WIDTH:g}" height="{height:g}" fill="#fff"/>',
        _text(LEFT, 22, plot.title, size=14),
        f'<text transform="translate(16 {(HEIGHT - BOTTOM + TOP) / 2:g}) rotate(-90)" text-anchor="middle">'
        f"{html.escape(plot.label)}</text>",
    ]
    for mark in marks:
        y = up(mark, marks[0], marks[-1])
        parts.append(_line(LEFT, y, WIDTH - RIGHT, y, "#ddd"))
        parts.append(_text(LEFT - 6, y + 4, f"{mark:.0e}", anchor="end"))
    tilted = max(map(len, plot.places)) * CHARACTER > (WIDTH - LEFT - RIGHT) / len(plot.places)
    for index, place in enumerate(plot.places):
        x = across(index, len(plot.places))
        if tilted:
            parts.append(
                f'<text transform="translate({x + 4:.1f} {HEIGHT - BOTTOM + 14:g}) rotate(-35)" text-anchor="end" '
                f'font-size="10">{html.escape(_short(place))}</text>'
            )
        else:
            parts.append(_text(x, HEIGHT - BOTTOM + 18, place, anchor="middle"))
    for number, series in enumerate(plot.series):
        parts += _series(plot, series, COLORS[number % len(COLORS)], marks)
        x = LEFT + number % LEGEND_COLUMNS * LEGEND_STEP
        y = HEIGHT - 12 + number // LEGEND_COLUMNS * LEGEND_ROW
        parts.append(f'<circle cx="{x:g}" cy="{y - 4:g}" r="4" fill="{COLORS[number % len(COLORS)]}"/>')
        parts.append(_text(x + 9, y, series.name, size=11))
    return "\n".join([*parts, "</svg>", ""])


def _series(plot: Plot, series: Series, color: str, marks: list[float]) -> list[str]:
    """Dots, and with ``plot.lines`` lines between neighbours that both are there."""
    dots = [
        (across(index, len(plot.places)), up(value, marks[0], marks[-1])) if value is not None else None
        for index, value in enumerate(series.values)
    ]
    lines = []
    if plot.lines:
        known = [dot for dot in dots if dot is not None]
        lines = [_line(*a, *b, color, width=1.5) for a, b in pairwise(known)]
    title = html.escape(series.name)
    return lines + [
        f'<circle cx="{dot[0]:.1f}" cy="{dot[1]:.1f}" r="4" fill="{color}" fill-opacity="0.85">'
        f"<title>{title}, {html.escape(place)}: {value:.3g}</title></circle>"
        for dot, place, value in zip(dots, plot.places, series.values, strict=True)
        if dot is not None
    ]


def _short(name: str) -> str:
    """A name that fits between the axis and the legend."""
    return name if len(name) <= LONGEST else name[: LONGEST - 1] + "…"


def _line(x0: float, y0: float, x1: float, y1: float, color: str, *, width: float = 1.0) -> str:
    return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{color}" stroke-width="{width:g}"/>'


def _text(x: float, y: float, text: str, *, anchor: str = "start", size: int = 12) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}">{html.escape(text)}</text>'
