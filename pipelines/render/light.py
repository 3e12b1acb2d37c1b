"""What shades a surface: soft shadows, ambient occlusion and curvature, asked of the field itself, and matcaps.

The first three work on any `Field` in the unit sphere; shadow rays that are decided are gathered away and cost nothing.
A material capture is the picture of a lit sphere, from which every normal takes its colour.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from ...neural_fields import Field, InputError
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS

__all__ = ["MATCAPS", "ambient_occlusion", "level_set_curvature", "load_matcap", "sample_matcap", "soft_shadow"]

Float32 = NDArray[np.float32]

MATCAPS = ("clay", "chrome")
# u below which a ray is given up as dark: v is 0.001 there, and steps only get smaller.
DARK = 0.02


@torch.no_grad()
def soft_shadow(
    field: Field,
    points: Tensor,
    normals: Tensor,
    towards_light: Tensor,
    *,
    level: int = -1,
    softness: float = 0.15,
    offset: float = 4e-3,
    bound: float = BOUNDING_RADIUS,
    max_steps: int = 160,
) -> Tensor:
    """How much of a distant lamp each point sees, in [0, 1]; the shadow's edge blurs with the distance it falls.

    A ray that meets the surface is dark, however thin the surface is, so that the core of a shadow is that of the
    lamp's centre. Another ray passes the surface at distance f after t, and is as light as its narrowest place:

        u = min_t f / (s t),    v = u² (3 − 2 u) for u < 1, else 1,

    with s = ``softness``, or the sine of the lamp's height over the tangent plane if that is less: what lies below the
    horizon gives no light in any case, so that planes and convex shapes are never shadowed by themselves.

    Steps are those of a cone of slope s that must not touch the surface, (f − s t) / (1 + s); once it does, half of
    f or a part of the cone's radius, so that little of the minimum is missed, but never more than f. Where a coarse
    level stands for finer ones (f ≥ δ), the surface may be nearer by δ, so that is taken off.

    Args:
        field: a 3-D field.
        points: ``(P, 3)`` on its surface, or near it.
        normals: ``(P, 3)`` unit normals; a point that faces away from the lamp is dark.
        towards_light: ``(3,)`` unit direction to the lamp.
        level: the level that casts the shadow; a coarse one is cheaper.
        softness: s > 0; 1e-3 is sharp.
        offset: height above the level's own surface from which rays start, so that nothing shadows itself.
        bound: radius of a sphere around the origin that holds the surface.
        max_steps: after so many steps a ray is judged by what it has met.

    Raises:
        ValueError: ``softness``, ``offset``, ``bound`` or ``max_steps`` is not positive.
    """
    for name, number in (("softness", softness), ("offset", offset), ("bound", bound), ("max_steps", max_steps)):
        if not number > 0:
            raise ValueError(f"{name}={number}: expected a number > 0")
    level = field.resolve_level(level)
    lamp = towards_light.to(points)
    slack = torch.cat((points.new_zeros(1), field.deltas[:level].to(points)))
    lit = points.new_zeros(len(points))
    height = normals @ lamp
    rows = (height > 0).nonzero()[:, 0]
    slope = height[rows].clamp(max=softness)
    start = _lifted(field, points[rows], normals[rows], level=level, offset=offset)
    left = _way_out(start, lamp, bound)
    t = torch.full_like(left, offset)
    least = torch.ones_like(left)
    for _ in range(max_steps):
        if not len(rows):
            break
        f = field.value(start + t[:, None] * lamp, level=level)
        least = torch.minimum(least, f / (slope * t))
        near = f - torch.where(f[:, None] >= slack, slack, 0).amax(1)
        # Steps inside the penumbra, in radii of the cone: with 0.5 streaks show on curved surfaces.
        step = torch.maximum((near - slope * t) / (1 + slope), 0.2 * softness * t)
        step = torch.minimum(torch.maximum(step, near / 2), near)
        t = t + step.clamp(min=offset / 4)
        going = (least > DARK) & (t < left)
        lit[rows[~going]] = _light_through(least[~going])
        kept = going.nonzero()[:, 0]
        rows, slope, start, left, t, least = (each[kept] for each in (rows, slope, start, left, t, least))
    lit[rows] = _light_through(least)
    return lit


@torch.no_grad()
def ambient_occlusion(
    field: Field, points: Tensor, normals: Tensor, *, level: int = -1, reach: float = 0.15, samples: int = 5
) -> Tensor:
    """How open the surroundings of each point are: 1 on a plane or a convex shape, 0 in the depth of a slit.

    The mean of clamp((f(p + d n) − f(p)) / d, 0, 1) over ``samples`` distances d along the normal, evenly spaced up
    to ``reach``. In a concave corner f grows slower than d, and the further away the less.

    Args:
        field: a 3-D field.
        points: ``(P, 3)`` on its surface, or near it.
        normals: ``(P, 3)`` unit normals.
        level: the level to ask; a coarse one is cheaper.
        reach: how far around to look, > 0.
        samples: values asked for along each normal, ≥ 1.

    Raises:
        ValueError: ``reach`` or ``samples`` is not positive.
    """
    if not reach > 0 or samples < 1:
        raise ValueError(f"reach={reach}, samples={samples}: expected reach > 0 and samples ≥ 1")
    steps = reach * torch.arange(1, samples + 1, dtype=points.dtype, device=points.device) / samples
    here = field.value(points, level=level)
    above = field.value(points + steps[:, None, None] * normals, level=level)  # (S, P)
    return ((above - here) / steps[:, None]).clamp(0, 1).mean(0)


def _lifted(field: Field, points: Tensor, normals: Tensor, *, level: int, offset: float) -> Tensor:
    """Points moved along their normals to ``offset`` above the surface of ``level``, if they are not higher."""
    height = field.value(points, level=level)
    return points + (offset - height).clamp(min=0)[:, None] * normals


def _way_out(start: Tensor, direction: Tensor, bound: float) -> Tensor:
    """Distance along ``direction`` at which rays leave the ball of radius ``bound``; 0 or less if they are out."""
    along = start @ direction
    inside = along * along - (start * start).sum(-1) + bound * bound
    return torch.where(inside > 0, inside.clamp(min=0).sqrt() - along, 0)


def _light_through(u: Tensor) -> Tensor:
    u = torch.where(u > DARK, u, 0).clamp(max=1)
    return u * u * (3 - 2 * u)


@torch.no_grad()
def level_set_curvature(field: Field, points: Tensor, *, level: int = -1, step: float = 2e-3) -> Tensor:
    """H = ½ div(∇f / |∇f|) of the level set through each point, by central differences: 1/r on a sphere.

    The unit gradient n changes only within the tangent plane, ⟨n, ∂n⟩ = 0, so that along two tangents a and b

        2 H = ⟨a, n(p + h a) − n(p − h a)⟩ / 2h + ⟨b, n(p + h b) − n(p − h b)⟩ / 2h.

    Convex is positive. The error grows with h² and with (rounding of n) / h.

    Args:
        field: a 3-D field; where its gradient is zero there is no level set, and H is 0.
        points: ``(P, 3)``.
        level: the level to ask.
        step: h; details smaller than it are averaged.

    Raises:
        ValueError: ``step`` is not positive.
    """
    if not step > 0:
        raise ValueError(f"step={step}: expected a number > 0")
    tangents = _tangents(normalize(field.jet(points, level=level).gradient, dim=-1))  # (2, P, 3)
    offsets = step * torch.stack((tangents, -tangents))  # (2, 2, P, 3)
    normals = normalize(field.jet(points + offsets, level=level).gradient, dim=-1)
    return (tangents * (normals[0] - normals[1])).sum((0, -1)) / (4 * step)


def _tangents(n: Tensor) -> Tensor:
    """Two unit tangents ``(2, P, 3)`` across unit normals (Duff et al. 2017, "Building an orthonormal basis")."""
    x, y, z = n.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    second = torch.stack((b, sign + y * y * a, -y), -1)
    return torch.stack((first, second))


def load_matcap(name: str | Path) -> Tensor:
    """One of `MATCAPS`, or a PNG or JPEG of a sphere that fills it → ``(H, W, 3)`` display RGB in [0, 1].

    Raises:
        InputError: no such file, or it is not an image.
    """
    if str(name) in MATCAPS:
        normals = _sphere(256)
        return torch.from_numpy(_clay(normals) if str(name) == "clay" else _chrome(normals))
    path = Path(name)
    if not path.is_file():
        raise InputError(f"matcap {path}: no such file; name a PNG or JPEG of a sphere, or one of {', '.join(MATCAPS)}")
    data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        raise InputError(f"matcap {path}: cannot be read as an image; expected a PNG or JPEG of a sphere")
    return torch.from_numpy(image[..., ::-1].astype(np.float32) / 255)


def sample_matcap(matcap: Tensor, normals: Tensor) -> Tensor:
    """Colours of camera-space normals ``(P, 3)`` (x right, y up, z towards the eye) → ``(P, 3)``, bilinear.

    The sphere touches the four edges of the image. Normals that face away take the colour of its rim.
    """
    across = normals[:, :2]
    length = across.norm(dim=1, keepdim=True)
    # So far inside the rim that no texel of the background is mixed in: √2 texels, and a little.
    rim = 1 - 3 / min(matcap.shape[:2])
    kept = torch.where(normals[:, 2:] > 0, length.clamp(max=rim), rim)
    across = across * (kept / length.clamp(min=1e-6))
    grid = torch.stack((across[:, 0], -across[:, 1]), -1)[None, :, None]  # (1, P, 1, 2)
    texture = matcap.to(normals).movedim(-1, 0)[None]  # (1, 3, H, W)
    found = grid_sample(texture, grid, padding_mode="border", align_corners=False)
    return found[0, :, :, 0].T


def _sphere(size: int) -> Float32:
    """Normals ``(size, size, 3)`` of a sphere that fills an image; outside it, those of the rim."""
    at = (np.arange(size, dtype=np.float32) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(at, -at)
    radius = np.hypot(x, y)
    shrink = np.minimum(1, 1 / np.maximum(radius, 1e-6))
    x, y = x * shrink, y * shrink
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return np.stack((x, y, z), -1).astype(np.float32)


def _toward(normals: Float32, direction: tuple[float, float, float]) -> Float32:
    """Cosine with a direction, not below 0."""
    unit = np.asarray(direction, np.float32) / np.linalg.norm(direction).astype(np.float32)
    return np.maximum(normals @ unit, 0)[..., None]


def _clay(normals: Float32) -> Float32:
    """Terracotta: a broad warm lamp from the upper left, a cool one from the right, and a dull shine."""
    base = np.array([0.50, 0.21, 0.13], np.float32)  # linear light
    key = _toward(normals, (-0.5, 0.7, 0.6))
    light = (
        np.array([0.16, 0.15, 0.16]) * (0.7 + 0.3 * normals[..., 1:2])
        + np.array([1.05, 1.0, 0.92]) * key
        + np.array([0.16, 0.20, 0.26]) * _toward(normals, (0.9, 0.0, 0.35))
    )
    shine = 0.07 * _toward(normals, (-0.28, 0.40, 0.9)) ** 24  # half-way between the lamp and the eye
    edge = 0.06 * (1 - normals[..., 2:]) ** 3
    return _display(base * light + shine + edge)


def _chrome(normals: Float32) -> Float32:
    """A mirror in a studio: a sky that pales towards the horizon, a dark floor and one soft window."""
    mirrored = 2 * normals[..., 2:] * normals - np.array([0, 0, 1], np.float32)
    height = mirrored[..., 1:2]
    sky = 0.22 + 0.60 * (1 - np.clip(height, 0, 1)) ** 1.5
    floor = 0.04 + 0.40 * np.clip(-height, 0, 1) ** 1.2
    above = 1 / (1 + np.exp(-height * 14))
    window = 1 / (1 + np.exp((0.90 - _toward(mirrored, (-0.5, 0.6, 0.62))) * 60))
    tint = np.array([0.95, 0.98, 1.04]) * above + np.array([1.02, 1.0, 0.96]) * (1 - above)
    return _display((sky * above + floor * (1 - above)) * tint + 0.7 * window)


def _display(linear: NDArray[np.floating]) -> Float32:
    return (linear.clip(0, 1) ** (1 / 2.2)).astype(np.float32)
