"""Building blocks of procedural solids: each maps points ``(N, 3)`` to a distance and its gradient.

Formulas for the distances and for the polynomial smooth minimum follow Inigo Quilez, "Distance functions" and
"Smooth minimum" (iquilezles.org). A combination of solids is 1-Lipschitz wherever its parts are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

Vector = tuple[float, float, float]


class Solid(NamedTuple):
    """Distance (or a bound of it) ``(N,)``, negative inside, and its gradient ``(N, 3)``."""

    value: Tensor
    gradient: Tensor


def ellipsoid(p: Tensor, center: Vector, radii: Vector) -> Solid:
    """``k0 (k0 - 1) / k1`` with k0 = |p/r|, k1 = |p/r²|: exact to first order at the surface."""
    inverse = 1 / _vector(radii, p)
    q = p - _vector(center, p)
    scaled = q * inverse
    twice = scaled * inverse
    k0 = _norm(scaled)
    k1 = _norm(twice)
    value = k0 * (k0 - 1) / k1
    along = ((2 * k0 - 1) / (k0 * k1))[:, None] * twice
    return Solid(value, along - (value / k1**2)[:, None] * twice * inverse**2)


def round_cone(p: Tensor, start: Vector, end: Vector, start_radius: float, end_radius: float) -> Solid:
    """Exact distance to the hull of two spheres."""
    axis = [b - a for a, b in zip(start, end, strict=True)]
    length = math.sqrt(sum(c * c for c in axis))
    direction = _vector((axis[0] / length, axis[1] / length, axis[2] / length), p)
    q = p - _vector(start, p)
    along = q @ direction
    across = q - along[:, None] * direction
    rho = _norm(across)
    slope = (start_radius - end_radius) / length  # sine of the half opening angle
    slant = math.sqrt(1 - slope * slope)
    # the foot of p on the axis, seen along the cone's normal, decides which part is nearest
    foot = along - rho * slope / slant
    tip = (foot / length).clamp(0, 1)
    to_ball = q - (tip * length)[:, None] * direction
    ball = _norm(to_ball)
    on_side = (foot > 0) & (foot < length)
    side = slant * rho + slope * along - start_radius
    value = torch.where(on_side, side, ball - torch.where(foot > 0, end_radius, start_radius))
    side_gradient = (slant / rho)[:, None] * across + slope * direction
    return Solid(value, torch.where(on_side[:, None], side_gradient, to_ball / ball[:, None]))


def torus(p: Tensor, center: Vector, normal: Vector, major: float, minor: float) -> Solid:
    """Exact distance to a torus around the axis ``normal`` (of unit length)."""
    n = _vector(normal, p)
    q = p - _vector(center, p)
    height = q @ n
    radial = q - height[:, None] * n
    rho = _norm(radial)
    ring = rho - major
    length = torch.sqrt(ring * ring + height * height + _TINY)
    return Solid(length - minor, ((ring / (rho * length))[:, None] * radial) + (height / length)[:, None] * n)


def rounded_box(p: Tensor, center: Vector, half: Vector, rounding: float) -> Solid:
    """Exact distance outside a box of half-sizes ``half`` with edges rounded by ``rounding``."""
    q = p - _vector(center, p)
    beyond = q.abs() - (_vector(half, p) - rounding)
    outer = beyond.clamp(min=0)
    length = _norm(outer)
    deepest, axis = beyond.max(dim=1)
    inward = torch.nn.functional.one_hot(axis, 3).to(p.dtype)
    gradient = torch.where((deepest > 0)[:, None], outer / length[:, None], inward) * q.sign()
    return Solid(length + deepest.clamp(max=0) - rounding, gradient)


def rounded_drum(p: Tensor, center: Vector, radius: float, half_height: float, rounding: float) -> Solid:
    """Exact distance outside a cylinder along z with rounded rims."""
    q = p - _vector(center, p)
    rho = torch.sqrt(q[:, 0] ** 2 + q[:, 1] ** 2 + _TINY)
    a, b = rho - (radius - rounding), q[:, 2].abs() - (half_height - rounding)
    oa, ob = a.clamp(min=0), b.clamp(min=0)
    length = torch.sqrt(oa * oa + ob * ob + _TINY)
    outside = torch.maximum(a, b) > 0
    sideways = torch.where(outside, oa / length, (a >= b).to(p.dtype)) / rho
    upward = torch.where(outside, ob / length, (a < b).to(p.dtype)) * q[:, 2].sign()
    gradient = torch.stack((sideways * q[:, 0], sideways * q[:, 1], upward), dim=1)
    return Solid(length + torch.maximum(a, b).clamp(max=0) - rounding, gradient)


def smooth_union(a: Solid, b: Solid, width: float) -> Solid:
    """Quadratic smooth minimum: blends where the two differ by less than ``width``.

    With h = clamp(½ + (b - a)/(2 width)) it is b + (a - b) h - width h (1 - h), whose derivative with
    respect to h vanishes: the gradient is just (1 - h) ∇b + h ∇a.
    """
    h = (0.5 + (b.value - a.value) / (2 * width)).clamp(0, 1)
    value = torch.lerp(b.value, a.value, h) - width * h * (1 - h)
    return Solid(value, torch.lerp(b.gradient, a.gradient, h[:, None]))


def carve(a: Solid, b: Solid, width: float) -> Solid:
    """Smooth difference: ``a`` without ``b``."""
    rest = smooth_union(Solid(-a.value, -a.gradient), b, width)
    return Solid(-rest.value, -rest.gradient)


def displace(a: Solid, by: Solid) -> Solid:
    """Move the surface outward by ``by.value``."""
    return Solid(a.value - by.value, a.gradient - by.gradient)


def fold(p: Tensor) -> tuple[Tensor, Tensor]:
    """Mirror the half space x < 0 onto x > 0; returns points and the factor ``(N, 3)`` their gradients need."""
    sign = torch.ones_like(p)
    sign[:, 0] = torch.where(p[:, 0] < 0, -1.0, 1.0)
    return p * sign, sign


def tilt(p: Tensor, center: Vector, angles: Vector) -> tuple[Tensor, Tensor]:
    """Points ``p`` in a frame turned by ``angles`` (radians; about x, then y, then z) around ``center``.

    The second result is the matrix that takes gradients ``(N, 3)`` back: ``gradient @ matrix``.
    """
    cx, cy, cz = (math.cos(angle) for angle in angles)
    sx, sy, sz = (math.sin(angle) for angle in angles)
    about_x = torch.tensor([[1, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=p.dtype, device=p.device)
    about_y = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=p.dtype, device=p.device)
    about_z = torch.tensor([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]], dtype=p.dtype, device=p.device)
    turn = about_z @ about_y @ about_x
    middle = _vector(center, p)
    return (p - middle) @ turn + middle, turn.T


_TINY = 1e-18  # keeps roots differentiable at zero; far below float32's resolution of a unit length


def _norm(v: Tensor) -> Tensor:
    return torch.sqrt((v * v) @ v.new_ones(3) + _TINY)  # several times faster than a sum over a short dimension


def _vector(values: Vector, like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)
