"""Fewer triangles, texture coordinates by xatlas, and the axes in which a normal map is written.

Tangents are MikkTSpace's (M. Mikkelsen, "Simulation of Wrinkled Surfaces Revisited", 2008, Sec. 3.3), as in glTF.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...datasets.clouds.point_cloud import unit_rows
from ...datasets.clouds.readers.meshes import vertex_normals
from ...neural_fields import InputError, Mesh
from ...neural_fields.backend.arrays import Float64, Int64
from ..surface.distance import MeshDistance
from ..surface.surface import is_closed


def check_tools(flag: str, *modules: str) -> None:
    """Raise an InputError before any long work if a module of the extra ``mplicits[texture]`` is not installed."""
    for name in modules:
        if importlib.util.find_spec(name) is None:
            raise InputError(f"{flag} needs {name}; pip install 'mplicits[texture]'")


def decimate(vertices: Float64, faces: NDArray[np.integer], count: int) -> tuple[Float64, Int64]:
    """Collapse edges by their quadric error until about ``count`` triangles are left, if there are more."""
    if len(faces) <= count:
        return vertices, faces.astype(np.int64)
    import fast_simplification

    middle, size = _box(vertices)
    unit = (vertices - middle) / size
    # How eagerly edges are collapsed, 0 to 10. Above 5 the error doubles and closed meshes come back with holes; below
    # 3 it stops early, with more triangles than asked for.
    points, left = fast_simplification.simplify(unit, faces.astype(np.int32), target_count=count, agg=4)[:2]
    corners = points[left]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    used, index = np.unique(left[area > 0], return_inverse=True)
    return points[used].astype(np.float64) * size + middle, index.reshape(-1, 3).astype(np.int64)


def unwrap(vertices: Float64, faces: NDArray[np.integer], *, size: int = 2048, padding: int | None = None) -> Mesh:
    """Cut a mesh into charts that lie flat, and pack them into the unit square.

    Returns the same triangles in the same order, with normals (means by area, across seams too), texture coordinates
    and tangents; vertices on seams are repeated, once per chart. ``size`` is the side of the texture, ``padding`` the
    space between charts (by default a 256th of it), in texels. Raises a ValueError if no triangle has an area.
    """
    import xatlas

    middle, extent = _box(vertices)
    atlas = xatlas.Atlas()
    # xatlas takes small triangles for no triangles, so it is given a mesh of unit size.
    atlas.add_mesh(((vertices - middle) / extent).astype(np.float32), faces.astype(np.uint32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    packing.resolution = size
    # Texels between charts, as a share of the texture's side: five mip levels stay clear of the neighbours.
    packing.padding = round(size / 256) if padding is None else padding
    packing.bilinear = True  # a texel that the filter reaches from two charts belongs to neither
    atlas.generate(charts, packing)
    if not atlas.atlas_count:
        raise ValueError("faces: none of them has an area, so there is nothing to unwrap")
    vertex_map, indices, uv = atlas[0]
    # The atlas is not square, and v runs down in it. One scale for both axes, so that texels stay square.
    sides = np.array([atlas.width, atlas.height], np.float64)
    uv = uv.astype(np.float64) * sides / sides.max()
    uv[:, 1] = 1 - uv[:, 1]
    index, corners = vertex_map.astype(np.int64), indices.astype(np.int64)
    points = vertices[index]
    normals = vertex_normals(points, corners).astype(np.float64)
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)  # of faces without area; a normal of no length is not legal glTF
    return Mesh(points, corners, normals, uv=uv, tangents=vertex_tangents(points, corners, uv, normals))


def _box(vertices: Float64) -> tuple[Float64, float]:
    """Middle and largest side of the bounding box."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (low + high) / 2, float((high - low).max()) or 1.0


