"""Meshes with colours: read from OBJ, glTF and PLY, and sampled into clouds with colours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ...neural_fields import InputError
from ...neural_fields.meshing.mesh import weld
from ..clouds.point_cloud import PointCloud, spread_on_faces
from ..clouds.readers.ply import read_ply_mesh
from ..files import readable
from .gltf import read_gltf
from .mesh import TexturedMesh, colors_at
from .obj import read_textured_obj


def read_textured(path: str | Path) -> TexturedMesh:
    """Read a mesh with its colours: from an image over texture coordinates, materials, or the vertices.

    Args:
        path: an OBJ file with its MTL files and images, a GLB or glTF file, or a PLY file with vertex colours.

    Returns:
        The mesh in input coordinates, without repeated vertices along seams.

    Raises:
        InputError: the file, a material or an image is missing or damaged, or there are no faces or no colours.
    """
    path = Path(path)
    if (reader := TEXTURED_READERS.get(path.suffix.lower())) is None:
        known = ", ".join(TEXTURED_READERS)
        raise InputError(f"{path}: meshes with colours are read from {known}; export it as one of them")
    with readable(path):
        mesh = reader(path)
    if not np.isfinite(mesh.vertices[np.unique(mesh.faces)]).all():
        raise InputError(f"{path}: a vertex has a coordinate that is not a finite number; export it again")
    if not mesh.has_colors:
        raise InputError(f"{path}: neither a texture nor vertex colours in it; export it with its colours")
    return mesh


def sample_textured(mesh: TexturedMesh, count: int, *, seed: int) -> PointCloud:
    """``count`` points uniform by area, with the colours of the surface and the normals of their faces.

    Raises:
        InputError: the faces have no area.
        ValueError: the mesh has no colours.
    """
    corners = mesh.vertices[mesh.faces]  # (F, 3, 3)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(cross, axis=1)  # twice the area
    if not doubled.sum() > 0:
        raise InputError(f"{mesh.source}: all of its faces have zero area; export it again")
    face, weights = spread_on_faces(doubled, count, np.random.default_rng(seed))
    points = np.einsum("nk,nkc->nc", weights, corners[face])
    normals = (cross[face] / doubled[face, None]).astype(np.float32)
    return PointCloud(points, normals, colors_at(mesh, face, weights), mesh.source, "mesh")


def _read_ply(path: Path) -> TexturedMesh:
    """A PLY mesh with the colours of its vertices."""
    cloud, faces = read_ply_mesh(path)
    if not len(faces):
        raise InputError(f"{path}: face: there are none; a cloud with colours is read as it is, without its texture")
    return TexturedMesh(cloud.points, faces, None, None, cloud.colors, str(path))


def _read_gltf(path: Path) -> TexturedMesh:
    """The triangles of a glTF scene; equal vertices with equal colours are merged."""
    mesh = read_gltf(path)
    colors = mesh.vertex_colors
    keys = mesh.vertices if colors is None else np.concatenate((mesh.vertices, colors), axis=1, dtype=np.float64)
    kept, index = weld(keys)
    colors = None if colors is None else colors[kept]
    return replace(mesh, vertices=mesh.vertices[kept], faces=index[mesh.faces], vertex_colors=colors)


TEXTURED_READERS: Mapping[str, Callable[[Path], TexturedMesh]] = MappingProxyType(
    {".obj": read_textured_obj, ".glb": _read_gltf, ".gltf": _read_gltf, ".ply": _read_ply}
)
"""Readers by extension."""
