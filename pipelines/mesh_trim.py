"""Parts of a mesh: the largest component, what lies near the input points, or in the region of interest."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..neural_fields import InputError
from ..neural_fields.meshing import Mesh

__all__ = ["face_areas", "in_region", "keep_faces", "keep_largest", "trim_distance", "without_voids"]


def face_areas(mesh: Mesh) -> NDArray[np.float64]:
    """Areas ``(F,)``."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def keep_faces(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """The mesh with only the faces where ``kept`` ``(F,)`` is true, and the vertices they use."""
    faces = mesh.faces[kept]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=mesh.faces.dtype) - 1
    return dataclasses.replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=number[faces].astype(mesh.faces.dtype),
        normals=None if mesh.normals is None else mesh.normals[used],
        colors=None if mesh.colors is None else mesh.colors[used],
    )


def keep_largest(mesh: Mesh) -> Mesh:
    """Keep the connected component (through shared vertices) with the largest area."""
    component = _component_of_faces(mesh)
    return keep_faces(mesh, component == np.bincount(component, weights=face_areas(mesh)).argmax())


def without_voids(mesh: Mesh) -> Mesh:
    """Drop closed components that are turned inside out: the walls of voids, which no camera outside can see.

    What photographs do not show, training leaves to chance; a void that is really there is lost as well.
    """
    component = _component_of_faces(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    volume = np.bincount(component, weights=(np.cross(a, b) * c).sum(axis=1))
    starts, ends = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    _, edge, uses = np.unique(low * len(mesh.vertices) + high, return_inverse=True, return_counts=True)
    is_open = np.zeros(len(volume), bool)
    is_open[np.repeat(component, 3)[uses[edge] == 1]] = True
    return keep_faces(mesh, (is_open | (volume >= 0))[component])


def _component_of_faces(mesh: Mesh) -> NDArray[np.int32]:
    """The number ``(F,)`` of the connected component, through shared vertices, of each face."""
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(size, size)).tocsr()
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


def in_region(mesh: Mesh) -> Mesh | None:
    """The part of a mesh that photographs can show: in the unit sphere, and no void's wall; None where there is none.

    Outside the unit sphere, the region of interest, no ray is ever sampled, so that a network may have any sign there.
    """
    inside = (mesh.vertices**2).sum(axis=1) <= 1
    kept = inside[mesh.faces].all(axis=1)
    return without_voids(keep_faces(mesh, kept)) if kept.any() else None


def trim_distance(mesh: Mesh, points: NDArray[np.floating], distance: float) -> Mesh:
    """Keep the faces whose three corners are all within ``distance`` of some of ``points`` ``(N, 3)``.

    Mesh, points and distance in the same coordinates.

    Raises:
        ValueError: ``distance`` is not positive.
        InputError: no face is that close.
    """
    if not distance > 0:
        raise ValueError(f"distance={distance}: expected > 0")
    limit = np.nextafter(distance, np.inf)  # the tree's bound is exclusive
    nearest = KDTree(points).query(mesh.vertices, distance_upper_bound=limit)[0]
    kept = (nearest <= distance)[mesh.faces].all(axis=1)
    if not kept.any():
        raise InputError(
            f"--trim-distance: none of {len(mesh.faces)} faces is within {distance:.4g} of the points; raise it"
        )
    return keep_faces(mesh, kept)