def vertex_tangents(vertices: Float64, faces: Int64, uv: Float64, normals: Float64) -> Float64:
    """Tangents ``(V, 4)``: a unit vector square to the normal, and w = ±1; the bitangent is ``w · normal × tangent``.

    The direction of growing u on each face around the vertex, laid into the plane of the normal, weighted by the angle
    of the face there. Vertices are repeated at seams; v of ``uv`` ``(V, 2)`` grows upwards.
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
    tangents[missing] = _laid(np.eye(3)[np.abs(normals[missing]).argmin(axis=1)], normals[missing])
    return np.concatenate((tangents, np.where(turning < 0, -1.0, 1.0)[:, None]), axis=1)


def to_frame(directions: Float64, normals: Float64, tangents: Float64) -> Float64:
    """Coordinates of directions ``(N, 3)`` along tangent, bitangent and normal.

    ``normals`` ``(N, 3)`` and ``tangents`` ``(N, 4)`` are interpolated between vertices, of any length.
    """
    return np.asarray(np.linalg.solve(frame_axes(normals, tangents), directions[..., None])[..., 0], np.float64)


def frame_axes(normals: Float64, tangents: Float64) -> Float64:
    """Columns ``(N, 3, 3)`` tangent, bitangent, normal, each of unit length, as three.js and Blender use them."""
    normals, along = unit_rows(normals), unit_rows(tangents[:, :3])
    across = unit_rows(np.cross(normals, along)) * np.sign(tangents[:, 3:])
    return np.stack((along, across, normals), axis=2)


def _laid(vectors: Float64, normals: Float64) -> Float64:
    """The part of ``vectors`` square to ``normals``, of unit length, or zero."""
    return unit_rows(vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals)


@dataclass(frozen=True)
class Decimation:
    """What a decimation has cost; ``largest`` and ``mean`` distance are those both ways.

    Distances from each mesh to the other are exact, at the vertices of the full mesh and at the vertices, edge
    midpoints and face centres of the other, evenly thinned to 50,000 points each way.
    """

    faces_before: int
    faces: int
    largest: float
    mean: float
    closed_before: bool
    closed: bool

    def describe(self, unit: str) -> str:
        """One line, for people."""
        line = f"{self.faces_before:,} → {self.faces:,} faces, at most {self.largest:.3g} {unit} from the full mesh"
        line += f" (mean {self.mean:.2g})"
        if self.closed_before:
            return f"{line}; {'still watertight' if self.closed else 'NO LONGER WATERTIGHT: keep more faces'}"
        return f"{line}; not watertight, as before"


class Decimated(NamedTuple):
    """A mesh with fewer triangles, without normals and colours, and what that has cost."""

    mesh: Mesh
    cost: Decimation


def decimated(mesh: Mesh, faces: int, *, unit: float = 1.0) -> Decimated:
    """Collapse edges until about ``faces`` triangles are left, and measure how far that has led.

    A unit of the mesh is ``unit`` of those in which distances are stated.
    """
    full = Mesh(mesh.vertices, mesh.faces.astype(np.int64))
    closed = is_closed(full)
    if len(mesh.faces) <= faces:
        bare = dataclasses.replace(mesh, normals=None, colors=None)
        return Decimated(bare, Decimation(len(mesh.faces), len(mesh.faces), 0.0, 0.0, closed, closed))
    vertices, corners = decimate(mesh.vertices, mesh.faces, faces)
    left = Mesh(vertices, corners)
    largest, mean = deviation(full, left)
    cost = Decimation(len(mesh.faces), len(corners), unit * largest, unit * mean, closed, is_closed(left))
    return Decimated(Mesh(vertices, corners.astype(np.int32)), cost)


def deviation(full: Mesh, left: Mesh, *, probes: int = 50_000) -> tuple[float, float]:
    """Largest and mean distance between two meshes, both ways; where it is measured says `Decimation`."""
    there = np.abs(MeshDistance(left).signed(_thinned(full.used_vertices(), probes)))
    back = np.abs(MeshDistance(full).signed(_thinned(_probes(left), probes)))
    return float(max(there.max(), back.max())), float(there.mean() + back.mean()) / 2


def _probes(surface: Mesh) -> Float64:
    """Vertices, edge midpoints and face centres."""
    corners = surface.vertices[surface.faces]  # (F, 3, 3)
    ends = np.concatenate([surface.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = np.unique(np.sort(ends, axis=1), axis=0)
    return np.concatenate((surface.used_vertices(), surface.vertices[edges].mean(axis=1), corners.mean(axis=1)))


def _thinned(points: Float64, count: int) -> Float64:
    # More points would take seconds and change little.
    return points[:: -(-len(points) // count)]
