"""Meshes as oriented clouds: the vertices of OBJ, STL and OFF files, and area-weighted normals of their faces.

trimesh splits the vertices of OBJ files at creases and seams, and loses the normals of files without faces.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ....neural_fields.meshing.mesh import weld
from ...files import decoded
from ..point_cloud import Float64, Int64, PointCloud, colors_from, sums_by, unit_rows
from .columns import Table, choose_layout, cloud_from
from .tables import numbers


def read_stl(path: Path) -> tuple[PointCloud, Int64]:
    """The triangles of an STL file, text of any number of solids or binary; equal corners become one vertex."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if count and 0 <= len(data) - 84 - 50 * count < 50:  # some writers add a few bytes
        facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(data, facet, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    elif re.match(r"\s*solid\b", text := decoded(data), re.IGNORECASE):
        found = re.findall(r"^\s*vertex\s+([^\n]*)", text, re.MULTILINE | re.IGNORECASE)
        if not found:  # facets on one line; after the name of the solid, which may be anything
            text = re.sub(r"^[ \t]*(end)?solid\b[^\n]*", "", text, flags=re.MULTILINE | re.IGNORECASE)
            found = re.findall(r"\bvertex\s+(\S+[ \t]+\S+[ \t]+\S+)", text, re.IGNORECASE)
        corners = numbers("\n".join(found), path, first_line=1, what="vertex") if found else np.empty((0, 3))
    else:
        raise InputError(f"{path}: not a readable STL file; check its extension or export it again")
    if not len(corners) or len(corners) % 3 or corners.shape[1] != 3:
        raise InputError(f"{path}: {len(corners)} vertices of facets, three by three; check that it is an STL file")
    kept, index = weld(corners)
    faces = index.reshape(-1, 3)
    return as_mesh(_vertices(path, corners[kept]), faces), faces


def read_off(path: Path) -> tuple[PointCloud, Int64]:
    """An OFF file, with or without faces; NOFF has normals and COFF colours at its vertices."""
    text = re.sub(r"#[^\n]*", "", decoded(path.read_bytes()))
    head = re.match(r"\s*(ST)?(C)?(N)?OFF\b", text)
    lines = [line for line in text[head.end() if head else 0 :].splitlines() if line.strip()]
    sizes = lines[0].split() if lines else []
    if head is None or len(sizes) < 2 or not (sizes[0] + sizes[1]).isdecimal():
        raise InputError(f"{path}: not a readable OFF file (text of OFF, COFF or NOFF); export it again")
    vertices, polygons = int(sizes[0]), int(sizes[1])
    if len(lines) < 1 + vertices + polygons or not vertices:
        raise InputError(
            f"{path}: {len(lines) - 1} lines for {vertices} vertices and {polygons} faces; export it again"
        )
    rows = numbers("\n".join(lines[1 : 1 + vertices]), path, first_line=1, what="vertex")
    names = ["x", "y", "z"] + ["nx", "ny", "nz"] * (head[3] is not None)
    rest = rows.shape[1] - len(names) - 2 * (head[1] is not None)
    names += ["r", "g", "b", "a"][:rest] if head[2] is not None or rest in (3, 4) else []
    names += ["-"] * (rows.shape[1] - len(names))
    table = Table(path, rows, names, "vertex 1: ")
    listed = [line.split() for line in lines[1 + vertices : 1 + vertices + polygons]]
    try:
        lengths = np.array([int(words[0]) for words in listed], np.int64)
        corners = [word for words in listed for word in words[1 : 1 + int(words[0])]]
        faces = triangulate(lengths, np.array(corners, np.int64))
    except (ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path}: a face is no list of vertices ({error}); export it again") from error
    cloud = cloud_from(table, choose_layout(table))
    if len(faces):
        cloud = dataclasses.replace(cloud, normals=None)
    return as_mesh(cloud, faces), faces


def _vertices(path: Path, points: Float64, colors: NDArray[np.float32] | None = None) -> PointCloud:
    return PointCloud(points, None, colors, str(path), reading=f"{len(points):,} vertices")


def as_mesh(cloud: PointCloud, faces: Int64) -> PointCloud:
    """The vertices of a mesh; where they have no normals, with those of its triangles ``(F, 3)``."""
    if len(faces) and (faces.min() < 0 or faces.max() >= len(cloud)):
        raise InputError(f"{cloud.source}: face: names a vertex beyond the {len(cloud)} there are; export it again")
    if cloud.normals is not None or not len(faces):
        return cloud
    reading = f"{cloud.reading}; normals from {len(faces):,} triangles"
    normals = vertex_normals(cloud.points, faces)
    return dataclasses.replace(cloud, normals=normals, normals_source="mesh", reading=reading)


def triangulate(lengths: Int64, corners: Int64) -> Int64:
    """Cut polygons of ``lengths`` ``(P,)`` corners into fans of triangles ``(F, 3)``; ``corners`` are of all polygons.

    Polygons with fewer than three corners give nothing.
    """
    starts = np.cumsum(lengths) - lengths
    triangles = (lengths - 2).clip(min=0)
    first = np.repeat(starts, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack((corners[first], corners[first + step + 1], corners[first + step + 2]), axis=1)


def strips(lengths: Int64, corners: Int64) -> Int64:
    """Cut triangle strips, each ended by −1 or the end of its list, into triangles ``(F, 3)`` that face one way."""
    ends = np.zeros(len(corners), bool)
    ends[np.cumsum(lengths)[lengths > 0] - 1] = True
    stops = ends | (corners < 0)
    first = np.flatnonzero(np.concatenate(([True], stops[:-1])))
    place = np.arange(len(corners)) - np.repeat(first, np.diff(np.append(first, len(corners))))
    at = np.flatnonzero(~stops[:-2] & ~stops[1:-1] & (corners[2:] >= 0))
    a, b, c = corners[at], corners[at + 1], corners[at + 2]
    turned = place[at] % 2 == 1
    faces = np.stack((np.where(turned, b, a), np.where(turned, a, b), c), axis=1)
    return faces[(a != b) & (b != c) & (a != c)]  # repeated corners join strips and have no area


def vertex_normals(vertices: Float64, faces: NDArray[np.integer]) -> NDArray[np.float32]:
    """Area-weighted vertex normals ``(N, 3)``, of unit length; zero where no face with an area meets.

    Vertices at the same place count as one, so seams of texture coordinates do not split the normals.
    """
    kept, index = weld(vertices)
    a, b, c = (vertices[kept[index[faces[:, k]]]] for k in range(3))
    weighted = np.cross(b - a, c - a)  # direction times twice the area
    sums = sums_by(index[faces].T.ravel(), np.tile(weighted, (3, 1)), len(kept))
    return unit_rows(sums)[index].astype(np.float32)


class ObjText:
    """A Wavefront OBJ file: its records by keyword, its vertices, and the corners of its polygons."""

    points: Float64  # (N, 3) vertices
    colors: NDArray[np.float32] | None  # (N, 3) of them (``v x y z r g b``)
    lengths: Int64  # (P,) number of corners of each polygon
    words: str  # all corners, polygon after polygon, as they stand in the file (``v/vt/vn``)
    used_at: Int64  # (C,) where in the text the polygon of each corner starts
    corners: Int64  # (C,) the vertex of each corner

    def __init__(self, path: Path) -> None:
        self.path = path
        self._text = decoded(path.read_bytes()).replace("\\\n", " ")
        listed, starts = self.records("v")
        if not len(starts):
            raise InputError(f"{path}: v: no vertex lines in it; check that it is an OBJ file")
        table = _vertex_table(listed, path)
        if table.shape[1] not in (3, 4, 6, 7):
            raise InputError(f"{path}: v: {table.shape[1]} numbers per vertex; expected x y z, or x y z r g b")
        self.points = np.ascontiguousarray(table[:, :3])
        self.colors = None
        if table.shape[1] > 4:
            bare = np.isnan(table[:, 3])  # white, where others have colours
            self.colors = np.where(bare[:, None], np.float32(1), colors_from(table[:, 3:6]))
        polygons, polygon_starts = self.records("fo?")  # fo: an older word
        self.lengths = np.array([len(polygon.split()) for polygon in polygons], np.int64)
        self.words = " ".join(polygons)
        self.used_at = np.repeat(polygon_starts, self.lengths)
        self.corners = self.indices(re.sub(r"/\S*", "", self.words), starts, self.used_at, "v")

    def records(self, keyword: str) -> tuple[list[str], Int64]:
        """All lines that start with ``keyword``, without it, and their places in the text."""
        found = list(re.finditer(rf"^[ \t]*{keyword}[ \t]+([^#\n]*)", self._text, re.MULTILINE))
        return [match[1].strip() for match in found], np.array([match.start() for match in found], np.int64)

    def table(self, keyword: str, what: str) -> tuple[Float64, Int64]:
        """The numbers of all records of ``keyword`` ``(R, K)``, and their places; messages call them ``what``."""
        listed, starts = self.records(keyword)
        return numbers("\n".join(listed), self.path, first_line=1, what=what) if listed else np.empty((0, 3)), starts

    def indices(self, words: str, record_starts: Int64, used_at: Int64, what: str) -> Int64:
        """OBJ indices → counted from 0; a negative one counts back from the last record before its use.

        The records of the keyword ``what`` start at ``record_starts`` ``(R,)``, the polygons at ``used_at`` ``(C,)``.
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


def _vertex_table(listed: list[str], path: Path) -> Float64:
    """The numbers of ``v`` lines; where only some have colours, the others get NaN."""
    try:
        return numbers("\n".join(listed), path, first_line=1, what="vertex")
    except InputError:
        rows = [line.split() for line in listed]
        if not {len(row) for row in rows} <= {3, 4, 6, 7} or len(max(rows, key=len)) < 6:
            raise
        even = (" ".join(row[:6] if len(row) > 5 else [*row[:3], "nan", "nan", "nan"]) for row in rows)
        return numbers("\n".join(even), path, first_line=1, what="vertex")


def read_obj(path: Path) -> tuple[PointCloud, Int64]:
    """An OBJ file; a vertex that its faces give several normals gets their sum."""
    obj = ObjText(path)
    corners, faces = obj.corners, triangulate(obj.lengths, obj.corners)
    cloud = _vertices(path, obj.points, obj.colors)
    directions, starts = obj.table("vn", "normal")
    if directions.shape[1] != 3:
        raise InputError(f"{path}: vn: {directions.shape[1]} numbers per normal; expected 3")
    normals = None
    if not len(corners) and len(directions) == len(cloud):
        normals = directions.astype(np.float32)
    elif len(corners) and len(directions) and obj.words.count("/") == 2 * len(corners):
        chosen = obj.indices(re.sub(r"\S*/", "", obj.words), starts, obj.used_at, "vn")
        normals = sums_by(corners, directions[chosen], len(cloud)).astype(np.float32)
    if normals is not None:
        cloud = dataclasses.replace(cloud, normals=normals, reading=f"{cloud.reading}; normals from vn")
    return as_mesh(cloud, faces), faces
