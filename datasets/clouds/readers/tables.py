"""Tables of points: text (XYZ, TXT, CSV), one NumPy array (NPY), or an archive of named ones (NPZ).

A table has 3, 6 or 9 columns, or a header line that names them.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ...files import DAMAGED_ARRAYS, numeric, read_arrays
from ..point_cloud import PointCloud, colors_from, columns_of, normals_from
from .stream import TableStream

__all__ = ["is_number", "npy_stream", "numbers", "read_npy", "read_npz", "read_text", "table_to_cloud"]


def read_text(path: Path) -> PointCloud:
    """Read a text table; columns are separated by commas, semicolons, tabs or spaces; ``#`` starts a comment.

    Columns are xyz, xyz + normal, xyz + rgb (see :func:`table_to_cloud`) or xyz + normal + rgb, unless a header
    line names x, y and z: then columns are taken by name and others are ignored. A lone count in the first
    line is skipped.

    Raises:
        InputError: it is not text, a word is not a number, or the number of columns is not one of these.
    """
    data = path.read_bytes()
    if b"\0" in data:
        raise InputError(f"{path}: holds binary data, not text; check its extension")
    lines = data.decode("utf-8-sig", "replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    filled = ((number, _strip(line)) for number, line in enumerate(lines) if _strip(line))
    first, line = next(filled, (0, ""))
    second = next(filled, (0, ""))[1]
    if not line:
        raise InputError(f"{path}: holds only comments and blank lines; export it again")
    # "1,5;2,5;3,5": with semicolons between columns, a comma is a decimal comma
    commas = "." if ";" in (second or line) else " "
    words = line.replace(";", " ").replace(",", commas).split()
    has_header = not all(is_number(word) for word in words)
    is_count = len(words) == 1 and len(re.split(r"[\s,;]+", second)) >= 3
    skipped = first + 1 if has_header or is_count else first
    body = "\n".join(lines[skipped:]).replace("//", "#").replace(",", commas).replace(";", " ")
    table = numbers(body, path, first_line=skipped + 1, what="line")
    if has_header:
        named = _by_name(re.split(r"[\s,;]+", line.lower()), table, path)
        if named is not None:
            return named
    return table_to_cloud(table, path, f"line {skipped + 1}: ")


def table_to_cloud(table: NDArray[np.floating], path: Path, where: str) -> PointCloud:
    """Split ``(N, 3 | 6 | 9)`` into xyz, xyz + normal, xyz + normal + rgb.

    Six columns are xyz + rgb when the last three cannot be unit vectors but can be colours from 0 to 255:
    none is negative and few have unit length.

    Raises:
        InputError: there is another number of columns.
    """
    columns = table.shape[1] if table.ndim == 2 else 0
    if columns not in (3, 6, 9):
        raise InputError(f"{path}: {where}{columns} columns; expected 3 (xyz), 6 (xyz, normal) or 9 (xyz, normal, rgb)")
    points = np.ascontiguousarray(table[:, :3], np.float64)
    extra = table[:, 3:6]
    if columns == 6 and _look_like_colors(extra):
        return PointCloud(points, None, colors_from(extra), str(path))
    normals = extra.astype(np.float32) if columns >= 6 else None
    colors = colors_from(table[:, 6:]) if columns == 9 else None
    return PointCloud(points, normals, colors, str(path))


def numbers(body: str, path: Path, *, first_line: int, what: str) -> NDArray[np.float64]:
    """Parse a table of white-space separated numbers → ``(N, columns)``.

    Raises:
        InputError: a word is not a number, or a line has another number of columns; names the line.
    """
    if not re.search(r"^[ \t]*[^#\s]", body, re.MULTILINE):
        raise InputError(f"{path}: no numbers in it; export it again")
    try:
        return np.loadtxt(io.StringIO(body), np.float64, comments="#", ndmin=2)
    except ValueError as error:
        problem = _diagnose(body, first_line, what)
        raise InputError(f"{path}: {problem or error}; correct or delete it") from error


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
    """Whether a word can be read as a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _look_like_colors(values: NDArray[np.floating]) -> bool:
    finite = values[np.isfinite(values).all(axis=1)]
    if len(finite) == 0 or finite.min() < 0 or finite.max() > 255:
        return False
    lengths = np.linalg.norm(finite, axis=1)
    # zero stands for "no normal" as well as for black
    return bool((np.abs(lengths - 1) < 0.05).sum() < 0.5 * (lengths > 0).sum() or finite.max() > 1.5)


