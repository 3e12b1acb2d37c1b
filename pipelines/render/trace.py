"""What every pixel sees of a field: the coarse-to-fine trace, then one jet per pixel; large images in strips."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...datasets.cameras import Camera
from ...neural_fields import Field, Siren, sphere_trace
from ...neural_fields.networks.multiscale import as_levels, choose_levels, levels_of
from ...neural_fields.tracing.cones import CONE_LIPSCHITZ, CONE_STEPS, cone_starts
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS, MAX_STEPS, Hits, march_constants

STRIP = 1 << 19  # pixels that are worked on at a time: about a third of a gigabyte


@dataclass(frozen=True)
class Precision:
    """How exactly pictures are traced.

    Attributes:
        tolerance: of depths, in pixels; the Newton step leaves about its square.
        resolution: of the march, in pixels; nearer crossings may be missed.
        newton: longest Newton step, in pixels; a hit on the jump at a gate's edge is right where it is.
        shallow: slope along the ray below which no Newton step is made.
        nearest: least distance of what a camera in the shape looks at, in the field's units.
    """

    tolerance: float = 0.1
    resolution: float = 0.75
    newton: float = 0.2
    shallow: float = 0.05
    nearest: float = 0.05


PRECISION = Precision()


@dataclass(frozen=True)
class Seen:
    """One row for each pixel that sees the surface, traced in a field or rasterised from a mesh.

    Attributes:
        size: width and height of the image.
        pixel: ``(P,)`` int64, row-major: ``y * width + x``.
        depth: ``(P,)`` distance from the eye along the pixel's ray.
        position: ``(P, 3)`` the point seen.
        normal: ``(P, 3)`` unit outward normal there.
        direction: ``(P, 3)`` unit direction of the ray, away from the eye.
        color: ``(P, 3)`` the surface's own colour in [0, 1], if it has one.
    """

    size: tuple[int, int]
    pixel: Tensor
    depth: Tensor
    position: Tensor
    normal: Tensor
    direction: Tensor
    color: Tensor | None = None


def fine_strips(camera: Camera, samples: int, *, pixels: int | None = None) -> list[Camera]:
    """A camera as strips of ``pixels`` (`STRIP`) at most, each with ``samples`` pixels per pixel and direction."""
    rows = max(1, (pixels or STRIP) // samples**2 // camera.width)
    parts = (camera.strip(first, min(rows, camera.height - first)) for first in range(0, camera.height, rows))
    return [part.resized(part.width * samples, part.height * samples) for part in parts]


@torch.inference_mode()
def trace_view(
    field: Field,
    camera: Camera,
    *,
    level: int = -1,
    normal_level: int | None = None,
    colors: Callable[[Tensor], Tensor] | None = None,
    budget: Sequence[int] | None = None,
    device: torch.device | str = "cpu",
) -> Seen:
    """What the pixels of a camera see of a level of a field.

    The jet that gives the normal also gives the value at the hit, so the position takes one more Newton step along the
    ray. With a finer ``normal_level`` the normal is that level's gradient (neural normal mapping, paper Sec. 3).

    Args:
        field: three-dimensional, on ``device``.
        camera: in the field's coordinates.
        level: whose surface is seen.
        normal_level: whose gradient is the normal; by default ``level``.
        colors: of points ``(P, 3)``, mapped onto the level that is seen (paper Sec. 3, neural texture mapping).
        budget: steps on each level, for the paper's fixed mode; by default the adaptive one (see `sphere_trace`).
        device: where to work, and where the result is.

    Raises:
        ValueError: there is no such level, or the field is not three-dimensional.
    """
    level = field.resolve_level(level)
    normal_level = level if normal_level is None else field.resolve_level(normal_level)
    if budget is None and not camera.distortion and _draws_at_once(field, max(level, normal_level), device):
        return _draw(field, camera, level, normal_level, colors)
    eye, directions = camera.rays(device=device)
    hits = trace_hits(field, camera, eye, directions, level=level, budget=budget)
    return see_hits(field, camera, hits, directions, level=level, normal_level=normal_level, colors=colors)


def _draws_at_once(field: Field, level: int, device: torch.device | str) -> bool:
    """Whether the fused kernels draw whole pictures of the levels up to ``level``."""
    networks = levels_of(field)[: level + 1]
    if field.in_dim != 3 or not all(isinstance(network, Siren) for network in networks):
        return False
    like = field.like.new_empty(0, field.in_dim)
    return like.device.type == torch.device(device).type and choose_levels(networks, like, jet=True).fused


def _draw(
    field: Field, camera: Camera, level: int, normal_level: int, colors: Callable[[Tensor], Tensor] | None
) -> Seen:
    """What `trace_view` does, in a dozen launches."""
    from ...neural_fields.tracing.picture import Setting, draw

    pixel, eye = pixel_size(camera), camera.eye.tolist()
    axes = camera.world_from_camera[:3, :3].flatten().tolist()
    march = (PRECISION.tolerance * pixel, PRECISION.resolution * pixel, 1.0, PRECISION.newton * pixel)
    view = [*camera.fx_fy_cx_cy, *axes, *eye, *march, BOUNDING_RADIUS, math.hypot(*eye) + BOUNDING_RADIUS]
    setting = Setting(
        camera.width,
        camera.height,
        newton=normal_level == level,
        max_steps=MAX_STEPS,
        cone_steps=CONE_STEPS,
        lipschitz=CONE_LIPSCHITZ,
        shallow=PRECISION.shallow,
        march=tuple(march_constants(torch.float32).items()),
    )
    traced = as_levels(field, level)
    shown = traced if normal_level == level else as_levels(field, normal_level)
    drawn = draw(field, traced, shown, setting, view)
    return Seen((camera.width, camera.height), *drawn, None if colors is None else colors(drawn.position))


@torch.inference_mode()
def see_hits(
    field: Field,
    camera: Camera,
    hits: Hits,
    directions: Tensor,
    *,
    level: int,
    normal_level: int,
    colors: Callable[[Tensor], Tensor] | None = None,
) -> Seen:
    """What pixels see where their rays ``(H, W, 3)`` were traced already; the rest is as in `trace_view`."""
    pixel = hits.mask.flatten().nonzero()[:, 0]
    depth, direction = hits.depth.flatten()[pixel], directions.reshape(-1, 3)[pixel]
    position = hits.position.reshape(-1, 3)[pixel]
    jet = field.jet(position, level=normal_level)
    if normal_level == level:
        slope = (jet.gradient * direction).sum(dim=-1)
        trusted = slope.abs() > PRECISION.shallow * jet.gradient.norm(dim=-1)
        reach = PRECISION.newton * pixel_size(camera)
        step = torch.where(trusted, -jet.value / slope, 0).clamp(-reach, reach)
        depth, position = depth + step, torch.addcmul(position, step[:, None], direction)
    color = None if colors is None else colors(position)
    return Seen(
        (camera.width, camera.height), pixel, depth, position, normalize(jet.gradient, dim=-1), direction, color
    )


def trace_hits(
    field: Field, camera: Camera, eye: Tensor, directions: Tensor, *, level: int, budget: Sequence[int] | None = None
) -> Hits:
    """Trace the rays ``(H, W, 3)`` of a camera to a tenth of a pixel, tiles of them first."""
    if budget is not None:
        return sphere_trace(field, eye, directions, level=level, budget=budget)
    size = pixel_size(camera)
    return sphere_trace(
        field,
        eye,
        directions,
        level=level,
        near=cone_starts(field, eye, directions, level=level, lipschitz=CONE_LIPSCHITZ),
        tolerance=PRECISION.tolerance * size,
        resolution=PRECISION.resolution * size,
    )


def pixel_size(camera: Camera) -> float:
    """Width of a pixel at the near side of the ball that holds the surface, in the field's units."""
    distance = max(math.hypot(*camera.eye.tolist()) - BOUNDING_RADIUS, PRECISION.nearest)
    return distance / max(camera.fx_fy_cx_cy[:2])
