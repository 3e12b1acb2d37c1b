"""What the viewer works out apart from any browser: its cameras, depths for it, and what is under the pointer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets.cameras import Camera, orbit, pinhole_intrinsics
from ...neural_fields import Field, Similarity
from ...neural_fields.tracing.sphere import sphere_trace
from ..render.trace import Seen

__all__ = [
    "Reading",
    "describe_reading",
    "first_eye",
    "image_size",
    "probe",
    "viser_camera",
    "z_buffer",
]


def viser_camera(
    wxyz: Sequence[float] | NDArray[np.floating],
    position: Sequence[float] | NDArray[np.floating],
    fov: float,
    size: tuple[int, int],
) -> Camera:
    """The camera that viser describes; both sides look along +z with y down.

    Args:
        wxyz: ``(4,)`` quaternion of the rotation from camera to world, of any length but 0.
        position: ``(3,)`` of the eye.
        fov: full vertical angle of view, radians.
        size: width and height of the image.
    """
    width, height = size
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(_rotation(np.asarray(wxyz, np.float64)))
    pose[:3, 3] = torch.from_numpy(np.array(position, np.float64))
    return Camera(pinhole_intrinsics(math.degrees(fov), width, height), pose, width, height)


def _rotation(wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix ``(3, 3)`` of a quaternion: (w² − |v|²) 1 + 2 v vᵀ + 2 w [v]ₓ."""
    w, *v = wxyz / np.linalg.norm(wxyz)
    x, y, z = v
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (w * w - np.dot(v, v)) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


def image_size(side: int, canvas: tuple[int, int]) -> tuple[int, int]:
    """An image of about ``side``² pixels in the shape of the canvas, and no larger than it.

    viser interpolates depths when it enlarges an image, but averages their bytes one by one when it has to
    make one smaller, which gives wrong depths; hence never larger than the canvas.
    """
    width, height = (max(number, 1) for number in canvas)
    factor = min(1.0, side / math.sqrt(width * height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def z_buffer(seen: Seen, camera: Camera) -> NDArray[np.float32]:
    """Distance from the plane of the eye ``(H, W)``, which is not the distance along the ray; ∞ where nothing is."""
    forward = camera.forward.to(seen.direction)
    z = torch.full((seen.size[0] * seen.size[1],), torch.inf, dtype=torch.float32, device=seen.depth.device)
    z[seen.pixel] = (seen.depth * (seen.direction @ forward)).to(z.dtype)
    return z.reshape(seen.size[1], seen.size[0]).cpu().numpy()


def first_eye(up: str, fov: float) -> tuple[float, float, float]:
    """Where a camera stands that has all of the unit sphere in view, a little to the right of its front and above.

    Args:
        up: "y" or "z".
        fov: full angle of view, radians.
    """
    towards = orbit(torch.eye(3, dtype=torch.float64), up=up).forward
    x, y, z = (-towards / math.sin(fov / 2)).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class Reading:
    """The field at a point.

    Attributes:
        point: ``(3,)`` in unit-sphere coordinates.
        position: ``(3,)`` in input coordinates.
        normal: ``(3,)`` unit direction of the gradient of the level that is shown.
        level: the level that is shown.
        distances: signed distance of every level, in input units.
        on_plane: whether the point lies on the slice plane rather than on the surface.
    """

    point: NDArray[np.float64]
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    level: int
    distances: tuple[float, ...]
    on_plane: bool


def probe(
    field: Field,
    similarity: Similarity,
    origin: Sequence[float],
    direction: Sequence[float],
    *,
    level: int,
    surface: bool = True,
    plane: tuple[int, float] | None = None,
) -> Reading | None:
    """The first point of the surface or of a slice plane on a ray; None where there is neither.

    Args:
        field: what is shown.
        similarity: from input to unit-sphere coordinates.
        origin: ``(3,)`` where the ray begins.
        direction: ``(3,)`` where it goes, of any length but 0.
        level: the level that is shown.
        surface: whether the surface is there to be hit.
        plane: axis and position of a slice plane; it ends where the cube around the unit sphere does.
    """
    start = torch.tensor(origin, dtype=torch.float64)
    ray = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    start, ray = start.to(field.like), ray.to(field.like)
    depth, on_plane = torch.inf, False
    if surface:
        hits = sphere_trace(field, start, ray, level=level)
        depth = float(hits.depth) if bool(hits.mask) else torch.inf
    if plane is not None:
        crossed = _plane_depth(start, ray, *plane)
        depth, on_plane = min(depth, crossed), crossed < depth
    if depth == torch.inf:
        return None
    point = start + depth * ray
    with torch.no_grad():
        gradient = field.jet(point[None], level=level).gradient[0].cpu().double()
        values = [float(value) * similarity.scale for value in field.level_values(point[None])]
    normal = torch.nn.functional.normalize(gradient, dim=0).numpy()
    unit = point.cpu().double().numpy()
    return Reading(unit, similarity.to_input(unit), normal, field.resolve_level(level), tuple(values), on_plane)


def _plane_depth(start: torch.Tensor, ray: torch.Tensor, axis: int, position: float) -> float:
    """Where the ray meets the plane inside the cube [−1, 1]³; ∞ where it does not."""
    slope = float(ray[axis])
    depth = (position - float(start[axis])) / slope if slope else -1.0
    inside = bool(((start + depth * ray).abs() <= 1 + 1e-6).all())
    return depth if depth > 0 and inside else torch.inf


def describe_reading(reading: Reading | None, scale: float) -> str:
    """A reading in Markdown, with as many digits as lengths of the input's ``scale`` deserve."""
    if reading is None:
        return "Nothing is under the pointer."
    digits = max(0, 5 - int(np.floor(np.log10(scale))))
    position = ", ".join(f"{number:.{digits}f}" for number in reading.position)
    normal = ", ".join(f"{number:+.3f}" for number in reading.normal)
    distances = [
        f"{'**' * (level == reading.level)}f{level} = {distance:+.3g}{'**' * (level == reading.level)}"
        for level, distance in enumerate(reading.distances)
    ]
    return "  \n".join(
        [
            f"On the {'slice plane' if reading.on_plane else 'surface'}, level {reading.level}",
            f"position {position}",
            f"normal {normal}",
            f"distance {', '.join(distances)}",
        ]
    )
