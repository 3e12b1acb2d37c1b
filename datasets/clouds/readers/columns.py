"""Which columns of a table hold points, normals and colours: by their names, or by what their values can be.

All table formats (text, NPY, NPZ, PLY, PCD, LAS) use the same rules, and all report them in one line.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ..point_cloud import PointCloud, colors_from, normals_from

__all__ = ["Layout", "Table", "Triple", "choose_layout", "cloud_from", "describe_layout", "named_layout", "sampled"]

Triple = tuple[int, int, int]


class Layout(NamedTuple):
    """Columns of a table by what they hold.

    Attributes:
        points: numbers of the columns x, y, z.
        normals: those of the normals, or None.
        colors: those of red, green and blue, or None.
        guessed: whether the values decided, since there are no names.
    """

    points: Triple
    normals: Triple | None = None
    colors: Triple | None = None
    guessed: bool = False


@dataclass(frozen=True)
class Table:
    """Columns of numbers as a file holds them.

    Attributes:
        path: the file.
        columns: arrays ``(N,)``, one per column, or one array ``(N, C)``.
        names: of the columns, as the file has them; None where it has none.
        where: place in the file, for messages (``"line 3: "``).
        notes: what else the reader left out, for the report.
    """

    path: Path
    columns: Sequence[NDArray[Any]] | NDArray[Any]
    names: Sequence[str] | None = None
    where: str = ""
    notes: tuple[str, ...] = ()

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


# Names without case, units, marks, and the words `_FILLERS`; what comes first counts.
_NAMES = {
    "points": ("x y z", "px py pz", "easting northing elevation", "easting northing height", "e n h"),
    "normals": ("nx ny nz", "xn yn zn", "normal0 normal1 normal2"),
    "colors": ("red green blue", "r g b", "red8 green8 blue8", "r8 g8 b8", "red16 green16 blue16", "r16 g16 b16"),
}
_FILLERS = re.compile(
    r"scalar|cartesian|diffuse|vertex|point|position|pos|coordinates?|coord|color|colour|channel|value"
)


def _plain(name: str) -> str:
    """``"Normal X"``, ``NormalX``, ``normal_x``, ``N_x`` → ``nx``; ``"X [m]"`` → ``x``; ``"Red (0-255)"`` → ``red``."""
    name = re.sub(r"[\[({<].*?[\])}>]", "", name.strip().strip("\"'")).casefold()
    name = re.sub(r"[^a-z0-9]", "", name)
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
    """Columns by request, by name, or by position where the values allow only one reading.

    Without names, x, y and z come first. What follows is normals of unit length, colours (fractions, or whole numbers
    up to 255 or 65535), and at most one more column; opacity may follow colours.

    Args:
        table: the columns, or some rows of them.
        columns: names of all columns, separated by commas, ``-`` for one to ignore: ``x,y,z,nx,ny,nz,r,g,b,-``.
        scanner: whether the file is a scanner's (PTS), in which intensity comes before colours.

    Raises:
        InputError: ``columns`` does not fit, x, y or z is missing, or the values allow no reading, or several.
    """
    if columns is not None:
        return _requested(table, columns)
    if table.names is not None:
        layout = named_layout(table.names)
        if layout is None:
            listed = ", ".join(table.names[:20])
            raise InputError(
                f"{table.path}: {table.where}no columns x, y and z among {listed}; name them: --columns x,y,z,-"
            )
        return layout
    return _guessed(table, scanner=scanner)


def _requested(table: Table, columns: str) -> Layout:
    names = [name.strip() for name in columns.split(",")]
    layout = named_layout(names)
    if layout is None:
        raise InputError(f"--columns {columns}: expected x, y and z among the names, such as x,y,z,nx,ny,nz,r,g,b,-")
    if len(names) != table.width:
        raise InputError(f"{table.path}: {table.where}{table.width} columns, but --columns names {len(names)}")
    return layout


def sampled(rows: NDArray[Any], most: int = 100_000) -> NDArray[Any]:
    """At most ``most`` rows, evenly chosen."""
    return rows[:: 1 + len(rows) // most]


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
    return Layout((0, 1, 2), best[0].normals, best[0].colors, guessed=True)


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
    """The cloud in these columns, with one line about what became of each."""
    normals = None if layout.normals is None else normals_from(table.pick(layout.normals))
    colors = None if layout.colors is None else colors_from(table.pick(layout.colors))
    points = np.ascontiguousarray(table.pick(layout.points), np.float64)
    reading = describe_layout(table, layout, len(points))
    return PointCloud(points, normals, colors, str(table.path), reading=reading)


def describe_layout(table: Table, layout: Layout, count: int) -> str:
    """One line: how many points, where normals and colours come from, and what is ignored."""
    names = [f"column {k + 1}" for k in range(table.width)] if table.names is None else table.names
    used = {"normals": layout.normals, "colors": layout.colors}
    parts = [f"{count:,} points"]
    parts += [f"{what} from {', '.join(names[k] for k in which)}" for what, which in used.items() if which is not None]
    taken = {*layout.points, *(layout.normals or ()), *(layout.colors or ())}
    others = [name for k, name in enumerate(names) if k not in taken]
    if others:
        parts.append(f"ignored: {', '.join(others[:8])}" + f" and {len(others) - 8} more" * (len(others) > 8))
    return "; ".join([*parts, *table.notes])
