"""Cameras as triangles with colours, in unit-sphere coordinates: frustums with pictures, a sphere, axes, points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from ...datasets.cameras import Camera
from ...datasets.views.images import PosedImages
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.meshing.extract import Mesh
from ..render.shade import COLOR_MAPS, apply_color_map
from ..surface.surface import joined

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Style:
    """How cameras are drawn; lengths are in radii of the region."""

    thumbnail: int = 48  # corners of a picture's triangles, along its longer side
    sparse_points: int = 20_000  # as many are drawn at most
    tube: float = 0.015  # thickness of the lines of a frustum, as a share of its size
    wire: float = 0.004  # radius of the lines of the sphere, and of sparse points
    axis: float = 0.25  # length of the axes
    # their colours, display RGB in [0, 1]
    axes: tuple[Rgb, Rgb, Rgb] = ((0.85, 0.15, 0.15), (0.15, 0.65, 0.2), (0.2, 0.35, 0.9))
    grey: Rgb = (0.62, 0.62, 0.62)  # of the sphere
    dark: Rgb = (0.3, 0.3, 0.3)  # of sparse points


STYLE = Style()


def camera_mesh(images: PosedImages) -> Mesh:
    """Frustums, the unit sphere around the region of interest, the axes of the world and sparse points, as one mesh.

    The lines of a frustum go from violet (the first view) to yellow (the last); its image plane shows the picture, and
    a triangle stands on the upper edge. The axes at the middle are those of the world: x red, y green, z blue.
    """
    cameras = [view.camera.moved(images.similarity) for view in images.views]
    size, reach = frustum_size(cameras)
    order = torch.linspace(0, 1, len(cameras), dtype=torch.float64)
    colors = apply_color_map(order, (0, 1), COLOR_MAPS["viridis"]).numpy()
    parts, tube = [_wire_sphere()], STYLE.tube * size
    for end, color in zip(STYLE.axis * np.eye(3), STYLE.axes, strict=True):
        parts.append(_tubes(np.stack((np.zeros(3), end))[None], 3 * STYLE.wire, color))
    for view, camera, color in zip(images.views, cameras, colors, strict=True):
        corners = _plane(camera, size, reach)
        parts += [_frame(camera.eye.numpy(), corners, color, tube), _picture(corners, view.color, tube)]
    if images.points is not None:
        step = 1 + (len(images.points) - 1) // STYLE.sparse_points
        parts.append(_octahedra(images.similarity.to_unit(images.points[::step]), STYLE.wire, STYLE.dark))
    return joined(parts)


def frustum_size(cameras: Sequence[Camera]) -> tuple[float, float]:
    """Longer side of the image planes and their greatest distance from the eyes, so that neighbours hardly meet."""
    eyes = torch.stack([camera.eye for camera in cameras])
    distance = max(float(eyes.norm(dim=1).median()), 0.1)
    apart = torch.cdist(eyes, eyes).fill_diagonal_(torch.inf).amin(dim=1)
    spacing = float(apart.median()) if len(cameras) > 1 else torch.inf
    return min(max(0.5 * spacing, 0.1 * distance), 0.3 * distance), 0.4 * distance


def _plane(camera: Camera, size: float, reach: float) -> Float64:
    """Corners ``(4, 3)`` of the image plane: upper left, upper right, lower right, lower left."""
    lens = camera.intrinsics.numpy()
    x, y = np.array([0, camera.width, camera.width, 0]) - 0.5, np.array([0, 0, camera.height, camera.height]) - 0.5
    rays = np.stack(((x - lens[0, 2]) / lens[0, 0], (y - lens[1, 2]) / lens[1, 1], np.ones(4)), axis=1)
    depth = min(size / max(np.ptp(rays[:, 0]), np.ptp(rays[:, 1])), reach)
    return camera.eye.numpy() + depth * rays @ camera.world_from_camera[:3, :3].numpy().T


def _frame(eye: Float64, corners: Float64, color: Float64, radius: float) -> Mesh:
    """Lines from the eye to the corners, the rim of the picture, and a triangle on its upper edge."""
    left, right, _, lower = corners
    apex = (left + right) / 2 + 0.25 * (left - lower)
    roof = np.array([[left, apex], [apex, right]])
    rays = np.stack((np.broadcast_to(eye, (4, 3)), corners), axis=1)
    rim = np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)
    return _tubes(np.concatenate((rays, rim, roof)), radius, color)


def _picture(corners: Float64, color: NDArray[np.float32], gap: float) -> Mesh:
    """The image plane, seen from both sides (``gap`` apart), with the picture as colours of a grid of vertices."""
    height, width = color.shape[:2]
    share = min(1.0, STYLE.thumbnail / max(height, width))
    columns, rows = max(2, round(share * width)), max(2, round(share * height))
    small = cv2.resize(color, (columns, rows), interpolation=cv2.INTER_AREA)
    across, along = np.linspace(0, 1, columns)[:, None], np.linspace(0, 1, rows)[:, None, None]
    upper = corners[0] + across * (corners[1] - corners[0])
    lower = corners[3] + across * (corners[2] - corners[3])
    grid = upper + along * (lower - upper)  # (rows, columns, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))  # normals point forward
    forward = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    # Each side has its own sheet, or the two would flicker where a viewer draws back faces.
    sheets = np.stack((grid + gap * forward / np.linalg.norm(forward), grid)).reshape(-1, 3)
    colors = np.tile(small.reshape(-1, 3).astype(np.float64), (2, 1))
    return Mesh(sheets, np.concatenate((faces, faces[:, ::-1] + number.size)), colors=colors)


def _wire_sphere(*, meridians: int = 6, parallels: int = 5, sides: int = 64) -> Mesh:
    """The unit sphere as circles through and around the z axis."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    turns = np.pi * np.arange(meridians) / meridians
    heights = np.pi * (np.arange(1, parallels + 1) / (parallels + 1) - 0.5)
    across = [np.stack((np.cos(t) * ring[:, 0], np.sin(t) * ring[:, 0], ring[:, 1]), axis=1) for t in turns]
    around = [np.concatenate((np.cos(h) * ring, np.full((sides + 1, 1), np.sin(h))), axis=1) for h in heights]
    circles = np.stack(across + around)
    return _tubes(np.stack((circles[:, :-1], circles[:, 1:]), axis=2).reshape(-1, 2, 3), STYLE.wire, STYLE.grey)


def _tubes(segments: Float64, radius: float, color: Rgb | Float64) -> Mesh:
    """Three-sided tubes along segments ``(S, 2, 3)``, closed at both ends."""
    return joined([_painted(trimesh.creation.cylinder(radius, segment=ends, sections=3), color) for ends in segments])


def _octahedra(points: Float64, radius: float, color: Rgb) -> Mesh:
    one = trimesh.convex.convex_hull(radius * np.concatenate((np.eye(3), -np.eye(3))))
    vertices = (points[:, None] + one.vertices).reshape(-1, 3)
    faces = (one.faces + len(one.vertices) * np.arange(len(points))[:, None, None]).reshape(-1, 3)
    return _painted(trimesh.Trimesh(vertices, faces, process=False), color)


def _painted(mesh: trimesh.Trimesh, color: Rgb | Float64) -> Mesh:
    vertices = np.asarray(mesh.vertices)
    return Mesh(vertices, np.asarray(mesh.faces), colors=np.tile(np.asarray(color, np.float64), (len(vertices), 1)))
