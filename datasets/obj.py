"""Wavefront OBJ: vertices, their colours (``v x y z r g b``), normals and faces.

Read here and not with trimesh, which splits vertices at creases and seams and loses the normals of files without faces.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .meshes import triangulate, vertex_normals
from .point_cloud import PointCloud, colors_from
from .text import numbers

__all__ = ["read_obj"]


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
