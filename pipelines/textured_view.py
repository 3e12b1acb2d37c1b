"""What the pixels of an image see of a mesh with a texture: its colours are looked up for every pixel."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets.cameras import Camera
from ..datasets.clouds.meshes import vertex_normals
from ..datasets.textured.reading import TexturedMesh, colors_at
from .picture import nearest_faces, rows_seen
from .seen import Seen

__all__ = ["textured_view"]

NEAR = 1e-4  # faces that reach nearer than this share of the furthest depth, or behind the camera, are not drawn


def textured_view(mesh: TexturedMesh, camera: Camera) -> Seen:
    """Rasterise a mesh; the colour of a pixel is that of the one point of the surface at its centre.

    The texture is interpolated between its four nearest texels, in linear light, and not filtered beyond that: where
    it is finer than the pixels, draw more pixels and average them (`image_error.draw`). Normals are those of the
    vertices, interpolated.

    Args:
        mesh: with an image or vertex colours; around which the camera stands, not within.
        camera: in the mesh's coordinates.

    Returns:
        One row per pixel that sees the mesh, in float32.

    Raises:
        ValueError: the mesh has no colours.
    """
    pixel, face, weights = _visible(mesh, camera)
    corners = mesh.faces[face]  # (P, 3)
    position = np.einsum("pk,pkc->pc", weights, mesh.vertices[corners])
    normals = vertex_normals(mesh.vertices, mesh.faces).astype(np.float64)
    normal = np.einsum("pk,pkc->pc", weights, normals[corners])
    return rows_seen(camera, pixel, position, normal, colors_at(mesh, face, weights))


def _visible(mesh: TexturedMesh, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Pixels ``(P,)`` that see a face, the nearest face ``(P,)``, and where on it: weights ``(P, 3)`` in space."""
    z = camera.project(torch.from_numpy(mesh.vertices))[1].numpy()
    front = np.flatnonzero((z[mesh.faces] > NEAR * z.max(initial=0.0)).all(axis=1))
    pixel, face, weights = nearest_faces(mesh.vertices, mesh.faces[front], camera)
    return pixel, front[face], weights
