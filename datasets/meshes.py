"""A mesh as an oriented cloud: its vertices and their area-weighted normals; STL and OFF files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..neural_fields import InputError
from .point_cloud import PointCloud, unit_rows

__all__ = ["read_off", "read_stl", "triangulate", "vertex_normals", "weld"]


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
