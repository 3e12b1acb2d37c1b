"""Pictures of meshes and clouds without a GPU or a window: a z-buffer in numpy.

Images are ``(H, W, 3)`` uint8 RGB, or with an alpha channel ``(H, W, 4)``.

What the pixels of an image see of a mesh with a texture: its colours are looked up for every pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.clouds.meshes import vertex_normals
from ...datasets.textured.reading import TexturedMesh, colors_at
from ..surface.raster import clip, cover
from ..surface.surface import Surface
from .picture import Image
from .trace import Seen

__all__ = [
    "cloud_view",
    "mesh_view",
    "nearest_faces",
    "picture_of",
    "rows_seen",
    "textured_view",
]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

CLAY = (0.80, 0.78, 0.74)
BACK = (0.62, 0.36, 0.33)  # faces seen from inside, so that holes and wrong normals show
LAMP = (-0.6, -0.7, -0.4)  # towards the lamp, along the camera's right, down and forward
SUPERSAMPLING = 2
NEAR = 1e-4  # what is nearer than this share of the furthest depth is not drawn: it would fill the image


def mesh_view(surface: Surface, camera: Camera) -> Seen:
    """What the pixels see of a mesh; the part of it behind the camera is cut away.

    Normals and colours are those of the vertices, interpolated in space (not on the screen). Normals are unit
    again after that, and point where the mesh has them point: away from the camera, on faces seen from inside.

    Args:
        surface: a mesh; without normals, those of its faces are averaged at the vertices.
        camera: in the mesh's coordinates.

    Returns:
        One row per pixel that sees the mesh, in float32.
    """
    normals = surface.normals
    if normals is None:
        normals = vertex_normals(surface.vertices, surface.faces)
    attributes = [surface.vertices, normals] + ([] if surface.colors is None else [surface.colors])
    values = np.concatenate(attributes, axis=1)  # (V, 6 | 9): what is interpolated
    z = camera.project(torch.from_numpy(surface.vertices))[1].numpy()
    clipped = clip(z - _near(z), surface.faces)
    share = clipped.share[:, None]
    values = np.concatenate((values, (1 - share) * values[clipped.kept] + share * values[clipped.dropped]))
    pixel, face, weights = nearest_faces(values[:, :3], clipped.faces, camera)
    corners = clipped.faces[face]
    rows = np.zeros((len(pixel), values.shape[1]))
    for k in range(3):
        rows += weights[:, k, None] * values[corners[:, k]]
    return rows_seen(camera, pixel, rows[:, :3], rows[:, 3:6], None if surface.colors is None else rows[:, 6:])


def cloud_view(surface: Surface, camera: Camera, *, point_size: float | None = None) -> Seen:
    """What the pixels see of a cloud whose points are discs of one size on the screen.

    All pixels of a disc see its point. Where there is no normal, the surface is taken to face the camera.

    Args:
        surface: its vertices, with their normals and colours, are drawn; faces are not.
        camera: in the cloud's coordinates.
        point_size: diameter of the discs in pixels; by default such that they touch.

    Returns:
        One row per pixel that sees a point, in float32.
    """
    xy, z = (array.numpy() for array in camera.project(torch.from_numpy(surface.vertices)))
    front = np.flatnonzero(z > _near(z))
    xy, z, size = xy[front], z[front], (camera.width, camera.height)
    diameter = _touching(xy, size) if point_size is None else point_size
    pixel, index = _nearest_points(xy, z, size, diameter)
    index = front[index]
    normal = np.zeros((len(pixel), 3)) if surface.normals is None else surface.normals[index]
    return rows_seen(
        camera, pixel, surface.vertices[index], normal, None if surface.colors is None else surface.colors[index]
    )


def _near(z: Float64) -> float:
    return NEAR * max(float(z.max(initial=0.0)), 0.0)


def rows_seen(
    camera: Camera, pixel: Int64, position: Float64, normal: Float64, color: NDArray[np.floating] | None
) -> Seen:
    """Round to float32, after the eye has been taken off; a normal of length zero becomes one that faces the eye."""
    offset = torch.from_numpy(position) - camera.eye
    depth = offset.norm(dim=1, keepdim=True)
    direction = offset / depth
    towards = torch.from_numpy(normal).double()
    length = towards.norm(dim=1, keepdim=True)
    towards = torch.where(length > 0, towards / length, -direction)
    return Seen(
        size=(camera.width, camera.height),
        pixel=torch.from_numpy(pixel),
        depth=depth[:, 0].float(),
        position=torch.from_numpy(position).float(),
        normal=towards.float(),
        direction=direction.float(),
        color=None if color is None else torch.from_numpy(color).float(),
    )


def nearest_faces(vertices: Float64, faces: Int64, camera: Camera) -> tuple[Int64, Int64, Float64]:
    """Pixels ``(P,)`` that see a face, the nearest one ``(P,)``, and weights ``(P, 3)`` of its vertices in space.

    All of each face must be in front of the camera.
    """
    xy, z = (array.numpy() for array in camera.project(torch.from_numpy(vertices)))
    count = camera.width * camera.height
    nearest = np.full(count, np.inf, np.float32)
    face = np.full(count, -1, np.int64)
    weights = np.zeros((count, 3))
    # With x and y exchanged, the columns of the raster are pixels in row-major order.
    for found in cover(xy[:, ::-1], faces, (camera.height, camera.width)):
        inverse = found.weights / z[faces[found.face]]  # 1/z, not z, is linear on the screen
        depth = (1 / inverse.sum(axis=1)).astype(np.float32)
        np.minimum.at(nearest, found.column, depth)
        won = nearest[found.column] == depth
        pixel = found.column[won]
        face[pixel] = found.face[won]
        weights[pixel] = (inverse / inverse.sum(axis=1, keepdims=True))[won]
    pixel = np.flatnonzero(face >= 0)
    return pixel, face[pixel], weights[pixel]


def _touching(xy: Float64, size: tuple[int, int]) -> float:
    """A diameter at which discs spread over the box of the cloud cover it."""
    if not len(xy):
        return 2.0
    extent = np.ptp(xy.clip(0, size), axis=0)
    return float(np.clip(2.0 * np.sqrt(extent[0] * extent[1] / len(xy)), 2.0, 12.0))


def _nearest_points(xy: Float64, z: Float64, size: tuple[int, int], diameter: float) -> tuple[Int64, Int64]:
    """Pixels that see a point, and the index of the point each one sees."""
    reach = int(np.ceil(diameter / 2))
    # Far outside, where a point is does not matter, and it need not fit an integer.
    middle = np.rint(xy.clip(-2 * reach - 2, np.array(size) + 2 * reach + 2)).astype(np.int64)
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    disc = i**2 + j**2 <= (diameter / 2) ** 2
    # Bits of positive float32 are ordered as the numbers are, so depth and index compare as one integer.
    key = (z.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)) | np.arange(len(z), dtype=np.uint64)
    empty = np.iinfo(np.uint64).max
    buffer = np.full(size[0] * size[1], empty, np.uint64)
    for step in np.stack((i[disc], j[disc]), axis=1):  # a few dozen pixels of a disc
        x, y = (middle + step).T
        inside = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
        np.minimum.at(buffer, y[inside] * size[0] + x[inside], key[inside])
    pixel = np.flatnonzero(buffer != empty)
    return pixel, (buffer[pixel] & np.uint64(0xFFFFFFFF)).astype(np.int64)


def picture_of(
    surface: Surface, camera: Camera, *, point_size: float | None = None, supersampling: int = SUPERSAMPLING
) -> Image:
    """Draw a mesh (smooth-shaded, its back faces reddish), or a cloud as discs, on white.

    Args:
        surface: what to draw; with no faces it is a cloud. Colours and normals are used where there are any.
        camera: from where, and how large; in the surface's coordinates.
        point_size: diameter of a cloud's discs in pixels; by default such that they touch.
        supersampling: pixels drawn per pixel and direction.
    """
    fine = camera.resized(camera.width * supersampling, camera.height * supersampling)
    if len(surface.faces):
        seen = mesh_view(surface, fine)
        shade = _lit(seen, camera, back=BACK)
    else:
        seen = cloud_view(surface, fine, point_size=supersampling * point_size if point_size else None)
        # A point of a cloud has no back: its normal may be anything, and seeing far ones between near ones is normal.
        shade = _fading(seen, camera) if surface.normals is None else _lit(seen, camera, back=None)
    image = torch.ones(fine.height * fine.width, 3)
    image[seen.pixel] = shade
    image = (image * 255 + 0.5).byte().reshape(fine.height, fine.width, 3).numpy()
    size = (camera.width, camera.height)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _albedo(seen: Seen) -> Tensor:
    return torch.tensor(CLAY).expand_as(seen.position) if seen.color is None else seen.color


def _lit(seen: Seen, camera: Camera, *, back: tuple[float, float, float] | None) -> Tensor:
    """Headlight, a weaker lamp above left of the camera, and a little ambient light; ``(P, 3)`` in [0, 1]."""
    lamp = (camera.world_from_camera[:3, :3] @ torch.tensor(LAMP).double()).float()
    facing = -(seen.normal * seen.direction).sum(dim=1, keepdim=True)
    turned = torch.where(facing < 0, -seen.normal, seen.normal)
    light = 0.22 + 0.50 * facing.abs() + 0.34 * (turned @ (lamp / lamp.norm())[:, None]).clamp(min=0)
    albedo = _albedo(seen)
    if back is not None:
        albedo = torch.where(facing < 0, torch.tensor(back), albedo)
    return (albedo * light).clamp(0, 1)


def _fading(seen: Seen, camera: Camera) -> Tensor:
    """Without normals, only depth gives shape: the far side is darker; ``(P, 3)`` in [0, 1]."""
    depth = seen.depth * (seen.direction @ camera.forward.float())
    if not len(depth):
        return _albedo(seen)
    far = (depth - depth.min()) / (depth.max() - depth.min()).clamp(min=torch.finfo(depth.dtype).tiny)
    return _albedo(seen) * (1 - 0.55 * far)[:, None]


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
