"""Tangent frames of textured meshes: the axes in which normal maps are written.

The tangent of a vertex is what MikkTSpace makes it (M. Mikkelsen, "Simulation of Wrinkled Surfaces Revisited", 2008,
Sec. 3.3; Blender and glTF ask for it): the direction of growing u on each face around the vertex, laid into the plane
of the vertex's normal, weighted by the angle of the face there. Faces on the other side of a seam have their own
vertices and are not mixed in.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..datasets.clouds.point_cloud import unit_rows

__all__ = ["from_frame", "to_frame", "vertex_tangents"]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def vertex_tangents(vertices: Float64, faces: Int64, uv: Float64, normals: Float64) -> Float64:
    """Tangents ``(V, 4)``: a unit vector square to the normal, and w = ±1; the bitangent is ``w · normal × tangent``.

    Args:
        vertices: ``(V, 3)``, repeated at seams.
        faces: ``(F, 3)``.
        uv: ``(V, 2)``, v upwards: the bitangent points to where v grows.
        normals: ``(V, 3)`` of unit length.
    """
    sums = np.zeros((len(vertices), 3))
    turning = np.zeros(len(vertices))
    for k in range(3):
        here, next_one, last = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = vertices[next_one] - vertices[here], vertices[last] - vertices[here]
        s, t = uv[next_one] - uv[here], uv[last] - uv[here]
        side = np.sign(s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])[:, None]  # +1: not mirrored; 0: no area in the texture
        normal = normals[here]
        along = _laid((t[:, 1:] * a - s[:, 1:] * b) * side, normal)
        angle = np.arccos((_laid(a, normal) * _laid(b, normal)).sum(axis=1).clip(-1, 1))[:, None]
        for c in range(3):
            sums[:, c] += np.bincount(here, (along * angle)[:, c], len(vertices))
        turning += np.bincount(here, (side * angle)[:, 0], len(vertices))
    tangents = _laid(sums, normals)
    missing = ~tangents.any(axis=1)  # vertices of faces without area only: any direction serves
    axis = np.eye(3)[np.abs(normals[missing]).argmin(axis=1)]
    tangents[missing] = _laid(axis, normals[missing])
    return np.concatenate((tangents, np.where(turning < 0, -1.0, 1.0)[:, None]), axis=1)


def to_frame(directions: Float64, normals: Float64, tangents: Float64) -> Float64:
    """Directions ``(N, 3)`` → their coordinates along tangent, bitangent and normal.

    Args:
        directions: in the mesh's coordinates.
        normals: ``(N, 3)``, interpolated between vertices; of any length.
        tangents: ``(N, 4)``, interpolated likewise.
    """
    return np.asarray(np.linalg.solve(_axes(normals, tangents), directions[..., None])[..., 0], np.float64)


def from_frame(coordinates: Float64, normals: Float64, tangents: Float64) -> Float64:
    """The inverse of `to_frame`, which is what a renderer does with a normal map."""
    return (_axes(normals, tangents) @ coordinates[..., None])[..., 0]


def _axes(normals: Float64, tangents: Float64) -> Float64:
    """Columns ``(N, 3, 3)`` tangent, bitangent, normal, each of unit length, as three.js and Blender use them."""
    normals, along = unit_rows(normals), unit_rows(tangents[:, :3])
    across = unit_rows(np.cross(normals, along)) * np.sign(tangents[:, 3:])
    return np.stack((along, across, normals), axis=2)


def _laid(vectors: Float64, normals: Float64) -> Float64:
    """The part of ``vectors`` square to ``normals``, of unit length, or zero."""
    return unit_rows(vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals)
