"""Meshes as oriented clouds: the vertices of OBJ, STL and OFF files, and area-weighted normals of their faces.

OBJ is read here and not with trimesh, which splits vertices at creases and seams and loses the normals of files
without faces.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ....neural_fields import InputError
from ..point_cloud import PointCloud, colors_from, unit_rows
from .tables import numbers

__all__ = ["ObjText", "read_obj", "read_off", "read_stl", "spread_on_faces", "triangulate", "vertex_normals", "weld"]

# Its parsers print the traceback of every damaged file, where nobody handles what they log.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def read_stl(path: Path) -> PointCloud:
    """Read an STL file; equal corners of its loose triangles become one vertex.

    Raises:
        InputError: it is not STL or holds no triangle.
    """
    vertices, faces = _load(path, "stl")
    if len(faces) == 0:
        raise InputError(f"{path}: facets: there are none; check that it is an STL file")
    kept, index = weld(vertices)
    points, faces = vertices[kept], index[faces]
    return PointCloud(points, vertex_normals(points, faces), None, str(path), "mesh")


def read_off(path: Path) -> PointCloud:
    """Read an OFF file, with or without faces.

    Raises:
        InputError: it is not OFF.
    """
    vertices, faces = _load(path, "off")
    normals = vertex_normals(vertices, faces) if len(faces) else None
    return PointCloud(vertices, normals, None, str(path), "mesh" if len(faces) else "file")


def _load(path: Path, kind: str) -> tuple[Float64, Int64]:
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


def weld(vertices: Float64) -> tuple[Int64, Int64]:
    """Find equal rows of ``vertices`` ``(N, K)``; minus zero is zero.

    Returns:
        The index of the first of each ``(M,)``, rows in ascending order, and for each old row its place among them
        ``(N,)``.
    """
    order = np.lexsort((vertices + 0.0).T)  # stable: among equals the first comes first; + 0.0: minus zero is zero
    ordered = vertices[order]
    first = np.ones(len(vertices), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    index = np.empty(len(vertices), np.int64)
    index[order] = np.cumsum(first) - 1
    return order[first], index


def spread_on_faces(areas: Float64, count: int, rng: np.random.Generator) -> tuple[Int64, Float64]:
    """Places uniform by area: their faces ``(N,)``, in increasing order, and weights ``(N, 3)`` of the faces' corners.

    Args:
        areas: ``(F,)`` of the faces, or numbers in proportion to them.
        count: N.
        rng: draws them.

    Raises:
        ValueError: there is no area.
    """
    total = np.cumsum(areas)
    if not total[-1] > 0:
        raise ValueError("surface: all of its faces have zero area")
    face = np.searchsorted(total, rng.uniform(0, total[-1], count), side="right").clip(max=len(total) - 1)
    face = np.sort(face)  # neighbours in memory are then neighbours in space, which k-d trees like
    root, second = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    return face, np.stack((1 - root, root * (1 - second), root * second), axis=1)


def triangulate(lengths: Int64, corners: Int64) -> Int64:
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


def vertex_normals(vertices: Float64, faces: NDArray[np.integer]) -> NDArray[np.float32]:
    """Area-weighted vertex normals ``(N, 3)``, of unit length; zero where no face with an area meets.

    Vertices at the same place count as one, so seams of texture coordinates do not split the normals.
    """
    kept, index = weld(vertices)
    a, b, c = (vertices[kept[index[faces[:, k]]]] for k in range(3))
    weighted = np.cross(b - a, c - a)  # direction times twice the area
    sums = np.stack(
        [np.bincount(index[faces].T.ravel(), np.tile(weighted[:, k], 3), len(kept)) for k in range(3)], axis=1
    )
    return unit_rows(sums)[index].astype(np.float32)


class ObjText:
    """A Wavefront OBJ file: its records by keyword, its vertices, and the corners of its polygons.

    Attributes:
        path: the file.
        points: ``(N, 3)`` vertices.
        colors: ``(N, 3)`` of them (``v x y z r g b``), or None.
        lengths: ``(P,)`` number of corners of each polygon.
        words: all corners, polygon after polygon, as they stand in the file (``v/vt/vn``).
        used_at: ``(C,)`` where in the text the polygon of each corner starts.
        corners: ``(C,)`` the vertex of each.

    Raises:
        InputError: there is no vertex, something in it is not a number, or an index names no record.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._text = path.read_bytes().decode("utf-8", "replace").replace("\\\n", " ")
        table, starts = self.table("v", "vertex")
        if not len(starts):
            raise InputError(f"{path}: v: no vertex lines in it; check that it is an OBJ file")
        if table.shape[1] not in (3, 4, 6, 7):
            raise InputError(f"{path}: v: {table.shape[1]} numbers per vertex; expected x y z, or x y z r g b")
        self.points = np.ascontiguousarray(table[:, :3])
        self.colors = colors_from(table[:, 3:6]) if table.shape[1] == 6 else None
        polygons, polygon_starts = self.records("f")
        self.lengths = np.array([len(polygon.split()) for polygon in polygons], np.int64)
        self.words = " ".join(polygons)
        self.used_at = np.repeat(polygon_starts, self.lengths)
        self.corners = self.indices(re.sub(r"/\S*", "", self.words), starts, self.used_at, "v")

    def records(self, keyword: str) -> tuple[list[str], Int64]:
        """All lines that start with ``keyword``, without it, and where in the text each one starts."""
        found = list(re.finditer(rf"^[ \t]*{keyword}[ \t]+([^#\n]*)", self._text, re.MULTILINE))
        return [match[1].strip() for match in found], np.array([match.start() for match in found], np.int64)

    def table(self, keyword: str, what: str) -> tuple[Float64, Int64]:
        """The numbers of all records of ``keyword`` ``(R, K)``, and where each one starts; ``what`` they are."""
        listed, starts = self.records(keyword)
        return numbers("\n".join(listed), self.path, first_line=1, what=what) if listed else np.empty((0, 3)), starts

    def indices(self, words: str, record_starts: Int64, used_at: Int64, what: str) -> Int64:
        """OBJ indices → counted from 0; a negative one counts back from the last record before its use.

        Args:
            words: the indices.
            record_starts: ``(R,)`` where the records that they name start.
            used_at: ``(C,)`` where each of them is used.
            what: keyword of those records, for messages.
        """
        try:
            index = np.array(words.split(), np.int64)
        except ValueError as error:
            raise InputError(f"{self.path}: f: an index is not a whole number ({error}); export it again") from error
        if len(index) != len(used_at):
            raise InputError(f"{self.path}: f: a corner without its {what} index; export it again")
        index = np.where(index < 0, index + np.searchsorted(record_starts, used_at), index - 1)
        count = len(record_starts)
        if len(index) and (index.min() < 0 or index.max() >= count):
            raise InputError(f"{self.path}: f: names a {what} beyond the {count} there are; export it again")
        return index


def read_obj(path: Path) -> PointCloud:
    """Read an OBJ file; a vertex that its faces give several normals gets their sum.

    Raises:
        InputError: there is no vertex, or something in it is not a number.
    """
    obj = ObjText(path)
    points, corners = obj.points, obj.corners
    directions, starts = obj.table("vn", "normal")
    if directions.shape[1] != 3:
        raise InputError(f"{path}: vn: {directions.shape[1]} numbers per normal; expected 3")
    if not len(corners):
        normals = directions.astype(np.float32) if len(directions) == len(points) else None
        return PointCloud(points, normals, obj.colors, str(path))
    if len(directions) and obj.words.count("/") == 2 * len(corners):
        chosen = obj.indices(re.sub(r"\S*/", "", obj.words), starts, obj.used_at, "vn")
        sums = [np.bincount(corners, directions[chosen, k], len(points)) for k in range(3)]
        return PointCloud(points, np.stack(sums, axis=1).astype(np.float32), obj.colors, str(path))
    return PointCloud(points, vertex_normals(points, triangulate(obj.lengths, corners)), obj.colors, str(path), "mesh")
