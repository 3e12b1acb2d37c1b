"""Sphere tracing of any field, with coarse levels leading fine ones (paper Sec. 3 and suppl. "Rendering").

Let v = |f(p)| at a point of a ray. The ball around p that holds no zero of f has the radius

    r = (v − δ_j) / L,

with δ_j the half-width of the first band that v is not inside of (0 inside all of them) and L the Lipschitz constant:
outside band j the value is that of level j, and the surface lies where |f_j| < δ_j. So one rule serves all levels,
and the field itself sees to it that a residual is evaluated only inside its band.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .field import Field

__all__ = ["BOUNDING_RADIUS", "Hits", "cone_starts", "sphere_trace"]

# Fields live in the unit sphere; their surfaces may pass it by a little.
BOUNDING_RADIUS = 1.05
# Steps at a gap of one `resolution`, before it doubles: few rays need as many, and none may need thousands.
PATIENCE = 32
# How far a step may reach into a band unseen, in δ: stepping to its edge and no further would never arrive.
BAND_ENTRY = 0.5
# Share of the widest step that two tangent balls on a plane allow; less than 1 lets surfaces bend towards the ray.
BOLDNESS = 0.9
# A ray that leaves the surface faster than this may not stride out any further for it.
STEEPEST_RISE = 0.6
# Values this many rounding errors from zero are zero: no step would bring them nearer.
FLOOR = 8


class Hits(NamedTuple):
    """Where rays meet a surface.

    Attributes:
        mask: ``(...,)`` bool, whether the ray meets it.
        depth: ``(...,)`` distance from the origin along the ray; for a ray that misses, where its search ended.
        position: ``(..., 3)`` the point at that depth.
        level: ``(...,)`` int64, the finest level that had a say in the last step.
        steps: ``(...,)`` int64, how often the field was evaluated on the ray.
    """

    mask: Tensor
    depth: Tensor
    position: Tensor
    level: Tensor
    steps: Tensor


@torch.no_grad()
def sphere_trace(
    field: Field,
    origins: Tensor,
    directions: Tensor,
    *,
    level: int = -1,
    near: Tensor | float = 0.0,
    far: Tensor | float = torch.inf,
    tolerance: float = 1e-5,
    resolution: float = 1e-4,
    lipschitz: float = 1.0,
    radius: float | None = BOUNDING_RADIUS,
    max_steps: int = 512,
    budget: Sequence[int] | None = None,
    capture: float = 2e-3,
) -> Hits:
    """First intersections of rays with the zero set of a level.

    The default mode runs until the depth of every ray is known to ``tolerance``. Steps are the widest that still
    leave no gap between the balls around two neighbouring samples if the surface is a plane (Bálint and Valasek
    2018, from the last two values); where a gap opens after all, the step is taken back. Two crossings closer
    to each other than ``resolution`` may be overlooked, which is what lets a ray go on along a surface that it
    nearly touches; rays that need more than 32 steps are given twice the resolution, and again after every 32.
    A change of sign is closed in on by the Illinois variant of the secant rule. Rays are dropped as they end.

    With a ``budget``, the paper's mode: so many steps ``t ← t + f_j − δ_j`` on each level (20, 5, 5 in its Tab. 4),
    after which |f| < ``capture`` is a hit.

    A ray that starts inside the surface looks for the way out.

    Args:
        field: what to trace, three-dimensional.
        origins: ``(..., 3)``.
        directions: ``(..., 3)`` of unit length; broadcast with ``origins``.
        level: whose surface to find.
        near: depth at which to start, a number or a tensor that broadcasts to ``(...,)``; see `cone_starts`.
        far: depth at which to give up.
        tolerance: of the depth, in the field's units. The precision of the numbers sets a limit of its own.
        resolution: two crossings nearer to each other than this may be overlooked.
        lipschitz: bound L on the slope of the field.
        radius: the surface lies in the ball of this radius around the origin; None where it may lie anywhere.
        max_steps: rays that need more end as misses.
        budget: steps on each level up to ``level``, for the fixed mode.
        capture: the |f| that the fixed mode takes for a hit.

    Raises:
        ValueError: shapes do not fit, the field is not three-dimensional, or a number is out of range.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, sphere_trace
        >>> hits = sphere_trace(Sphere(radius=0.5), torch.tensor([0.0, 0.0, -2.0]), torch.tensor([0.0, 0.0, 1.0]))
        >>> bool(hits.mask), round(float(hits.depth), 4)
        (True, 1.5)
    """
    level = field.resolve_level(level)
    _check(field, origins, directions, tolerance=tolerance, resolution=resolution, lipschitz=lipschitz)
    if budget is not None and len(budget) != level + 1:
        raise ValueError(f"budget={list(budget)}: expected {level + 1} number(s) of steps, one for each level")
    origins, directions = torch.broadcast_tensors(origins, directions)
    shape = directions.shape[:-1]
    starts, ends = (torch.as_tensor(x).to(directions).broadcast_to(shape).reshape(-1) for x in (near, far))
    origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    if radius is not None:
        entry, leave = _ball_crossing(origins, directions, radius)
        starts, ends = torch.maximum(starts, entry), torch.minimum(ends, leave)
    rays = _Rays.begin(origins, directions, starts.clamp(min=0), ends)
    found = _Found(starts)
    if budget is None:
        rule = _Rule(field.deltas[:level].to(directions), tolerance, resolution, lipschitz)
        _march(field, level, rays, found, rule, max_steps)
    else:
        _march_budget(field, rays, found, budget, tolerance, capture)
    position = origins + found.depth[:, None] * directions
    return Hits(
        found.mask.reshape(shape),
        found.depth.reshape(shape),
        position.reshape(*shape, 3),
        found.level.reshape(shape),
        found.steps.reshape(shape),
    )


@torch.no_grad()
def cone_starts(
    field: Field,
    origin: Tensor,
    directions: Tensor,
    *,
    level: int = -1,
    tiles: Sequence[int] = (32, 8, 4),
    lipschitz: float = 1.0,
    radius: float = BOUNDING_RADIUS,
    max_steps: int = 64,
) -> Tensor:
    """Depths up to which whole tiles of an image see nothing, by marching one cone for each tile on level 0.

    A cone of spread σ (the largest distance between the directions of a tile and its middle one) holds every point of
    the tile's rays at depth t within tσ of its axis, so with v = |f_0| on the axis the tile is empty up to
    t + ((v − δ_0)/L − tσ) / (1 + σ). Tiles are marched from large to small, each starting where the larger one ended.

    Args:
        field: what to trace, three-dimensional.
        origin: ``(3,)`` the common origin of all rays.
        directions: ``(H, W, 3)`` of unit length.
        level: the level that will be traced from there.
        tiles: sides of the tiles in pixels, each a multiple of the next.
        lipschitz: see `sphere_trace`.
        radius: see `sphere_trace`.
        max_steps: of each cone.

    Returns:
        ``(H, W)`` depths for ``near`` of `sphere_trace`; infinite where there is nothing to be seen.

    Raises:
        ValueError: shapes do not fit, or the field is not three-dimensional.
    """
    level = field.resolve_level(level)
    if origin.shape != (3,) or directions.ndim != 3:
        raise ValueError(
            f"origin {tuple(origin.shape)}, directions {tuple(directions.shape)}: expected (3,), (H, W, 3)"
        )
    _check(field, origin, directions, lipschitz=lipschitz)
    height, width = directions.shape[:2]
    rows, columns = (torch.arange(count, device=directions.device) for count in (height, width))
    depth = directions.new_zeros(height, width)
    for tile in tiles:
        across = -(-width // tile)
        of_pixel = (rows[:, None] // tile) * across + columns // tile
        middle_row, middle_column = (
            (count // tile * tile + tile // 2).clamp(max=len(count) - 1) for count in (rows, columns)
        )
        axis = directions[middle_row[::tile]][:, middle_column[::tile]].reshape(-1, 3)
        away = (directions - directions[middle_row][:, middle_column]).norm(dim=-1)
        spread = away.new_zeros(len(axis)).scatter_reduce(0, of_pixel.flatten(), away.flatten(), "amax")
        starts = depth[::tile, ::tile].reshape(-1)
        free = _march_cones(field, origin, axis, spread, starts, level, lipschitz, radius, max_steps)
        depth = free[of_pixel]
    return depth


def _march_cones(
    field: Field,
    origin: Tensor,
    axis: Tensor,
    spread: Tensor,
    starts: Tensor,
    level: int,
    lipschitz: float,
    radius: float,
    max_steps: int,
) -> Tensor:
    """How far each cone is empty; infinite where it leaves the ball of ``radius`` untouched."""
    delta = field.deltas[0].to(axis) if level else axis.new_zeros(())
    # A ray of the cone may be in the ball where its axis is not; spread · reach is the most that they are apart.
    reach = origin.norm() + radius
    entry, leave = _ball_crossing(origin.expand_as(axis), axis, radius + spread * reach)
    depth = torch.maximum(starts, entry).clamp(min=0)
    depth[depth >= leave] = torch.inf
    active = depth.isfinite().nonzero()[:, 0]
    for _ in range(max_steps):
        if not len(active):
            break
        t, sigma = depth[active], spread[active]
        value = field.value(origin + t[:, None] * axis[active], level=0).abs()
        step = ((value - delta) / lipschitz - t * sigma) / (1 + sigma)
        t = t + step.clamp(min=0)
        depth[active] = torch.where(t >= leave[active], torch.inf, t)
        # Once a step is shorter than the cone is wide, smaller cones get on better.
        active = active[(step > t * sigma) & (t < leave[active])]
    return depth


def _check(field: Field, origins: Tensor, directions: Tensor, **positive: float) -> None:
    if field.in_dim != 3:
        raise ValueError(f"field.in_dim={field.in_dim}: rays are traced in three dimensions; take a TimeSlice")
    for name, rows in (("origins", origins), ("directions", directions)):
        if rows.ndim == 0 or rows.shape[-1] != 3:
            raise ValueError(f"{name} has shape {tuple(rows.shape)}; expected (..., 3)")
    for name, number in positive.items():
        if not number > 0:
            raise ValueError(f"{name}={number}: expected > 0")


def _ball_crossing(origins: Tensor, directions: Tensor, radius: float | Tensor) -> tuple[Tensor, Tensor]:
    """Depths at which rays enter and leave the ball around 0; those that miss it enter after they leave."""
    closest = -(origins * directions).sum(dim=-1)
    # From the point of closest approach, and not from |o|² − (o·d)², which cancels for far cameras.
    squared = radius**2 - (origins + closest[:, None] * directions).square().sum(dim=-1)
    half = squared.clamp(min=0).sqrt()
    missed = squared <= 0
    return torch.where(missed, torch.inf, closest - half), torch.where(missed, -torch.inf, closest + half)


class _Found:
    """Results for every ray of a call, filled in as rays end."""

    def __init__(self, depth: Tensor) -> None:
        self.depth = depth.clone()
        self.mask = torch.zeros_like(depth, dtype=torch.bool)
        self.level = torch.zeros_like(depth, dtype=torch.int64)
        self.steps = torch.zeros_like(self.level)

    def record(self, index: Tensor, *, mask: Tensor, depth: Tensor, level: Tensor | int, steps: Tensor | int) -> None:
        self.mask[index], self.depth[index], self.level[index], self.steps[index] = mask, depth, level, steps


class _Rays(NamedTuple):
    """The rays still under way, one row each.

    Attributes:
        ray: ``(K,)`` which ray of the call it is.
        origin: ``(K, 3)``.
        direction: ``(K, 3)``.
        depth: ``(K,)`` where to look next.
        far: ``(K,)`` where to give up.
        sign: ``(K,)`` −1 for a ray that began inside, else 1; values are multiplied by it.
        low: ``(K,)`` the last depth known to be in front of the surface.
        low_value: ``(K,)`` the value there, infinite before the first.
        free: ``(K,)`` radius of the empty ball there.
        gap: ``(K,)`` how much of the step from there may lie outside both its balls.
        high: ``(K,)`` a depth known to be behind the surface, infinite if there is none yet.
        high_value: ``(K,)`` the value there, negative.
        boldness: ``(K,)`` share of the widest step that is taken.
    """

    ray: Tensor
    origin: Tensor
    direction: Tensor
    depth: Tensor
    far: Tensor
    sign: Tensor
    low: Tensor
    low_value: Tensor
    free: Tensor
    gap: Tensor
    high: Tensor
    high_value: Tensor
    boldness: Tensor

    @classmethod
    def begin(cls, origins: Tensor, directions: Tensor, starts: Tensor, ends: Tensor) -> _Rays:
        index = (starts < ends).nonzero()[:, 0]
        depth, far = starts[index], ends[index]
        zero, infinite = torch.zeros_like(depth), torch.full_like(depth, torch.inf)
        return cls(
            ray=index,
            origin=origins[index],
            direction=directions[index],
            depth=depth,
            far=far,
            sign=zero + 1,
            low=depth,
            low_value=infinite,
            free=zero,
            gap=infinite,
            high=infinite,
            high_value=zero,
            boldness=zero + BOLDNESS,
        )

    def only(self, rows: Tensor) -> _Rays:
        return _Rays(*(column[rows] for column in self))

    def points(self) -> Tensor:
        return torch.addcmul(self.origin, self.depth[:, None], self.direction)


class _Rule(NamedTuple):
    """The numbers that say what a value allows."""

    deltas: Tensor
    tolerance: float
    resolution: float
    lipschitz: float

    def band(self, size: Tensor) -> tuple[Tensor, Tensor]:
        """How many bands |f| = ``size`` is inside of, and the δ of the first that it is not, 0 after the last."""
        if not len(self.deltas):
            return torch.zeros_like(size, dtype=torch.int64), torch.zeros_like(size)
        inside = (size[:, None] < self.deltas).cumprod(dim=1).sum(dim=1)
        return inside, torch.cat((self.deltas, self.deltas.new_zeros(1)))[inside]


def _march(field: Field, level: int, rays: _Rays, found: _Found, rule: _Rule, max_steps: int) -> None:
    """The adaptive mode: one evaluation of every ray under way, then see where each one stands."""
    for count in range(1, max_steps + 1):
        if not len(rays.ray):
            return
        value = field.value(rays.points(), level=level)
        if count == 1:
            rays = rays._replace(sign=torch.where(value < 0, -1.0, 1.0).to(value))
        gap = rule.resolution * 2.0 ** ((count - 1) // PATIENCE)
        rays, stand = _look(rays, value * rays.sign, rule, gap)
        ended = stand.hit | stand.passed if count < max_steps else torch.ones_like(stand.hit)
        rows = ended.nonzero()[:, 0]
        found.record(
            rays.ray[rows], mask=stand.hit[rows], depth=stand.depth[rows], level=stand.level[rows], steps=count
        )
        rays = rays.only((~ended).nonzero()[:, 0])


class _Stand(NamedTuple):
    """Where rays stand after a look at their values, ``(K,)`` each."""

    hit: Tensor
    passed: Tensor
    depth: Tensor
    level: Tensor


def _look(rays: _Rays, value: Tensor, rule: _Rule, resolution: float) -> tuple[_Rays, _Stand]:
    """Take in the ``value`` at ``rays.depth``, and say where to look next."""
    level, delta = rule.band(value.abs())
    free = ((value.abs() - delta) / rule.lipschitz).clamp(min=0)
    slope = torch.where(rays.low_value.isfinite(), (value - rays.low_value) / (rays.depth - rays.low), -1.0)
    enclosed = rays.high.isfinite()
    sound = enclosed | (rays.depth - rays.low - rays.free - free <= rays.gap)
    before, behind = sound & (value > 0), sound & (value <= 0)
    low, high = torch.where(before, rays.depth, rays.low), torch.where(behind, rays.depth, rays.high)
    low_value, high_value = torch.where(before, value, rays.low_value), torch.where(behind, value, rays.high_value)

    # Before a change of sign: as far as two tangent balls on a plane reach, or over a gap that may be left.
    gap = torch.maximum(BAND_ENTRY * delta, torch.full_like(delta, resolution))
    s = slope.clamp(-1, STEEPEST_RISE)
    widest = rays.boldness * free * (1 + s) / (1 - s)
    zero = torch.where(s < 0, value / -s, torch.inf)
    ahead = rays.depth + free + torch.maximum(widest, torch.minimum(gap, zero - free))
    # A step that left too wide a gap is taken back, and the next ones are less bold.
    ahead = torch.where(before, ahead, rays.low + rays.free)
    # After it: the secant, or the middle where the secant did not halve the interval.
    width = high - low
    chord = low + width * low_value / (low_value - high_value)
    halved = ~enclosed | (2 * width <= rays.high - rays.low)
    closing = torch.where(halved, chord, low + width / 2)

    closed = high.isfinite()
    steep = slope.abs().clamp(max=1)
    floor = FLOOR * torch.finfo(value.dtype).eps
    near = sound & (delta == 0) & (value.abs() <= (rule.tolerance * steep).clamp(min=floor))
    pinned = closed & (width <= rule.tolerance)
    landing = rays.depth + (value / steep).clamp(-rule.tolerance, rule.tolerance)
    passed = before & ~closed & (rays.depth + free + gap >= rays.far)
    stand = _Stand(
        hit=near | pinned,
        passed=passed & ~near,
        depth=torch.where(near, landing, torch.where(pinned, chord, rays.depth)),
        level=level,
    )
    rays = rays._replace(
        depth=torch.minimum(torch.where(closed, closing, ahead), rays.far),
        low=low,
        low_value=low_value,
        free=torch.where(before, free, rays.free),
        gap=gap,
        high=high,
        high_value=high_value,
        boldness=torch.where(sound, rays.boldness, rays.boldness / 2),
    )
    return rays, stand


def _march_budget(
    field: Field, rays: _Rays, found: _Found, budget: Sequence[int], tolerance: float, capture: float
) -> None:
    """The paper's mode: a number of steps towards the edge of each band, then towards the surface."""
    level = len(budget) - 1
    edges = [*field.deltas[:level].tolist(), 0.0]
    value, steps = torch.full_like(rays.depth, torch.inf), torch.zeros_like(rays.ray)
    for current, (count, edge) in enumerate(zip(budget, edges, strict=True)):
        moving = torch.arange(len(rays.ray), device=rays.ray.device)
        for _ in range(count):
            here = rays.only(moving)
            value[moving] = field.value(here.points(), level=current)
            step = value[moving] - edge
            rays.depth[moving] += step
            steps[moving] += 1
            moving = moving[(step.abs() > tolerance) & (rays.depth[moving] < rays.far[moving])]
        inside = (rays.depth < rays.far).nonzero()[:, 0]
        gone = (rays.depth >= rays.far).nonzero()[:, 0]
        found.record(
            rays.ray[gone],
            mask=torch.zeros_like(gone, dtype=torch.bool),
            depth=rays.depth[gone],
            level=current,
            steps=steps[gone],
        )
        rays, value, steps = rays.only(inside), value[inside], steps[inside]
    found.record(rays.ray, mask=value.abs() < capture, depth=rays.depth, level=level, steps=steps)
