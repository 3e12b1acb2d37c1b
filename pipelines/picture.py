"""Pictures of meshes and clouds without a GPU or a window: a z-buffer in numpy.

Image coordinates are OpenCV's: x right, y down, z forward. Images are ``(H, W, 3)`` uint8 RGB.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from ..datasets.meshes import vertex_normals
from ..neural_fields import InputError
from .raster import cover
from .surface import Surface

__all__ = ["Camera", "contact_sheet", "look_at", "picture_of", "write_picture"]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Image = NDArray[np.uint8]

CLAY = (0.80, 0.78, 0.74)
BACK = (0.62, 0.36, 0.33)  # faces seen from inside, so that holes and wrong normals show
SUPERSAMPLING = 2


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        eye: ``(3,)`` where it stands.
        axes: ``(3, 3)`` rows right, down, forward, in world coordinates.
        fov: full vertical angle of view, degrees.
    """

    eye: Float64
    axes: Float64
    fov: float


def look_at(
    points: Float64,
    *,
    azimuth: float = 30.0,
    elevation: float = 15.0,
    up: str = "y",
    fov: float = 25.0,
    aspect: float = 1.0,
    margin: float = 0.94,
) -> Camera:
    """A camera on an orbit around ``points`` ``(N, 3)``, as near as it can be with all of them in view.

    Args:
        points: what to look at.
        azimuth: degrees around the up axis, counter-clockwise from the front (+z for ``up="y"``, −y for ``up="z"``).
        elevation: degrees above the horizon, less than 90 either way.
        up: "y" or "z", the axis that points up.
        fov: full vertical angle of view, degrees.
        aspect: width over height of the image.
        margin: share of the image that the points may fill.

    Raises:
        ValueError: ``up`` is neither axis.
    """
    if up not in ("y", "z"):
        raise ValueError(f"up={up!r}: expected 'y' or 'z'")
    a, e = np.radians(azimuth), np.radians(elevation)
    side, front, high = np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)
    towards_eye = np.array([side, high, front]) if up == "y" else np.array([side, -front, high])
    forward = -towards_eye
    right = np.cross(forward, [0.0, 1.0, 0.0] if up == "y" else [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.stack((right, np.cross(forward, right), forward))
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    x, y, z = ((points - center) @ axes.T).T
    slope = np.tan(np.radians(fov) / 2) * margin
    # From distance d, a point at camera offset (x, y, z) is in view if |y| ≤ slope (d + z), and so for x.
    needed = np.maximum(np.abs(x) / (slope * aspect), np.abs(y) / slope) - z
    return Camera(center - float(needed.max()) * forward, axes, fov)


def picture_of(
    surface: Surface,
    camera: Camera,
    *,
    size: tuple[int, int] = (640, 640),
    point_size: float | None = None,
    supersampling: int = SUPERSAMPLING,
) -> Image:
    """Draw a mesh (smooth-shaded, its back faces reddish), or a cloud as discs, on white.

    Args:
        surface: what to draw; with no faces it is a cloud. Colours and normals are used where there are any.
        camera: from where; every vertex must be in front of it.
        size: width and height of the image.
        point_size: diameter of a cloud's discs in pixels; by default such that they touch.
        supersampling: pixels drawn per pixel and direction.
    """
    width, height = size[0] * supersampling, size[1] * supersampling
    seen = (surface.vertices - camera.eye) @ camera.axes.T  # (V, 3)
    focal = height / 2 / np.tan(np.radians(camera.fov) / 2)
    xy = focal * seen[:, :2] / seen[:, 2:] + (np.array([width, height]) - 1) / 2
    if len(surface.faces):
        pixel, position, normal, color = _mesh_pixels(surface, seen[:, 2], xy, (width, height))
    else:
        diameter = supersampling * point_size if point_size else _touching(xy, (width, height))
        pixel, index = _cloud_pixels(xy, seen[:, 2], (width, height), diameter)
        position = surface.vertices[index]
        normal = None if surface.normals is None else surface.normals[index]
        color = None if surface.colors is None else surface.colors[index]
    image = np.ones((width * height, 3), np.float32)
    # A point of a cloud has no back: its normal may be anything, and seeing far ones between near ones is normal.
    image[pixel] = _shade(position, normal, color, camera, back=BACK if len(surface.faces) else None)
    image = image.reshape(width, height, 3).swapaxes(0, 1)
    return cv2.resize((image * 255 + 0.5).astype(np.uint8), size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def _mesh_pixels(
    surface: Surface, depth: Float64, xy: Float64, size: tuple[int, int]
) -> tuple[Int64, Float64, Float64, Float64 | None]:
    """Pixels that see the mesh, with what they see: positions, normals and colours ``(P, 3)``."""
    count = size[0] * size[1]
    nearest = np.full(count, np.inf, np.float32)
    face = np.full(count, -1, np.int64)
    weights = np.zeros((count, 3))
    for found in cover(xy, surface.faces, size):
        inverse = found.weights / depth[surface.faces[found.face]]  # 1/z, not z, is linear on the screen
        z = (1 / inverse.sum(axis=1)).astype(np.float32)
        np.minimum.at(nearest, found.column, z)
        won = nearest[found.column] == z
        pixel = found.column[won]
        face[pixel] = found.face[won]
        weights[pixel] = (inverse / inverse.sum(axis=1, keepdims=True))[won]
    pixel = np.flatnonzero(face >= 0)
    corners, weights = surface.faces[face[pixel]], weights[pixel]

    def interpolate(values: Float64) -> Float64:
        return np.einsum("pk,pkc->pc", weights, values[corners])

    normals = surface.normals
    if normals is None:
        normals = vertex_normals(surface.vertices, surface.faces).astype(np.float64)
    colors = None if surface.colors is None else interpolate(surface.colors)
    return pixel, interpolate(surface.vertices), interpolate(normals), colors


def _touching(xy: Float64, size: tuple[int, int]) -> float:
    """A diameter at which discs spread over the box of the cloud cover it."""
    extent = np.ptp(xy.clip(0, size), axis=0)
    return float(np.clip(2.0 * np.sqrt(extent[0] * extent[1] / len(xy)), 2.0, 12.0))


def _cloud_pixels(xy: Float64, depth: Float64, size: tuple[int, int], diameter: float) -> tuple[Int64, Int64]:
    """Pixels that see a point, and the index of the point each one sees."""
    middle = np.rint(xy).astype(np.int64)
    reach = int(np.ceil(diameter / 2))
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    disc = i**2 + j**2 <= (diameter / 2) ** 2
    # Bits of positive float32 are ordered as the numbers are, so depth and index compare as one integer.
    key = (depth.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)) | np.arange(
        len(depth), dtype=np.uint64
    )
    empty = np.iinfo(np.uint64).max
    buffer = np.full(size[0] * size[1], empty, np.uint64)
    for step in np.stack((i[disc], j[disc]), axis=1):  # a few dozen pixels of a disc
        x, y = (middle + step).T
        inside = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
        np.minimum.at(buffer, x[inside] * size[1] + y[inside], key[inside])
    pixel = np.flatnonzero(buffer != empty)
    return pixel, (buffer[pixel] & np.uint64(0xFFFFFFFF)).astype(np.int64)


def _shade(
    position: Float64,
    normal: Float64 | None,
    color: Float64 | None,
    camera: Camera,
    *,
    back: tuple[float, float, float] | None,
) -> Float64:
    """Headlight, a weaker lamp above left of the camera, and a little ambient light; ``(P, 3)`` in [0, 1]."""
    albedo = np.broadcast_to(CLAY, position.shape) if color is None else color
    to_eye = camera.eye - position
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    if normal is None:
        # Without normals, only depth gives shape: the far side is darker.
        depth = (position - camera.eye) @ camera.axes[2]
        span = float(np.ptp(depth)) if len(depth) else 0.0
        far = (depth - depth.min()) / span if span > 0 else np.zeros(len(depth))
        return albedo * (1 - 0.55 * far)[:, None]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=to_eye.copy(), where=length > 0)
    facing = (normal * to_eye).sum(axis=1)
    lamp = np.array([-0.6, -0.7, -0.4]) @ camera.axes
    lamp /= np.linalg.norm(lamp)
    turned = normal * np.where(facing < 0, -1.0, 1.0)[:, None]
    light = 0.22 + 0.50 * np.abs(facing) + 0.34 * (turned @ lamp).clip(0)
    if back is not None:
        albedo = np.where((facing < 0)[:, None], back, albedo)
    return (albedo * light[:, None]).clip(0, 1)


def contact_sheet(pictures: Sequence[tuple[str, Image]], *, gap: int = 12, strip: int = 40) -> Image:
    """Pictures of one height side by side, each one's label above it.

    Raises:
        ValueError: there are no pictures, or their heights differ.
    """
    heights = {image.shape[0] for _, image in pictures}
    if len(heights) != 1:
        raise ValueError(f"pictures: expected at least one, all of one height; got heights {sorted(heights)}")
    tiles = []
    for label, image in pictures:
        tile = np.full((image.shape[0] + strip, image.shape[1] + gap, 3), 255, np.uint8)
        tile[strip:, gap // 2 : gap // 2 + image.shape[1]] = image
        scale = 0.6
        (width, _), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        scale = min(scale, scale * (image.shape[1] - 2 * gap) / max(width, 1))
        place = (gap, strip - 14)
        cv2.putText(tile, label, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (40, 40, 40), 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.concatenate(tiles, axis=1)


def write_picture(path: str | Path, image: Image) -> None:
    """Write a PNG or JPEG, through a temporary file beside the target.

    Raises:
        InputError: the extension is another one, or the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{path}: pictures are written as .png or .jpg")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    iio.imwrite(partial, image)
    partial.replace(path)
