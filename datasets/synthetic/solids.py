"""Building blocks of procedural solids: each maps points ``(N, 3)`` to distances ``(N,)``, negative inside.

Formulas for the distances and for the polynomial smooth minimum follow Inigo Quilez, "Distance functions" and
"Smooth minimum" (iquilezles.org). A combination of solids is 1-Lipschitz wherever its parts are.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

Vector = tuple[float, float, float]


def ellipsoid(p: Tensor, center: Vector, radii: Vector) -> Tensor:
    """``k0 (k0 - 1) / k1`` with k0 = |p/r|, k1 = |p/r²|: exact to first order at the surface."""
    inverse = 1 / _vector(radii, p)
    scaled = (p - _vector(center, p)) * inverse
    k0, k1 = _norm(scaled), _norm(scaled * inverse)
    return k0 * (k0 - 1) / k1


def round_cone(p: Tensor, start: Vector, end: Vector, start_radius: float, end_radius: float) -> Tensor:
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
    ball = _norm(q - (tip * length)[:, None] * direction)
    on_side = (foot > 0) & (foot < length)
    side = slant * rho + slope * along - start_radius
    return torch.where(on_side, side, ball - torch.where(foot > 0, end_radius, start_radius))


def torus(p: Tensor, center: Vector, normal: Vector, major: float, minor: float) -> Tensor:
    """Exact distance to a torus around the axis ``normal`` (of unit length)."""
    n = _vector(normal, p)
    q = p - _vector(center, p)
    height = q @ n
    ring = _norm(q - height[:, None] * n) - major
    return torch.sqrt(ring * ring + height * height + _TINY) - minor


def rounded_box(p: Tensor, center: Vector, half: Vector, rounding: float) -> Tensor:
    """Exact distance outside a box of half-sizes ``half`` with edges rounded by ``rounding``."""
    beyond = (p - _vector(center, p)).abs() - (_vector(half, p) - rounding)
    return _norm(beyond.clamp(min=0)) + beyond.amax(dim=1).clamp(max=0) - rounding


def rounded_drum(p: Tensor, center: Vector, radius: float, half_height: float, rounding: float) -> Tensor:
    """Exact distance outside a cylinder along z with rounded rims."""
    q = p - _vector(center, p)
    rho = torch.sqrt(q[:, 0] ** 2 + q[:, 1] ** 2 + _TINY)
    a, b = rho - (radius - rounding), q[:, 2].abs() - (half_height - rounding)
    oa, ob = a.clamp(min=0), b.clamp(min=0)
    return torch.sqrt(oa * oa + ob * ob + _TINY) + torch.maximum(a, b).clamp(max=0) - rounding


def smooth_union(a: Tensor, b: Tensor, width: float) -> Tensor:
    """Quadratic smooth minimum: blends where the two differ by less than ``width``.

    With h = clamp(½ + (b - a)/(2 width)) it is b + (a - b) h - width h (1 - h).
    """
    h = (0.5 + (b - a) / (2 * width)).clamp(0, 1)
    return torch.lerp(b, a, h) - width * h * (1 - h)


def carve(a: Tensor, b: Tensor, width: float) -> Tensor:
    """Smooth difference: ``a`` without ``b``."""
    return -smooth_union(-a, b, width)


def fold(p: Tensor) -> Tensor:
    """Mirror the half space x < 0 onto x > 0."""
    return torch.cat((p[:, :1].abs(), p[:, 1:]), dim=1)


def tilt(p: Tensor, center: Vector, angles: Vector) -> Tensor:
    """Points ``p`` in a frame turned by ``angles`` (radians; about x, then y, then z) around ``center``."""
    cx, cy, cz = (math.cos(angle) for angle in angles)
    sx, sy, sz = (math.sin(angle) for angle in angles)
    about_x = torch.tensor([[1, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=p.dtype, device=p.device)
    about_y = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=p.dtype, device=p.device)
    about_z = torch.tensor([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]], dtype=p.dtype, device=p.device)
    middle = _vector(center, p)
    return (p - middle) @ (about_z @ about_y @ about_x) + middle


_TINY = 1e-18  # keeps roots differentiable at zero; far below float32's resolution of a unit length


def _norm(v: Tensor) -> Tensor:
    return torch.sqrt((v * v) @ v.new_ones(3) + _TINY)  # several times faster than a sum over a short dimension


def _vector(values: Vector, like: Tensor) -> Tensor:
    return torch.tensor(values, dtype=like.dtype, device=like.device)
