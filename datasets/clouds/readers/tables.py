"""Tables of points: text (XYZ, TXT, ASC, CSV, PTS), one NumPy array (NPY), or an archive of named ones (NPZ)."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ...files import DAMAGED_ARRAYS, decoded, numeric, read_arrays
from ..point_cloud import PointCloud
from .columns import Table, TableStream, choose_layout, cloud_from, named_layout, sampled

_MARKS = re.compile(r"^\s*(//|[#;%!])[#;%!/\s]*")  # before a comment


def read_text(path: Path, columns: str | None = None) -> PointCloud:
    """A text table with commas, semicolons, tabs or spaces between columns, which a header or ``--columns`` names.

    A line before the numbers may name the columns (see `choose_layout`). The counts of points in PTS files are skipped.
    """
    text = re.sub(r'"([-+]?[.,]?\d[-+.,\deE]*)"', r"\1", decoded(path.read_bytes()))  # numbers may be quoted
    if "\0" in text:
        raise InputError(f"{path}: holds binary data, not text; check its extension")
    lines = text.split("\n")
    heads, count, skipped = [], False, 0
    for skipped, line in enumerate(lines):  # noqa: B007 (where the loop stopped is wanted)
        words = re.split(r"[\s,;]+", _strip(line).strip(",; \t"))
        if _MARKS.match(line) or not any(map(is_number, words)):
            heads.append(_MARKS.sub("", line).strip())
        elif len(words) == 1 and not count:
            count = True
        else:
            break
    first = _strip(lines[skipped])
    if not first:
        raise InputError(f"{path}: no numbers in it; export it again")
    separator, decimal = _dialect(first)
    body = "\n".join([*lines[skipped:], ""])
    if (s := separator) in (",", ";") and any(mark in body for mark in (s + s, f"{s} {s}", f"\n{s}", f"{s}\n")):
        body = re.sub(rf"^ *(?={s})|(?<={s}) *(?={s}|$)", "nan", body, flags=re.MULTILINE)  # empty fields
    if count:
        body = re.sub(r"^[ \t]*\d+[ \t]*$", "", body, flags=re.MULTILINE)
    if any(mark in body for mark in ";%!"):
        body = re.sub(r"^[ \t]*[;%!]", "#", body, flags=re.MULTILINE)
    body = body.replace("//", "#").replace(",", decimal).replace(";", " ")
    rows = numbers(body, path, first_line=skipped + 1, what="line")
    names = next(filter(None, (_names(head, separator, rows.shape[1]) for head in reversed(heads))), None)
    if names is None and s in (",", ";") and np.isnan(rows[:, -1]).all():  # lines end with a separator
        rows = rows[:, :-1]
        names = next(filter(None, (_names(head, separator, rows.shape[1]) for head in reversed(heads))), None)
    table = Table(path, rows, names, f"line {skipped + 1}: ")
    return cloud_from(table, choose_layout(table, columns, scanner=path.suffix.lower() == ".pts" or count))


def _dialect(line: str) -> tuple[str | None, str]:
    """What separates the columns of a line (None: white space), and what its commas become."""
    if ";" in line:
        return ";", "."  # "1,5;2,5;3,5": a comma is a decimal comma
    words = line.split()
    if len(words) > 2 and all(re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", word) for word in words):
        return ("\t" if "\t" in line else None), "."
    return ("," if "," in line else "\t" if "\t" in line else None), " "


def _names(line: str, separator: str | None, width: int) -> list[str] | None:
    """The names in a line, if there are as many as columns and x, y and z are among them."""
    line = re.sub(r"^\w+\s*:\s*", "", line)  # "columns: x y z"
    joined = re.sub(r"\s*[\[({<][^\])}>]*[\])}>]", "", line)  # units would be words of their own
    word = r"\"[^\"]*\"|'[^']*'|[^\s\"',;]+"
    splits = [re.findall(word, joined)]
    if separator is not None:
        splits.insert(0, re.findall(rf"\"[^\"]*\"|'[^']*'|[^{separator}\"']+", line))
    for names in ([name.strip().strip("\"'") for name in split] for split in splits):
        names = names[:-1] if names and not names[-1] else names
        if len(names) == width and named_layout(names) is not None:
            return names
    return None


def numbers(body: str, path: Path, *, first_line: int, what: str) -> NDArray[np.float64]:
    """Parse a table of white-space separated numbers → ``(N, columns)``; an InputError names the line."""
    if not re.search(r"^[ \t]*[^#\s]", body, re.MULTILINE):
        raise InputError(f"{path}: no numbers in it; export it again")
    try:
        return np.loadtxt(io.StringIO(body), np.float64, comments="#", ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: {_diagnose(body, first_line, what) or error}; correct or delete it") from error


def _diagnose(body: str, first_line: int, what: str) -> str:
    """The first line that breaks the table."""
    columns = 0
    for number, line in enumerate(body.split("\n"), start=first_line):
        words = _strip(line).split()
        for word in words:
            if not is_number(word):
                return f"{what} {number}: {word[:40]!r} is not a number"
        if words and columns and len(words) != columns:
            return f"{what} {number}: {len(words)} columns where there were {columns} before"
        columns = len(words) or columns
    return ""


def _strip(line: str) -> str:
    return re.split("#|//", line, maxsplit=1)[0].strip()


def is_number(word: str) -> bool:
    """Whether a word can be read as a number; with a decimal comma too."""
    try:
        float(word.replace(",", ".", 1))
    except ValueError:
        return False
    return True


def read_npy(path: Path, columns: str | None = None) -> PointCloud:
    """One array ``(N, C)`` whose columns ``--columns`` names or their values show, or a structured one with names."""
    array = read_arrays(path)
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path}: an NPZ archive under another name; rename it to .npz")
    table = _array_table(path, array)
    return cloud_from(table, choose_layout(table, columns))


def _array_table(path: Path, array: NDArray[Any]) -> Table:
    where = f"array of shape {array.shape}: "
    if array.dtype.names is not None:
        return Table(
            path, [numeric(array[name].ravel(), f"{path}: {name}") for name in array.dtype.names], array.dtype.names
        )
    if numeric(array, f"{path}: array").ndim != 2:
        raise InputError(f"{path}: {where}expected rows of x y z, and perhaps more")
    return Table(path, array, None, where)


def npy_stream(path: Path, columns: str | None = None) -> TableStream | None:
    """The rows of an array in pieces; None if only `read_npy` can read it."""
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except DAMAGED_ARRAYS:
        return None
    if array.ndim != 2 or not array.flags.c_contiguous or len(array) == 0 or array.dtype.names is not None:
        return None
    table = _array_table(path, np.array(sampled(array)))
    layout = choose_layout(table, columns)
    row = np.dtype((array.dtype, array.shape[1:]))
    return TableStream(table, offset=array.offset, row=row, count=len(array), layout=layout)


# Names of arrays, without case and underscores, and the columns that they hold.
_ARRAYS = {
    **dict.fromkeys(("points", "point", "xyz", "positions", "pos", "vertices", "verts", "coords", "pts"), "xyz"),
    **dict.fromkeys(("pointcloud", "cloud", "data", "arr0"), "xyz"),
    **dict.fromkeys(("normals", "normal", "vertexnormals", "pointnormals"), ("nx", "ny", "nz")),
    **dict.fromkeys(("colors", "color", "colours", "colour", "rgb", "rgba", "vertexcolors"), ("r", "g", "b")),
}


def read_npz(path: Path, columns: str | None = None) -> PointCloud:
    """``points`` (N, 3), ``normals`` and ``colors``, or other usual names.

    Normals are float, or int8 or int16 over their largest value.
    """

    def known(name: str) -> tuple[str, ...]:
        return tuple(_ARRAYS.get(re.sub(r"[\W_]", "", name).casefold(), ()))

    ignored: list[str] = []

    def choose(names: list[str]) -> list[str]:
        roles = [known(name) for name in names]
        if ("x", "y", "z") not in roles:
            raise InputError(f"{path}: points: no such array (there are: {', '.join(names) or 'none'}); add it")
        ignored[:] = [name for name, role in zip(names, roles, strict=True) if not role]
        return [name for k, name in enumerate(names) if roles[k] and roles[k] not in roles[:k]]

    arrays = read_arrays(path, choose)
    if isinstance(arrays, np.ndarray):
        raise InputError(f"{path}: a single NumPy array under another name; rename it to .npy")
    names: list[str] = []
    values: list[NDArray[Any]] = []
    first = next(array for name, array in arrays.items() if known(name) == ("x", "y", "z"))
    if first.ndim != 2 or first.shape[1] < 3:
        raise InputError(f"{path}: points: shape {first.shape}; expected (N, 3)")
    if first.shape[1] > 3 and len(arrays) == 1:
        table = _array_table(path, first)
        return cloud_from(table, choose_layout(table, columns))
    for name, array in arrays.items():
        numeric(array, f"{path}: {name}")
        parts = known(name)
        if len(array) != len(first) or array.ndim != 2 or array.shape[1] not in (3, 3 + (parts[0] == "r")):
            raise InputError(f"{path}: {name}: shape {array.shape}; expected {first.shape}, one row per point")
        names += parts
        values += list(array.T[:3])
    table = Table(path, values, names, notes=(f"ignored arrays: {', '.join(ignored)}",) * bool(ignored))
    return cloud_from(table, choose_layout(table, columns))
