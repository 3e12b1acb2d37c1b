"""PLY: any vertex type and order, lists, elements before and after the vertices.

Format: G. Turk, "The PLY Polygon File Format", 1994. An ASCII body is decoded as a binary one of doubles.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ....neural_fields.backend.files import write_whole
from ....neural_fields.meshing.mesh import ply_header, ply_vertices
from ..point_cloud import PointCloud
from .columns import Table, TableStream, choose_layout, cloud_from
from .meshes import as_mesh, strips, triangulate
from .tables import is_number

_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_INDICES = ("vertex_indices", "vertex_index")
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    length_kind: str | None  # of a list: the type of its length


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


@dataclass(frozen=True)
class _Lists:
    """One list per row."""

    lengths: NDArray[np.int64]  # (n,)
    items: NDArray[Any]  # of all lists


_Columns = dict[str, "NDArray[Any] | _Lists"]


def read_ply(path: Path, columns: str | None = None) -> PointCloud:
    """The vertices of a PLY file; if they have no normals but the file has faces, with those of the mesh."""
    return _read(path, columns, meshes=False)[0]


def read_ply_mesh(path: Path) -> tuple[PointCloud, NDArray[np.int64]]:
    """The vertices and the triangles ``(F, 3)`` of a PLY file; of polygons, fans. There may be none."""
    return _read(path, None, meshes=True)


def _read(path: Path, columns: str | None, *, meshes: bool) -> tuple[PointCloud, NDArray[np.int64]]:
    """Vertices and faces; without ``meshes``, no faces where the vertices have normals of their own."""
    data = path.read_bytes()
    encoding, elements, body = _parse_header(data, path)
    order = _ORDERS[encoding]
    if encoding == "ascii":
        data, body = _ascii_to_doubles(data[body:], path), 0
    cloud: PointCloud | None = None
    faces = [np.empty((0, 3), np.int64)]
    for element in elements:
        stored = _as_doubles(element) if encoding == "ascii" else element
        found, body = _decode(data, body, stored, order, path)
        if element.name == "vertex":
            scalars = {p.name: _restore(found[p.name], p) for p in element.properties if p.length_kind is None}
            table = Table(path, list(scalars.values()), list(scalars), "vertex: ")
            cloud = cloud_from(table, choose_layout(table, columns))
            if not meshes and cloud.normals is not None:
                break  # nothing that follows is needed
        elif _has_faces(element):
            faces.append(_faces(found, strips if element.name == "tristrips" else triangulate))
    if cloud is None:
        raise InputError(f"{path}: vertex: the header declares no such element; export it as a point cloud")
    triangles = np.concatenate(faces)
    return as_mesh(cloud, triangles) if len(triangles) else cloud, triangles


def _has_faces(element: _Element) -> bool:
    """Whether rows are faces: by the usual names of the element, or of a list in it."""
    lists = (p.name.lower() for p in element.properties if p.length_kind)
    return element.name in ("face", "tristrips") or any(name in _INDICES for name in lists)


def _faces(
    columns: _Columns, cut: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.int64]]
) -> NDArray[np.int64]:
    """Triangles ``(F, 3)`` from the list of vertices: the one of the usual name, or else the first."""
    lists = {name.lower(): column for name, column in columns.items() if isinstance(column, _Lists)}
    usual = [lists[name] for name in _INDICES if name in lists]
    found = usual or [column for name, column in lists.items() if "tex" not in name]
    return cut(found[0].lengths, found[0].items.astype(np.int64)) if found else np.empty((0, 3), np.int64)


def ply_stream(path: Path, columns: str | None = None) -> TableStream | None:
    """The vertices of a PLY file in pieces; None if only `read_ply` can read it.

    The file must be binary. Its vertices must come first, hold no lists, and have normals if there are faces.
    """
    with path.open("rb") as file:
        head = file.read(1 << 20)  # longer headers are left to `read_ply`
    if b"end_header" not in head:
        return None
    encoding, elements, body = _parse_header(head, path)
    vertex = elements[0] if elements else _Element("", 0, [])
    names = [p.name for p in vertex.properties]
    if encoding == "ascii" or vertex.name != "vertex" or any(p.length_kind for p in vertex.properties):
        return None
    if len(set(names)) < len(names):
        return None
    row = np.dtype([(p.name, _ORDERS[encoding] + p.kind) for p in vertex.properties])
    table = Table(path, [np.empty(0, row[k]) for k in range(len(names))], names, "vertex: ")
    layout = choose_layout(table, columns)
    if layout.normals is None and any(map(_has_faces, elements)):
        return None
    return TableStream(table, offset=body, row=row, count=vertex.count, layout=layout)


def write_cloud_ply(path: str | Path, cloud: PointCloud) -> None:
    """Write ``cloud`` as binary little-endian PLY with double coordinates; an existing file is replaced at the end."""
    rows = ply_vertices(cloud.points, cloud.normals, cloud.colors, double=True)
    write_whole(path, ply_header(rows.dtype, len(rows)) + rows.tobytes())


def _parse_header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    if not re.match(rb"ply[ \t]*[\r\n]", data):
        raise InputError(f"{path}: does not start with 'ply', so it is not a PLY file; check its extension")
    if (end := re.search(rb"(?<=[\r\n])end_header[ \t]*(\r\n|\n|\r)", data)) is None:
        raise InputError(f"{path}: end_header is missing, so the header is cut off; export it again")
    encoding = ""
    elements: list[_Element] = []
    for number, line in enumerate(data[: end.start()].decode("ascii", "replace").splitlines()[1:], start=2):
        words = line.split()
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    continue
                case ["format", name, *_] if name in _ORDERS:
                    encoding = name
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name.lower(), int(count), []))
                case ["property", "list", length_kind, kind, name]:
                    elements[-1].properties.append(_Property(name, _KINDS[kind], _KINDS[length_kind]))
                case ["property", kind, name]:
                    elements[-1].properties.append(_Property(name, _KINDS[kind], None))
                case _:
                    raise ValueError(line)
        except (ValueError, KeyError, IndexError) as error:
            raise InputError(
                f"{path}: header line {number}: {line.strip()[:80]!r} is not valid PLY; export it again"
            ) from error
    if not encoding:
        raise InputError(f"{path}: format: missing from the header; expected one of {', '.join(_ORDERS)}")
    return encoding, elements, end.end()


def _ascii_to_doubles(body: bytes, path: Path) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # what numpy < 2.3 gives instead of a ValueError
        try:
            return np.fromstring(body.decode("ascii"), np.float64, sep=" ").astype("<f8").tobytes()
        except (ValueError, DeprecationWarning) as error:
            raise InputError(f"{path}: {_first_bad_word(body)} in an ascii PLY; export it again") from error


def _first_bad_word(body: bytes) -> str:
    for number, line in enumerate(body.decode("ascii", "replace").splitlines(), start=1):
        for word in line.split():
            if "," in word or not is_number(word):
                return f"line {number} after the header: {word[:40]!r} is not a number"
    return "something is not a number"


def _as_doubles(element: _Element) -> _Element:
    doubles = [_Property(p.name, "f8", "f8" if p.length_kind else None) for p in element.properties]
    return _Element(element.name, element.count, doubles)


def _restore(column: NDArray[Any] | _Lists, declared: _Property) -> NDArray[Any]:
    """Give a scalar column its declared type back (an ASCII body was read as doubles)."""
    assert isinstance(column, np.ndarray)
    # A double written into an ascii "float" property keeps its digits: people do write map coordinates so.
    return column if declared.kind[0] == "f" else column.astype(declared.kind)


def _decode(data: bytes, start: int, element: _Element, order: str, path: Path) -> tuple[_Columns, int]:
    """Read all rows of ``element`` from ``data[start:]`` → columns by name, and where the rows end."""
    if element.count == 0 or not element.properties:
        return {p.name: np.empty(0, p.kind) for p in element.properties}, start
    # Before anything is made of it: each row takes its numbers, and a list its length, at the least.
    least = sum(np.dtype(p.length_kind or p.kind).itemsize for p in element.properties)
    if element.count > (len(data) - start) // least:
        raise _cut_off(path, element)
    try:
        uniform = _decode_uniform(data, start, element, order)
        return uniform if uniform is not None else _decode_ragged(data, start, element, order)
    except (ValueError, IndexError) as error:
        raise _cut_off(path, element) from error


def _cut_off(path: Path, element: _Element) -> InputError:
    return InputError(
        f"{path}: {element.name}: the file ends before its {element.count:.6g} rows do (truncated?); "
        "copy or export it again"
    )


def _list_length(data: bytes, at: int, kind: str, item: str) -> int:
    """The length of the list that begins at ``at``; a ValueError if the rest of the file cannot hold it."""
    length = float(np.frombuffer(data, kind, 1, at)[0])
    left = len(data) - at - np.dtype(kind).itemsize
    if not (length.is_integer() and 0 <= length <= left // np.dtype(item).itemsize):
        raise ValueError(f"a list of {length:g} items")
    return int(length)


def _decode_uniform(data: bytes, start: int, element: _Element, order: str) -> tuple[_Columns, int] | None:
    """Decode rows that are all as long as the first one; None if they are not."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    at = start
    for number, p in enumerate(element.properties):
        if p.length_kind is None:
            fields.append((f"{number}", order + p.kind))
            at += np.dtype(p.kind).itemsize
            continue
        length = _list_length(data, at, order + p.length_kind, p.kind)
        fields += [(f"{number}#", order + p.length_kind), (f"{number}", order + p.kind, (length,))]
        at += np.dtype(p.length_kind).itemsize + length * np.dtype(p.kind).itemsize
    row = np.dtype(fields)
    if any(p.length_kind for p in element.properties) and start + row.itemsize * element.count > len(data):
        return None
    rows = np.frombuffer(data, row, element.count, start)
    columns: _Columns = {}
    for number, p in enumerate(element.properties):
        column = rows[f"{number}"]
        if p.length_kind is None:
            columns[p.name] = column.astype(p.kind)
            continue
        lengths = rows[f"{number}#"].astype(np.int64)
        if bool((lengths != lengths[0]).any()):
            return None
        columns[p.name] = _Lists(lengths, column.reshape(-1).astype(p.kind))
    return columns, start + row.itemsize * element.count


def _decode_ragged(data: bytes, start: int, element: _Element, order: str) -> tuple[_Columns, int]:
    """Decode row by row: where each row starts depends on all rows before it."""
    values: list[list[NDArray[Any]]] = [[] for _ in element.properties]
    at = start
    for _ in range(element.count):
        for column, p in zip(values, element.properties, strict=True):
            length = 1
            if p.length_kind is not None:
                length = _list_length(data, at, order + p.length_kind, p.kind)
                at += np.dtype(p.length_kind).itemsize
            column.append(np.frombuffer(data, order + p.kind, length, at) if length else np.empty(0, p.kind))
            at += length * np.dtype(p.kind).itemsize
    columns: _Columns = {}
    for column, p in zip(values, element.properties, strict=True):
        items = np.concatenate(column).astype(p.kind)
        columns[p.name] = items if p.length_kind is None else _Lists(np.array([len(c) for c in column]), items)
    return columns, at
