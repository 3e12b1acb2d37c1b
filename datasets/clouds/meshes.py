"""A mesh as an oriented cloud: its vertices and their area-weighted normals; STL and OFF files.

Wavefront OBJ: vertices, their colours (``v x y z r g b``), normals and faces.

Read here and not with trimesh, which splits vertices at creases and seams and loses the normals of files without faces.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...neural_fields import InputError
from .point_cloud import PointCloud, colors_from, unit_rows
from .tables import numbers

__all__ = ["read_obj", "read_off", "read_stl", "triangulate", "vertex_normals", "weld"]


def read_stl(path: Path) -> PointCloud:
    """Read an STL file; equal corners of its loose triangles become one vertex.

    Raises:
        InputError: it is not STL or holds no triangle.
    """
    vertices, faces = _load(path, "stl")
    if len(faces) == 0:
        raise InputError(f"{path}: facets: there are none; check that it is an STL file")
    points, index = weld(vertices)
    faces = index[faces]
    return PointCloud(points, vertex_normals(points, faces), None, str(path), "mesh")


def read_off(path: Path) -> PointCloud:
    """Read an OFF file, with or without faces.

    Raises:
        InputError: it is not OFF.
    """
    vertices, faces = _load(path, "off")
    normals = vertex_normals(vertices, faces) if len(faces) else None
    return PointCloud(vertices, normals, None, str(path), "mesh" if len(faces) else "file")


def _load(path: Path, kind: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces as they stand in the file."""
    try:
        with path.open("rb") as file:
            loaded: Any = trimesh.load(file, file_type=kind, process=False)
    except Exception as error:  # trimesh lets through whatever its parsers trip over
        raise InputError(
            f"{path}: not a readable {kind.upper()} file; check its extension or export it again"
        ) from error
    vertices = np.asarray(getattr(loaded, "vertices", ()), np.float64)
    faces = np.asarray(getattr(loaded, "faces", ()), np.int64).reshape(-1, 3)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
        raise InputError(f"{path}: no vertices in it; check that it is a {kind.upper()} file")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"{path}: a face names a vertex beyond the {len(vertices)} there are; export it again")
    return vertices, faces


def weld(vertices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Merge exactly equal ``vertices`` ``(N, 3)`` → those left ``(M, 3)``, and each old one's new index ``(N,)``."""
    order = np.lexsort((vertices + 0.0).T)  # + 0.0: minus zero is zero
    ordered = vertices[order]
    first = np.ones(len(vertices), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    index = np.empty(len(vertices), np.int64)
    index[order] = np.cumsum(first) - 1
    return ordered[first], index


def triangulate(lengths: NDArray[np.int64], corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut polygons into fans of triangles ``(F, 3)``.

    Args:
        lengths: ``(P,)`` number of corners of each polygon; those with fewer than three give nothing.
        corners: ``(sum(lengths),)`` vertex indices, polygon after polygon.
    """
    starts = np.cumsum(lengths) - lengths
    triangles = (lengths - 2).clip(min=0)
    first = np.repeat(starts, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack((corners[first], corners[first + step + 1], corners[first + step + 2]), axis=1)


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """Area-weighted vertex normals ``(N, 3)``, of unit length; zero where no face with an area meets.

    Vertices at the same place count as one, so seams of texture coordinates do not split the normals.
    """
    points, index = weld(vertices)
    a, b, c = (points[index[faces[:, k]]] for k in range(3))
    weighted = np.cross(b - a, c - a)  # direction times twice the area
    sums = np.stack(
        [np.bincount(index[faces].T.ravel(), np.tile(weighted[:, k], 3), len(points)) for k in range(3)], axis=1
    )
    return unit_rows(sums)[index].astype(np.float32)


def read_obj(path: Path) -> PointCloud:
    """Read an OBJ file; a vertex that its faces give several normals gets their sum.

    Raises:
        InputError: there is no vertex, or something in it is not a number.
    """
    text = path.read_bytes().decode("utf-8", "replace").replace("\\\n", " ")
    vertices, vertex_starts = _records(text, "v")
    if not vertices:
        raise InputError(f"{path}: v: no vertex lines in it; check that it is an OBJ file")
    table = numbers("\n".join(vertices), path, first_line=1, what="vertex")
    if table.shape[1] not in (3, 4, 6, 7):
        raise InputError(f"{path}: v: {table.shape[1]} numbers per vertex; expected x y z, or x y z r g b")
    points = np.ascontiguousarray(table[:, :3])
    colors = colors_from(table[:, 3:6]) if table.shape[1] == 6 else None
    listed, normal_starts = _records(text, "vn")
    directions = numbers("\n".join(listed), path, first_line=1, what="normal") if listed else np.empty((0, 3))
    if directions.shape[1] != 3:
        raise InputError(f"{path}: vn: {directions.shape[1]} numbers per normal; expected 3")
    polygons, polygon_starts = _records(text, "f")
    if not polygons:
        normals = directions.astype(np.float32) if len(directions) == len(points) else None
        return PointCloud(points, normals, colors, str(path))

    lengths = np.array([len(polygon.split()) for polygon in polygons], np.int64)
    words = " ".join(polygons)
    owner = np.repeat(np.arange(len(polygons)), lengths)
    corners = _indices(re.sub(r"/\S*", "", words), vertex_starts, polygon_starts[owner], path, "v")
    if len(directions) and words.count("/") == 2 * len(corners):
        chosen = _indices(re.sub(r"\S*/", "", words), normal_starts, polygon_starts[owner], path, "vn")
        sums = [np.bincount(corners, directions[chosen, k], len(points)) for k in range(3)]
        return PointCloud(points, np.stack(sums, axis=1).astype(np.float32), colors, str(path))
    return PointCloud(points, vertex_normals(points, triangulate(lengths, corners)), colors, str(path), "mesh")


def _records(text: str, keyword: str) -> tuple[list[str], NDArray[np.int64]]:
    """All lines that start with ``keyword``, without it, and where in ``text`` each one starts."""
    found = list(re.finditer(rf"^[ \t]*{keyword}[ \t]+([^#\n]*)", text, re.MULTILINE))
    return [match[1].strip() for match in found], np.array([match.start() for match in found], np.int64)


def _indices(
    words: str, record_starts: NDArray[np.int64], used_at: NDArray[np.int64], path: Path, what: str
) -> NDArray[np.int64]:
    """OBJ indices → counted from 0; a negative one counts back from the last record before its use."""
    try:
        index = np.array(words.split(), np.int64)
    except ValueError as error:
        raise InputError(f"{path}: f: an index is not a whole number ({error}); export it again") from error
    if len(index) != len(used_at):
        raise InputError(f"{path}: f: a corner without its {what} index; export it again")
    index = np.where(index < 0, index + np.searchsorted(record_starts, used_at), index - 1)
    if len(index) and (index.min() < 0 or index.max() >= len(record_starts)):
        raise InputError(f"{path}: f: names a {what} beyond the {len(record_starts)} there are; export it again")
    return index
