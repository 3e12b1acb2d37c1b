"""Tables of points (text, NPY, NPZ, PLY, PCD, LAS): what their columns hold, and clouds that are read in pieces."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ..point_cloud import PointCloud, colors_from, normals_from

Triple = tuple[int, int, int]


class Layout(NamedTuple):
    """Columns of a table by what they hold."""

    points: Triple  # numbers of the columns x, y, z
    normals: Triple | None = None
    colors: Triple | None = None


class RawRows(NamedTuple):
    """Points as a file holds them: ``(n, 3)`` each, of any type of number."""

    points: NDArray[Any]  # may hold NaN
    normals: NDArray[Any] | None  # of any length
    colors: NDArray[Any] | None  # see `colors_from`


@dataclass(frozen=True)
class Table:
    """Columns of numbers as a file holds them: arrays ``(N,)``, or one array ``(N, C)``."""

    path: Path
    columns: Sequence[NDArray[Any]] | NDArray[Any]
    names: Sequence[str] | None = None  # as the file has them; None where it has none
    where: str = ""  # place in the file, for messages (``"line 3: "``)
    notes: tuple[str, ...] = ()  # what else the reader left out, for the report

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.columns.shape[1] if isinstance(self.columns, np.ndarray) else len(self.columns)

    def pick(self, which: Sequence[int]) -> NDArray[Any]:
        """Some columns side by side, ``(N, len(which))``."""
        if isinstance(self.columns, np.ndarray):
            first, run = which[0], list(range(which[0], which[0] + len(which)))
            return self.columns[:, first : first + len(which)] if list(which) == run else self.columns[:, list(which)]
        return np.stack([self.columns[k] for k in which], axis=1)

    def rows(self, layout: Layout) -> RawRows:
        """The points, and the normals and colours where there are any."""
        normals, colors = (None if which is None else self.pick(which) for which in (layout.normals, layout.colors))
        return RawRows(self.pick(layout.points), normals, colors)


# Names without case, units, marks, and the words `_FILLERS`; what comes first counts.
_NAMES = {
    "points": ("x y z", "px py pz", "easting northing elevation", "easting northing height", "e n h", "0 1 2"),
    "normals": ("nx ny nz", "xn yn zn", "normal0 normal1 normal2", "normals0 normals1 normals2"),
    "colors": ("red green blue", "r g b", "rf gf bf", "rgb0 rgb1 rgb2", "colors0 colors1 colors2"),
}
_FILLERS = re.compile(
    r"scalar|cartesian|diffuse|vertex|points?|position|pos|coordinates?|coord|color|colour|channel|value"
)


def _plain(name: str) -> str:
    """``"Normal X"``, ``NormalX``, ``normal_x``, ``N_x`` → ``nx``; ``"X [m]"`` → ``x``; ``"Red (0-255)"`` → ``red``."""
    name = re.sub(r"[\[({<].*?[\])}>]", "", name.strip().strip("\"'")).casefold()
    name = re.sub(r"[^a-z0-9]|(?<=[a-z_ ])(8|16)$", "", name)  # red_16
    name = re.sub(r"^(normals?|norm)(?=[xyz]$)|(?<=^[xyz])(normals?|norm)$", "n", name)
    return _FILLERS.sub("", name) or name


def named_layout(names: Sequence[str]) -> Layout | None:
    """Columns by their names, in any order; None if x, y and z are not among them."""
    plain = [_plain(name) for name in names]

    def place(name: str) -> int:  # of two that differ by case or marks, that with the plainest name
        return names.index(name) if name in names else plain.index(name)

    def find(what: str) -> Triple | None:
        for triple in map(str.split, _NAMES[what]):
            if all(name in plain for name in triple):
                x, y, z = map(place, triple)
                return x, y, z
        return None

    points = find("points")
    return None if points is None else Layout(points, find("normals"), find("colors"))


def choose_layout(table: Table, columns: str | None = None, *, scanner: bool = False) -> Layout:
    """Columns by request (``x,y,z,nx,ny,nz,r,g,b,-``), by name, or by position where the values allow one reading.

    Without names, x, y and z come first. Then come unit normals, colours (fractions, or whole numbers of 8 or 16 bits,
    perhaps with opacity), and at most one more column. In a ``scanner``'s file (PTS), intensity comes before colours.
    """
    if columns is not None:
        return _requested(table, columns)
    if table.names is not None:
        if (layout := named_layout(table.names)) is None:
            listed = ", ".join(table.names[:20])
            raise InputError(
                f"{table.path}: {table.where}no columns x, y and z among {listed}; name them: --columns x,y,z,-"
            )
        return layout
    return _guessed(table, scanner=scanner)


def _requested(table: Table, columns: str) -> Layout:
    names = [name.strip() for name in columns.split(",")]
    if (layout := named_layout(names)) is None:
        raise InputError(f"--columns {columns}: expected x, y and z among the names, such as x,y,z,nx,ny,nz,r,g,b,-")
    if len(names) != table.width:
        raise InputError(f"{table.path}: {table.where}{table.width} columns, but --columns names {len(names)}")
    return layout


def sampled(rows: NDArray[Any], most: int = 100_000, *, run: int = 1000) -> NDArray[Any]:
    """At most ``most`` rows, in runs at even distances: of rows that are mapped from a file, few pages are read."""
    if len(rows) <= most:
        return rows
    starts = np.linspace(0, len(rows) - run, most // run).astype(np.int64)
    return np.concatenate([rows[start : start + run] for start in starts])


def _guessed(table: Table, *, scanner: bool) -> Layout:
    width = table.width
    if width < 3:
        raise InputError(f"{table.path}: {table.where}{width} columns; expected x y z, and perhaps more")
    head = np.asarray(table.pick([0])[:1000, 0], np.float64)
    if width > 3 and len(head) > 2 and head[0] in (0, 1) and bool((np.diff(head) == 1).all()):
        raise _unclear(table, "the first column counts the rows")
    readings = _readings(sampled(table.pick(range(width))).astype(np.float64), 3)
    most = max((reading.explained for reading in readings), default=0)
    best = [reading for reading in readings if reading.explained == most]
    if scanner and len(best) > 1:
        best = [max(best, key=lambda reading: reading.colors or (0, 0, 0))]  # in PTS intensity comes before colours
    if len(best) != 1:
        why = "can be read in several ways" if best else "are neither unit normals nor colours"
        raise _unclear(table, f"without names, columns 4 to {width} {why}")
    return Layout((0, 1, 2), best[0].normals, best[0].colors)


def _unclear(table: Table, why: str) -> InputError:
    names = ["x", "y", "z", "nx", "ny", "nz", "r", "g", "b", *["-"] * table.width][: table.width]
    hint = f"name all columns, - for one to ignore: --columns {','.join(names)}"
    return InputError(f"{table.path}: {table.where}{table.width} columns; {why}; {hint}")


class _Reading(NamedTuple):
    """One way to read columns: how many of them have a meaning, and which."""

    explained: int = 0
    normals: Triple | None = None
    colors: Triple | None = None
    others: int = 0


def _readings(rows: NDArray[np.float64], at: int) -> list[_Reading]:
    """All ways to read the columns from ``at`` on as normals, colours, zeros, and at most one other number."""
    width = rows.shape[1]
    if at == width:
        return [_Reading()]
    found = [r._replace(others=1) for r in _readings(rows, at + 1) if not r.others]
    if at + 3 > width:
        return found
    three, triple = rows[:, at : at + 3], (at, at + 1, at + 2)
    following = _readings(rows, at + 3)
    if not three.any():  # a place holder: neither black nor a direction
        found += [r._replace(explained=r.explained + 3) for r in following]
    elif _are_normals(three):
        found += [r._replace(explained=r.explained + 3, normals=triple) for r in following if r.normals is None]
    elif _are_colors(three):
        found += [r._replace(explained=r.explained + 3, colors=triple) for r in following if r.colors is None]
        if at + 3 < width and bool((rows[:, at + 3] == rows[0, at + 3]).all()):  # opacity
            after = _readings(rows, at + 4)
            found += [r._replace(explained=r.explained + 4, colors=triple) for r in after if r.colors is None]
    return found


def _are_normals(three: NDArray[np.float64]) -> bool:
    """Whether at least 95 % of the rows that are finite and not zero have a length of 1 ± 0.05."""
    lengths = np.linalg.norm(three[np.isfinite(three).all(axis=1)], axis=1)
    lengths = lengths[lengths > 0]
    return len(lengths) > 0 and bool((np.abs(lengths - 1) < 0.05).mean() >= 0.95)


def _are_colors(three: NDArray[np.float64]) -> bool:
    """Whether all three channels are fractions (a little below 0 or above 1 too), or whole numbers of 8 or 16 bits."""
    finite = three[np.isfinite(three).all(axis=1)]
    if not len(finite):
        return False
    low, high = finite.min(), np.quantile(finite, 0.999, axis=0)
    if low > -0.1 and high.max() <= 1.1:
        return True
    whole = low >= 0 and bool((finite % 1 == 0).all())
    return whole and (finite.max() <= 255 or (finite.max() <= 65535 and high.min() > 255))


def cloud_from(table: Table, layout: Layout) -> PointCloud:
    """The cloud in these columns, with one line about each column."""
    points, normals, colors = table.rows(layout)
    return PointCloud(
        np.ascontiguousarray(points, np.float64),
        None if normals is None else normals_from(normals),
        None if colors is None else colors_from(colors),
        str(table.path),
        reading=describe_layout(table, layout, len(points)),
    )


def describe_layout(table: Table, layout: Layout, count: int) -> str:
    """One line: the number of points, the columns of normals and colours, and the columns that are ignored."""
    names = [f"column {k + 1}" for k in range(table.width)] if table.names is None else table.names
    used = {"normals": layout.normals, "colors": layout.colors}
    parts = [f"{count:,} points"]
    parts += [f"{what} from {', '.join(names[k] for k in which)}" for what, which in used.items() if which is not None]
    taken = {*layout.points, *(layout.normals or ()), *(layout.colors or ())}
    if others := [name for k, name in enumerate(names) if k not in taken]:
        parts.append(f"ignored: {', '.join(others[:8])}" + f" and {len(others) - 8} more" * (len(others) > 8))
    return "; ".join([*parts, *table.notes])


class CloudStream(ABC):
    """A cloud that is read in pieces, as often as needed."""

    source: str  # the name used in messages
    count: int  # points in the file; pieces may leave some of them out
    reading: str = ""  # see `PointCloud`

    @abstractmethod
    def pieces(self, rows: int) -> Iterator[RawRows]:
        """All points in their order, up to ``rows`` at a time."""


class MemoryStream(CloudStream):
    """A cloud that is in memory already."""

    def __init__(self, cloud: PointCloud) -> None:
        self.cloud, self.source, self.count, self.reading = cloud, cloud.source, len(cloud), cloud.reading

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        arrays = (self.cloud.points, self.cloud.normals, self.cloud.colors)
        for start in range(0, self.count, rows):
            points, normals, colors = (None if a is None else a[start : start + rows] for a in arrays)
            assert points is not None
            yield RawRows(points, normals, colors)


class TableStream(CloudStream):
    """Rows of one size in a file, which are mapped into memory one piece at a time.

    ``offset`` is the byte at which the rows begin. ``row`` is the type of a row: a structure, or ``(">f4", (6,))``.
    """

    def __init__(self, table: Table, *, offset: int, row: np.dtype[Any], count: int, layout: Layout) -> None:
        path = table.path
        if path.stat().st_size < offset + count * row.itemsize:
            raise InputError(
                f"{path}: vertex: the file ends before its {count} rows do (truncated?); copy or export it again"
            )
        self.path, self.source, self.count = path, str(path), count
        self.reading = describe_layout(table, layout, count)
        self.offset, self.row, self.layout = offset, row, layout

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`; the pages of a piece are given back when its arrays go."""
        for start in range(0, self.count, rows):
            at = self.offset + start * self.row.itemsize
            raw = np.memmap(self.path, self.row, "r", at, (min(rows, self.count - start),))
            names = raw.dtype.names
            yield Table(self.path, raw if names is None else [raw[name] for name in names]).rows(self.layout)
