"""How much light reaches points of a surface, asked of the field itself: soft shadows and ambient occlusion.

Both work on any `Field` in the unit sphere and cost nothing for rays that are decided: those are gathered away.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..neural_fields import Field
from ..neural_fields.tracing import BOUNDING_RADIUS

__all__ = ["ambient_occlusion", "soft_shadow"]

# Steps inside the penumbra, in radii of the cone: with 0.5 streaks show on curved surfaces.
STRIDE = 0.2
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
        step = torch.maximum((near - slope * t) / (1 + slope), STRIDE * softness * t)
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
