"""What a table is, and how its rows come from items and the figures that are wanted of them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

T = TypeVar("T")
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


# A column, and what stands in it of an item.
Figure = tuple[Column, Callable[[T], Value]]


def tabulated(
    name: str,
    title: str,
    head: str,
    figures: Sequence[Figure[T]],
    items: Iterable[tuple[str, T]],
    *,
    published: Callable[[T], tuple[Value, ...] | None] = lambda _: None,
    about: Callable[[T], tuple[str, str]] = lambda _: ("", ""),
    more: Iterable[Row] = (),
    notes: Iterable[str] = (),
) -> Table:
    """A table with one row per item.

    Args:
        name: see `Table`.
        title: see `Table`.
        head: see `Table`.
        figures: the columns, and what stands in them.
        items: each with the name of its row.
        published: what the paper says of an item; values that it lacks at the end may be left out.
        about: source of an item's method, and what differs from it here.
        more: rows below.
        notes: see `Table`.

    Example:
        >>> table = tabulated("t", "Squares", "n", [(Column("n²", "d"), lambda n: n * n)], [("two", 2)])
        >>> table.rows[0].values
        (4,)
    """
    rows = []
    for row, item in items:
        printed = published(item)
        if printed is not None:
            printed = (*printed, *[None] * (len(figures) - len(printed)))
        rows.append(Row(row, tuple(of(item) for _, of in figures), printed, *about(item)))
    return Table(name, title, head, tuple(column for column, _ in figures), (*rows, *more), tuple(notes))


def ratio(above: float | None, below: float | None) -> float | None:
    """``above / below``; None where either is missing or the second is zero."""
    return above / below if above is not None and below else None


def mean(values: Iterable[float | None]) -> float | None:
    """Of the numbers that there are; None of none."""
    numbers = [value for value in values if value is not None]
    return statistics.fmean(numbers) if numbers else None


def median(values: Iterable[float | None]) -> float | None:
    """Of the numbers that there are; None of none."""
    numbers = [value for value in values if value is not None]
    return statistics.median(numbers) if numbers else None
