"""What the pixels of an image see of a mesh with a texture: its colours are looked up for every pixel."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from ..datasets.cameras import Camera
from ..datasets.meshes import vertex_normals
from ..datasets.textured import TexturedMesh, colors_at
from .raster import cover
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
    position = torch.from_numpy(np.einsum("pk,pkc->pc", weights, mesh.vertices[corners]))
    normals = vertex_normals(mesh.vertices, mesh.faces).astype(np.float64)
    normal = torch.from_numpy(np.einsum("pk,pkc->pc", weights, normals[corners]))
    offset = position - camera.eye  # before float32: at map coordinates the difference still has its digits
    depth = offset.norm(dim=1)
    return Seen(
        size=(camera.width, camera.height),
        pixel=torch.from_numpy(pixel),
        depth=depth.float(),
        position=position.float(),
        normal=torch.nn.functional.normalize(normal, dim=1).float(),
        direction=(offset / depth[:, None]).float(),
        color=torch.from_numpy(colors_at(mesh, face, weights)),
    )


def _visible(mesh: TexturedMesh, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Pixels ``(P,)`` that see a face, the nearest face ``(P,)``, and where on it: weights ``(P, 3)`` in space."""
    xy, z = (array.numpy() for array in camera.project(torch.from_numpy(mesh.vertices)))
    front = np.flatnonzero((z[mesh.faces] > NEAR * z.max(initial=0.0)).all(axis=1))
    # Bits of positive float32 are ordered as the numbers are, so depth and face compare as one integer.
    empty = np.iinfo(np.uint64).max
    nearest = np.full(camera.width * camera.height, empty, np.uint64)
    weights = np.zeros((len(nearest), 3))
    # With x and y exchanged, the columns of the raster are pixels in row-major order.
    for found in cover(xy[:, ::-1], mesh.faces[front], (camera.height, camera.width)):
        inverse = found.weights / z[mesh.faces[front[found.face]]]  # 1/z, not z, is linear on the screen
        total = inverse.sum(axis=1, keepdims=True)
        bits = (1 / total[:, 0]).astype(np.float32).view(np.uint32).astype(np.uint64)
        key = (bits << np.uint64(32)) | found.face.astype(np.uint64)
        np.minimum.at(nearest, found.column, key)
        won = nearest[found.column] == key
        weights[found.column[won]] = (inverse / total)[won]
    pixel = np.flatnonzero(nearest != empty)
    face = (nearest[pixel] & np.uint64(0xFFFFFFFF)).astype(np.int64)
    return pixel, front[face], weights[pixel]
