"""What the pixels of an image see of a mesh or a cloud, by a z-buffer in numpy: a `Seen`, as of a traced field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.cameras import Camera
from ...datasets.clouds.readers.meshes import vertex_normals
from ...datasets.textured.reading import TexturedMesh, colors_at, read_textured
from ...neural_fields import InputError, Mesh
from ..surface.distance import barycentric_of_nearest
from ..surface.raster import Float64, Int64, clip, cover
from ..surface.surface import read_surface
from .picture import Image
from .shade import ShadeOptions, compose, default_shading, downsample, shade
from .trace import Seen

Painted = Mesh | TexturedMesh


def read_painted(path: str | Path) -> Painted:
    """Read a mesh or a cloud to draw, with its texture if an OBJ or glTF file has one; raises InputError.

    An OBJ whose materials or images are missing is read without them.
    """
    path = Path(path)
    if path.suffix.lower() in (".obj", ".glb", ".gltf"):
        try:
            mesh = read_textured(path)
        except InputError:
            return read_surface(path)  # which says what is wrong, if more than the colours are
        if mesh.image is not None:
            return mesh
    return read_surface(path)


def mesh_view(mesh: Painted, camera: Camera) -> Seen:
    """What the pixels of a camera see of a mesh, in float32; the part behind the camera is cut away.

    Normals (by default the mean of the faces') and colours of vertices are interpolated in space, not on the screen.
    Colours of a `TexturedMesh` are bilinear in linear light at the middle of each pixel: for textures finer than the
    pixels, draw more pixels and average them.
    """
    pixel, face, weights = _visible(mesh.vertices, mesh.faces, camera)
    corners = mesh.faces[face]

    def interpolated(rows: NDArray[np.floating]) -> Float64:
        return sum((weights[:, k, None] * rows[corners[:, k]] for k in range(3)), np.zeros((len(face), 3)))

    normals = mesh.normals if isinstance(mesh, Mesh) else None
    if normals is None:
        normals = vertex_normals(mesh.vertices, mesh.faces)
    if isinstance(mesh, TexturedMesh):
        colors = colors_at(mesh, face, weights)
    else:
        colors = None if mesh.colors is None else interpolated(mesh.colors)
    return _rows_seen(camera, pixel, interpolated(mesh.vertices), interpolated(normals), colors)


def cloud_view(surface: Mesh, camera: Camera, *, point_size: float | None = None) -> Seen:
    """What the pixels see of a cloud whose points are discs, ``point_size`` pixels wide; by default they touch.

    All pixels of a disc see its point. Points without a normal face the camera.
    """
    xy, z = (array.numpy() for array in camera.project(torch.from_numpy(surface.vertices)))
    front = np.flatnonzero(z > _near(z))
    xy, z, size = xy[front], z[front], (camera.width, camera.height)
    diameter = _touching(xy, size) if point_size is None else point_size
    pixel, index = _nearest_points(xy, z, size, diameter)
    index = front[index]
    normal = np.zeros((len(pixel), 3)) if surface.normals is None else surface.normals[index]
    return _rows_seen(
        camera, pixel, surface.vertices[index], normal, None if surface.colors is None else surface.colors[index]
    )


def _near(z: Float64) -> float:
    # What is nearer than this share of the furthest depth would fill the image.
    return 1e-4 * max(float(z.max(initial=0.0)), 0.0)


def _visible(vertices: Float64, faces: NDArray[np.integer], camera: Camera) -> tuple[Int64, Int64, Float64]:
    """Pixels ``(P,)`` that see a face, the nearest face ``(P,)``, and weights ``(P, 3)`` of its corners in space."""
    z = camera.project(torch.from_numpy(vertices))[1].numpy()
    every, parts, owner = clip(vertices, z - _near(z), faces)
    pixel, part, weights = _nearest_faces(every, parts, camera)
    face, ends = owner[part], parts[part]
    cut = (ends >= len(vertices)).any(axis=1)
    places = (weights[cut][..., None] * every[ends[cut]]).sum(axis=1)
    weights[cut] = barycentric_of_nearest(places, vertices[faces[face[cut]]])
    return pixel, face, weights


def _nearest_faces(vertices: Float64, faces: NDArray[np.integer], camera: Camera) -> tuple[Int64, Int64, Float64]:
    """`_visible`, of faces that are in front of the camera as a whole."""
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


def _rows_seen(
    camera: Camera, pixel: Int64, position: Float64, normal: NDArray[np.floating], color: NDArray[np.floating] | None
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
    surface: Mesh, camera: Camera, *, point_size: float | None = None, samples: int = 2, shading: str | None = None
) -> Image:
    """A picture of a mesh, or of a cloud as discs, on white, as ``mplicits render`` draws it by default.

    ``point_size`` is the diameter of discs in pixels (by default they touch), ``samples`` is per pixel and direction,
    and ``shading`` one of `SHADINGS` that needs no field.
    """
    fine, solid = camera.resized(camera.width * samples, camera.height * samples), bool(len(surface.faces))
    if solid:
        seen = mesh_view(surface, fine)
    else:
        seen = cloud_view(surface, fine, point_size=samples * point_size if point_size else None)
    usual = default_shading(oriented=solid or surface.normals is not None, colored=surface.colors is not None)
    # A point of a cloud has no back: its normal may be anything, and seeing far ones between near ones is normal.
    colors = shade(seen, shading or usual, camera=fine, options=ShadeOptions(back_faces=solid))
    return downsample(compose(seen, colors), samples)
