"""Plots of figures over named places, written as SVG by matplotlib (extra ``bench``)."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from importlib.util import find_spec

from mplicits.neural_fields import InputError

SIZE = (9.0, 5.0)  # inches
TILTED = 80  # characters of all labels, from which on they are tilted
COLUMNS = 4  # of the legend


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


def check_matplotlib() -> None:
    """See that plots can be drawn, before the long work.

    Raises:
        InputError: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise InputError("plots need matplotlib; pip install 'mplicits[bench]'")


def to_svg(plot: Plot) -> str:
    """Draw a plot; the same plot gives the same text.

    Raises:
        ValueError: there is nothing in it to draw.
    """
    if all(value is None for series in plot.series for value in series.values):
        raise ValueError(f"{plot.name}: no values")
    import matplotlib as mpl
    from matplotlib.figure import Figure

    # Text stays text, and ids in the file do not change from one run to the next.
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": plot.name}):
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.add_subplot(yscale="log", title=plot.title, ylabel=plot.label)
        for series in plot.series:
            known = [(index, value) for index, value in enumerate(series.values) if value is not None]
            x, y = [index for index, _ in known], [value for _, value in known]
            axes.plot(x, y, "o-" if plot.lines else "o", label=series.name, alpha=0.85)
        tilted = sum(map(len, plot.places)) > TILTED
        axes.set_xticks(range(len(plot.places)), plot.places, rotation=35 if tilted else 0)
        axes.set_xlim(-0.5, len(plot.places) - 0.5)
        axes.grid(axis="y", color="#ddd")
        figure.legend(loc="outside lower left", ncols=COLUMNS, frameon=False)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
        return file.getvalue()
