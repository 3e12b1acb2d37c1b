"""Triangle surfaces as arrays: reading, sampling, and what can be counted on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...datasets import PointCloud, read_cloud
from ...datasets.clouds.point_cloud import unit_rows
from ...datasets.clouds.readers.meshes import spread_on_faces
from ...datasets.clouds.readers.reading import read_mesh
from ...datasets.textured.gltf import read_gltf
from ...neural_fields import InputError, Similarity
from ...neural_fields.meshing.extract import Mesh

__all__ = [
    "MESH_SUFFIXES",
    "Surface",
    "component_of_faces",
    "components",
    "face_normals",
    "from_cloud",
    "from_mesh",
    "is_closed",
    "read_reference",
    "read_surface",
    "sample_points",
]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")


@dataclass(frozen=True)
class Surface:
    """A triangle mesh, or with no faces a cloud of points: what is read from files, measured and drawn.

    A `Mesh` is what was extracted from a field: in its coordinates, and in the number types of files. A `TexturedMesh`
    was read with images, an `Unwrapped` mesh has texture coordinates and waits for them to be baked.

    Attributes:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``; F is 0 for a cloud.
        normals: ``(V, 3)`` unit normals at the vertices, where known; those of a mesh file are worked out anew.
        colors: ``(V, 3)`` in [0, 1], where the file gives them.
    """

    vertices: Float64
    faces: Int64
    normals: Float64 | None = None
    colors: Float64 | None = None
    reading: str = ""

    def used_vertices(self) -> Float64:
        """The vertices that a face uses; of a cloud, all."""
        return self.vertices[np.unique(self.faces)] if len(self.faces) else self.vertices

    @cached_property
    def merged(self) -> Surface:
        """The surface with exactly equal vertices made one, and faces that collapse by it dropped; without normals."""
        order = np.lexsort(self.vertices.T[::-1])
        rows = self.vertices[order]
        first = np.ones(len(rows), bool)
        first[1:] = (rows[1:] != rows[:-1]).any(axis=1)
        index = np.empty(len(rows), np.int64)
        index[order] = np.cumsum(first) - 1
        faces = index[self.faces]
        whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        return Surface(rows[first], faces[whole])

    def moved(self, similarity: Similarity) -> Surface:
        """The same surface in unit-sphere coordinates."""
        return Surface(similarity.to_unit(self.vertices), self.faces, self.normals, self.colors)


def read_surface(path: str | Path) -> Surface:
    """Read a mesh, or any cloud that ``datasets.read_cloud`` knows.

    Raises:
        InputError: the file is missing, damaged, empty or of a kind we do not read.
    """
    path = Path(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        return _load_gltf(path)
    if path.suffix.lower() in MESH_SUFFIXES:
        mesh = _load_mesh(path)
        if mesh is not None:
            return mesh
    return from_cloud(read_cloud(path))


def read_reference(path: str | Path, *, fix: str = "give a mesh") -> Surface:
    """`read_surface` of something to compare with.

    Args:
        path: a mesh file.
        fix: what the message advises where there are no faces.

    Raises:
        InputError: as `read_surface`, or there are no faces.
    """
    surface = read_surface(path)
    if not len(surface.faces):
        raise InputError(f"{path}: has no faces, so there is no surface to compare with; {fix}")
    return surface


def from_cloud(cloud: PointCloud) -> Surface:
    """The finite points of a cloud, as a surface without faces; normals of unit length, or zero."""
    finite = np.isfinite(cloud.points).all(axis=1)
    normals = colors = None
    if cloud.normals is not None:
        normals = np.nan_to_num(cloud.normals[finite].astype(np.float64), posinf=0.0, neginf=0.0)
        normals = unit_rows(normals)
    if cloud.colors is not None:
        colors = cloud.colors[finite].astype(np.float64)
    return Surface(cloud.points[finite], np.empty((0, 3), np.int64), normals, colors, cloud.reading)


def _load_mesh(path: Path) -> Surface | None:
    """The triangles of a file; None where it has no faces."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    cloud, faces = read_mesh(path)
    if not len(faces):
        return None
    colors = None if cloud.colors is None else cloud.colors.astype(np.float64)
    return _checked(path, Surface(cloud.points, faces, None, colors))


def _load_gltf(path: Path) -> Surface:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    mesh = read_gltf(path, textures=False)
    colors = None if mesh.vertex_colors is None else mesh.vertex_colors.astype(np.float64)
    return _checked(path, Surface(mesh.vertices, mesh.faces, None, colors))


def _checked(path: Path, surface: Surface) -> Surface:
    """The surface, if it is one.

    Raises:
        InputError: a face names no vertex, a coordinate is not finite, or all vertices coincide.
    """
    vertices, faces = surface.vertices, surface.faces
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: a face names vertex {faces.max()}, but there are only {len(vertices)}")
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise InputError(f"{path}: a vertex has a coordinate that is not a finite number")
    if not np.ptp(vertices[np.unique(faces)], axis=0).any():
        raise InputError(f"{path}: all vertices coincide")
    return surface


def from_mesh(mesh: Mesh) -> Surface:
    """A mesh that `extract_mesh` made, in its own coordinates."""
    normals = None if mesh.normals is None else mesh.normals.astype(np.float64)
    colors = None if mesh.colors is None else mesh.colors.astype(np.float64)
    return Surface(mesh.vertices, mesh.faces.astype(np.int64), normals, colors)


def face_normals(mesh: Surface | Mesh) -> tuple[Float64, Float64]:
    """Unit normals ``(F, 3)`` (zero for a face without area) and areas ``(F,)``."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return np.divide(cross, length[:, None], out=np.zeros_like(cross), where=length[:, None] > 0), length / 2


def sample_points(surface: Surface, count: int, rng: np.random.Generator) -> tuple[Float64, Float64 | None]:
    """Points uniform by area ``(count, 3)`` with the normals of their faces.

    Of a cloud, its own points (at most ``count``, chosen at random) with their own normals.

    Raises:
        ValueError: the surface has no area.
    """
    if not len(surface.faces):
        chosen = slice(None)
        if len(surface.vertices) > count:
            chosen = rng.permutation(len(surface.vertices))[:count]
        return surface.vertices[chosen], None if surface.normals is None else surface.normals[chosen]
    normals, areas = face_normals(surface)
    face, weights = spread_on_faces(areas, count, rng)
    points = sum(weights[:, k, None] * surface.vertices[surface.faces[face, k]] for k in range(3))
    return np.asarray(points), normals[face]


def components(surface: Surface) -> int:
    """Connected components of the faces, through shared vertices, equal vertices merged."""
    return len(np.unique(component_of_faces(surface.merged)))


def component_of_faces(mesh: Surface | Mesh) -> NDArray[np.int32]:
    """The number ``(F,)`` of the connected component of each face, through vertices that faces share."""
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(size, size)).tocsr()
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


def is_closed(surface: Surface) -> bool:
    """Whether each edge is run through as often in one direction as in the other, equal vertices merged."""
    whole = surface.merged
    if not len(whole.faces):
        return False
    a = whole.faces.reshape(-1)
    b = whole.faces[:, [1, 2, 0]].reshape(-1)
    size = len(whole.vertices)
    there, back = np.sort(a * size + b), np.sort(b * size + a)
    return bool((there == back).all())