def _by_name(names: list[str], table: NDArray[np.float64], path: Path) -> PointCloud | None:
    def pick(what: str) -> NDArray[np.float64] | None:
        triple = columns_of(names, what)
        return None if triple is None else table[:, [names.index(name) for name in triple]]

    names = [name.strip("\"'") for name in names if name.strip("\"'")]
    points = pick("points")
    if points is None or len(names) != table.shape[1]:
        return None
    normals, colors = pick("normals"), pick("colors")
    return PointCloud(
        np.ascontiguousarray(points),
        None if normals is None else normals.astype(np.float32),
        None if colors is None else colors_from(colors),
        str(path),
    )


def read_npy(path: Path) -> PointCloud:
    """Read one array with columns xyz, xyz + normal or xyz + normal + rgb.

    Raises:
        InputError: it is not a NumPy array of numbers with 3, 6 or 9 columns.
    """
    array = read_arrays(path)
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path}: an NPZ archive under another name; rename it to .npz")
    return table_to_cloud(numeric(array, f"{path}: array"), path, f"array of shape {array.shape}: ")


def npy_stream(path: Path, *, sample: int = 100_000) -> TableStream | None:
    """The rows of an array, to be read in pieces; None if that cannot be: only `read_npy` reads such a file.

    Args:
        path: an NPY file.
        sample: so many rows, evenly chosen, tell whether six columns are points and normals or points and colours.

    Raises:
        InputError: see `read_npy`.
    """
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except DAMAGED_ARRAYS:
        return None
    if array.ndim != 2 or not array.flags.c_contiguous or len(array) == 0:
        return None
    numeric(array, f"{path}: array")
    some = table_to_cloud(np.array(array[:: 1 + len(array) // sample]), path, f"array of shape {array.shape}: ")
    first_color = None if some.colors is None else array.shape[1] - 3
    return TableStream(
        path,
        offset=array.offset,
        row=np.dtype((array.dtype, array.shape[1:])),
        count=len(array),
        points=slice(0, 3),
        normals=None if some.normals is None else slice(3, 6),
        colors=None if first_color is None else slice(first_color, first_color + 3),
    )


def read_npz(path: Path) -> PointCloud:
    """Read ``points`` (N, 3), ``normals`` (float, or int8/int16 over their largest value) and ``colors``.

    Raises:
        InputError: it is not such an archive, or an array has the wrong type or shape.
    """

    def choose(names: list[str]) -> list[str]:
        if "points" not in names:
            raise InputError(f"{path}: points: no such array (there are: {', '.join(names) or 'none'}); add it")
        return [name for name in ("points", "normals", "colors") if name in names]

    arrays = read_arrays(path, choose)
    if isinstance(arrays, np.ndarray):
        raise InputError(f"{path}: a single NumPy array under another name; rename it to .npy")
    points = arrays["points"]
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: points: shape {points.shape}; expected (N, 3)")
    for name, array in arrays.items():
        numeric(array, f"{path}: {name}")
        if array.shape != points.shape:
            raise InputError(f"{path}: {name}: shape {array.shape}; expected {points.shape}, one row per point")
    normals, colors = arrays.get("normals"), arrays.get("colors")
    return PointCloud(
        points.astype(np.float64),
        None if normals is None else normals_from(normals),
        None if colors is None else colors_from(colors),
        str(path),
    )
