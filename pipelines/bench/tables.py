"""What a table is: which cells it needs, and how rows come from their records. Nothing is trained here.

A record is what a cell found, as it stands in its JSON file::

    {"cell": {"shape": stem, "method", "preset", "seed", "noise", "outliers", "flipped", "overrides": {…}, …},
     "outputs": [{"name", "chamfer", "iou", …}, …],   # one per surface, coarse to fine
     "deltas": [δ_1, …], …}

A cell that failed has no record; tables say "–" where one is missing.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from .cells import Cell, Record
from .plots import Plot

if TYPE_CHECKING:
    from .cells import Preset

__all__ = [
    "Column",
    "Row",
    "Table",
    "TableSpec",
    "Value",
    "by_shape",
    "figure",
    "mean",
    "median",
    "of_output",
    "outputs_of",
    "printed_name",
    "ratio",
    "select",
    "shapes_of",
]

Value = float | int | str | None


@dataclass(frozen=True)
class Column:
    """One column of figures.

    Attributes:
        name: its heading.
        form: how numbers are written, as in `format`.
        best: which of the column is set in bold.
    """

    name: str
    form: str = ".2e"
    best: Literal["lowest", "highest"] | None = None


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        name: what the line is about.
        values: one per column; None where there is none.
        published: what the paper says in the same columns, or None where it says nothing.
        source: where the method comes from, in a few words.
        differs: what differs from its source here.
        competes: whether it may be the best of a column.
    """

    name: str
    values: tuple[Value, ...]
    published: tuple[Value, ...] | None = None
    source: str = ""
    differs: str = ""
    competes: bool = True


@dataclass(frozen=True)
class Table:
    """A finished table.

    Attributes:
        name: of its files, e.g. "comparison".
        title: one line above it.
        head: heading of the first column.
        columns: of figures.
        rows: of figures, each with one value per column.
        notes: what the reader should know, one sentence or two each.

    Raises:
        ValueError: a row has another number of values than there are columns.
    """

    name: str
    title: str
    head: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            for values in (row.values, row.published or row.values):
                if len(values) != len(self.columns):
                    raise ValueError(f"{self.name}: {row.name}: {len(values)} values for {len(self.columns)} columns")


@dataclass(frozen=True)
class TableSpec:
    """One table of the paper.

    Attributes:
        name: as after ``--table``.
        label: the paper's own, e.g. "Tab. 1 (t-comparison)".
        summary: what it shows, in one line.
        cells: the shapes and the preset → what must be trained. Seeds, references and the choice of methods are
            the harness's business.
        tables: the records of those cells, as many as there are → the tables.
        plots: the same → the plots.
        sheets: whether there is a contact sheet of its meshes per shape.
    """

    name: str
    label: str
    summary: str
    cells: Callable[[Sequence[Path], Preset], list[Cell]]
    tables: Callable[[Sequence[Record]], tuple[Table, ...]]
    plots: Callable[[Sequence[Record]], tuple[Plot, ...]] = lambda _: ()
    sheets: bool = False


def select(records: Iterable[Record], **wanted: Any) -> list[Record]:
    """The records whose cells have these fields; a field that is not named may be anything.

    ``overrides`` is compared as a dict: ``select(records, method="ours", noise=0.0, overrides={})``.
    """
    return [r for r in records if all(r["cell"][field] == value for field, value in wanted.items())]


def shapes_of(records: Iterable[Record]) -> list[str]:
    """Names of the shapes, each once, in their order."""
    return list(dict.fromkeys(record["cell"]["shape"] for record in records))


def outputs_of(records: Iterable[Record]) -> list[str]:
    """Names of the surfaces, each once, in their order."""
    return list(dict.fromkeys(output["name"] for record in records for output in record["outputs"]))


def of_output(records: Iterable[Record], name: str, figure: str) -> list[float | None]:
    """One figure of the surface called ``name`` in every record that has one; None where it was not found."""
    return [o.get(figure) for record in records for o in record["outputs"] if o["name"] == name]


def figure(records: Sequence[Record], name: str) -> float | None:
    """One figure of the finest surface of the first record; None where there is no record or no surface."""
    outputs = records[0]["outputs"] if records else []
    return outputs[-1].get(name) if outputs else None


def by_shape(records: Iterable[Record], output: str, name: str) -> dict[str, float | None]:
    """One figure of an output, by shape."""
    return {
        record["cell"]["shape"]: found.get(name)
        for record in records
        for found in record["outputs"]
        if found["name"] == output
    }


def ratio(above: float | None, below: float | None) -> float | None:
    """``above / below``; None where either is missing or the second is zero."""
    return above / below if above is not None and below else None


def printed_name(shape: str, names: Iterable[str]) -> str | None:
    """Which of the paper's shapes a file is, by its name.

    Example:
        >>> printed_name("Armadillo_50k", ["lucy", "armadillo"])
        'armadillo'
    """
    return next((name for name in names if name in shape.lower()), None)


def mean(values: Iterable[float | None]) -> float | None:
    """Of the numbers that there are; None of none."""
    numbers = [value for value in values if value is not None]
    return statistics.fmean(numbers) if numbers else None


def median(values: Iterable[float | None]) -> float | None:
    """Of the numbers that there are; None of none."""
    numbers = [value for value in values if value is not None]
    return statistics.median(numbers) if numbers else None
