"""Triangle surfaces as arrays: reading, sampling, and what can be counted on them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ...datasets import PointCloud, read_cloud
from ...datasets.clouds.point_cloud import unit_rows
from ...datasets.clouds.readers.meshes import spread_on_faces
from ...datasets.textured.gltf import read_gltf
from ...neural_fields import InputError, Mesh

__all__ = [
    "MESH_SUFFIXES",
    "component_of_faces",
    "components",
    "face_normals",
    "from_cloud",
    "is_closed",
    "read_reference",
    "read_surface",
    "sample_points",
    "volume",
]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")


def read_surface(path: str | Path) -> Mesh:
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


def read_reference(path: str | Path, *, fix: str = "give a mesh") -> Mesh:
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


def from_cloud(cloud: PointCloud) -> Mesh:
    """The finite points of a cloud, as a surface without faces; normals of unit length, or zero."""
    finite = np.isfinite(cloud.points).all(axis=1)
    normals = colors = None
    if cloud.normals is not None:
        normals = np.nan_to_num(cloud.normals[finite].astype(np.float64), posinf=0.0, neginf=0.0)
        normals = unit_rows(normals)
    if cloud.colors is not None:
        colors = cloud.colors[finite].astype(np.float64)
    return Mesh(cloud.points[finite], np.empty((0, 3), np.int64), normals, colors)


def _load_mesh(path: Path) -> Mesh | None:
    """The triangles of a file; None where it has no faces."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        # process=False: trimesh would otherwise merge vertices and drop faces before we count them.
        loaded: Any = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsing runs into
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: cannot be read as a {path.suffix[1:].upper()} mesh ({reason})") from error
    faces = np.asarray(getattr(loaded, "faces", ()), np.int64).reshape(-1, 3)
    if not len(faces):
        return None
    colors = None
    if loaded.visual.kind == "vertex":
        colors = np.asarray(loaded.visual.vertex_colors, np.float64)[:, :3] / 255
    return _checked(path, Mesh(np.asarray(loaded.vertices, np.float64), faces, None, colors))


def _load_gltf(path: Path) -> Mesh:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    mesh = read_gltf(path, textures=False)
    colors = None if mesh.vertex_colors is None else mesh.vertex_colors.astype(np.float64)
    return _checked(path, Mesh(mesh.vertices, mesh.faces, None, colors))


def _checked(path: Path, surface: Mesh) -> Mesh:
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


def face_normals(mesh: Mesh) -> tuple[Float64, Float64]:
    """Unit normals ``(F, 3)`` (zero for a face without area) and areas ``(F,)``."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return np.divide(cross, length[:, None], out=np.zeros_like(cross), where=length[:, None] > 0), length / 2


def sample_points(surface: Mesh, count: int, rng: np.random.Generator) -> tuple[Float64, NDArray[np.floating] | None]:
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


def components(surface: Mesh) -> int:
    """Connected components of the faces, through shared vertices, equal vertices merged."""
    return len(np.unique(component_of_faces(surface.merged)))


def component_of_faces(mesh: Mesh) -> NDArray[np.int32]:
    """The number ``(F,)`` of the connected component of each face, through vertices that faces share."""
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(size, size)).tocsr()
    return connected_components(graph, directed=False)[1][mesh.faces[:, 0]]


def is_closed(surface: Mesh) -> bool:
    """Whether each edge is run through as often in one direction as in the other, equal vertices merged."""
    whole = surface.merged
    if not len(whole.faces):
        return False
    a = whole.faces.reshape(-1)
    b = whole.faces[:, [1, 2, 0]].reshape(-1)
    size = len(whole.vertices)
    there, back = np.sort(a * size + b), np.sort(b * size + a)
    return bool((there == back).all())


def volume(mesh: Mesh) -> float:
    """Volume inside a closed mesh: the sum of signed tetrahedra from its middle."""
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
