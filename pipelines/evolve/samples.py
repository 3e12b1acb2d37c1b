"""Samples of space-time that ``evolve`` learns from: where a field is known, and where bounds on it are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...neural_fields import Field, at_time, flow
from ...neural_fields.spacetime.evolution import VectorField
from ..fit.samples import DOMAIN, Rows, value_and_gradient
from .shapes import StaticShape


@dataclass(frozen=True, eq=False)
class Known(Rows):
    """Samples of space-time where the field is known."""

    points: Tensor  # (N, 4)
    value: Tensor  # (N,)
    gradient: Tensor  # (N, 3), by space


@dataclass(frozen=True, eq=False)
class Bounds(Rows):
    """Samples of space-time where the field is only known to lie between two numbers."""

    points: Tensor  # (N, 4)
    low: Tensor  # (N,); −∞ where nothing is known
    high: Tensor  # (N,); ∞ likewise


class Carried:
    """The union of shapes, each one carried by its own vector field, by characteristics back to time 0."""

    def __init__(self, fields: Sequence[Field], velocities: Sequence[VectorField]) -> None:
        self.fields, self.velocities = fields, velocities

    def samples(self, points: Tensor) -> Known:
        """Value f_i(x at time 0) of the nearest part at ``(N, 4)`` points, and its gradient by space."""
        parts = [self._nearest(rows) for rows in points.split(8192)]  # differentiated at a time
        value, gradient = (torch.cat(part) for part in zip(*parts, strict=True))
        return Known(points, value, gradient)

    def surface(self, shapes: Sequence[StaticShape], time: float, count: int, seed: int) -> Tensor:
        """Points of the surface at a time: of ``count`` on each part those that are in no other one."""
        kept = []
        for index, (shape, velocity) in enumerate(zip(shapes, self.velocities, strict=True)):
            points = flow(velocity, shape.points(count, 2 * index + seed), 0.0, time)
            outside = [
                self.fields[other].value(flow(self.velocities[other], points, time, 0.0)) > 0
                for other in range(len(shapes))
                if other != index
            ]
            kept.append(points[torch.stack(outside).all(dim=0)] if outside else points)
        return torch.cat(kept)

    def _nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        values, gradients = [], []
        for field, velocity in zip(self.fields, self.velocities, strict=True):
            x = points[:, :3].clone().requires_grad_()
            home = flow(velocity, x, points[:, 3], 0.0)
            jet = field.jet(home.detach())
            (gradient,) = torch.autograd.grad(home, x, jet.gradient.detach())  # ∇ f(y(x)) = (dy/dx)ᵀ ∇f
            values.append(jet.value.detach())
            gradients.append(gradient)
        value, nearest = torch.stack(values).min(dim=0)
        index = nearest[None, :, None].expand(1, -1, 3)
        return value, torch.stack(gradients).gather(0, index)[0]


def signs(samples: Known, tolerance: float = 1e-3) -> tuple[Known, Bounds]:
    """Of values that are no distances: those on the surface, with unit gradients, and the signs of the others."""
    slope = samples.gradient.norm(dim=1).clamp(min=1e-6)
    still = samples.points[:, 3] == 0
    near = still | (samples.value.abs() < tolerance)
    known = Known(samples.points[near], (samples.value / slope)[near], (samples.gradient / slope[:, None])[near])
    positive = samples.value[~near] > 0
    low = torch.where(positive, 0.0, -math.inf)
    return known, Bounds(samples.points[~near], low, torch.where(positive, math.inf, 0.0))


def known_at(shape: StaticShape, time: float, count: int, seed: int, generator: torch.Generator) -> Known:
    """Samples of a shape at the time when it is reached."""
    points = around(shape, count, seed, generator)
    return Known(at_time(points, time), *value_and_gradient(shape.field, points))


def around(shape: StaticShape, count: int, seed: int, generator: torch.Generator) -> Tensor:
    """Points ``(count, 3)``: half of them on the surface, a quarter near it, a quarter anywhere."""
    on = shape.points(count // 2, seed)
    near = on[torch.randint(len(on), (count // 4,), generator=generator)]
    deviation = 0.005 * 20 ** torch.rand(len(near), 1, generator=generator)  # from 0.005 to 0.1
    near = near + deviation * torch.randn(near.shape, generator=generator)
    return torch.cat((on, near, uniform(count - len(on) - len(near), generator)))


def uniform(count: int, generator: torch.Generator) -> Tensor:
    """Points ``(count, 3)`` anywhere in the cube."""
    return (2 * torch.rand(count, 3, generator=generator) - 1) * DOMAIN


def uniform_spacetime(count: int, generator: torch.Generator) -> Tensor:
    """Points ``(count, 4)`` anywhere in the cube, at any time."""
    return torch.cat((uniform(count, generator), torch.rand(count, 1, generator=generator)), dim=1)


@torch.no_grad()
def values_at(field: Field, points: Tensor) -> Tensor:
    """Values ``(N,)`` of a field at points ``(N, d)``, in blocks that fit into memory however many there are."""
    return torch.cat([field.value(part) for part in points.split(1 << 17)])


def joined(parts: Sequence[Known]) -> Known:
    """All samples in one."""
    return Known(*map(torch.cat, zip(*((part.points, part.value, part.gradient) for part in parts), strict=True)))


def _first_near(field: Field, points: Tensor, count: int, width: float) -> Tensor:
    """The first ``count`` of ``points`` with |f| < ``width`` at the coarsest level; later ones are not asked."""
    near, found = [points[:0]], 0
    for part in points.split(1 << 14):
        near.append(part[field.value(part, level=0).abs() < width])
        found += len(near[-1])
        if found >= count:
            break
    return torch.cat(near)[:count]


@torch.no_grad()
def band_points(
    field: Field, count: int, width: float, generator: torch.Generator, *, level: int = -1, reach: float = 0.1
) -> Tensor:
    """Points ``(n, 4)``, about ``count`` of them, spread evenly over |f| < ``width`` of a four-dimensional field.

    Points anywhere; those with |f| < ``reach`` at the coarsest level are moved along ∇f to a value of their own. Of a
    residual level only those in its band are kept.
    """
    level, device = field.resolve_level(level), field.deltas.device
    points = uniform_spacetime(6 * count, generator).to(device)  # tried: few are near the surface
    points = _first_near(field, points, count, max(reach, width))
    value, gradient, _ = field.jet(points, level=level)
    slope = gradient[:, :3].square().sum(dim=1).clamp(min=0.25)
    goal = width * (2 * torch.rand(len(points), generator=generator).to(device) - 1)
    x = points[:, :3] + ((goal - value) / slope)[:, None] * gradient[:, :3]
    inside = x.abs().amax(dim=1) < DOMAIN
    points = torch.cat((x, points[:, 3:]), dim=1)[inside]
    return points[indices_in_band(field, points, level)] if level else points


@torch.no_grad()
def indices_in_band(field: Field, points: Tensor, level: int) -> Tensor:
    """Indices of the points at which a level may be evaluated."""
    parts = [field.in_band(part, level=level) for part in points.split(1 << 17)]
    return torch.cat(parts).nonzero()[:, 0] if parts else torch.empty(0, dtype=torch.long)
