"""The loops behind `sphere_trace`: rays that march together, and are dropped as they end.

Every pass evaluates the field once for each ray under way, whether it strides out, steps back or closes in on a change
of sign, so that passes are few and batches large.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..fields.field import Field

PATIENCE = 16  # steps at a gap of one `resolution`, before it doubles: few rays need as many
BAND_ENTRY = 0.5  # depth of a step into the next band, in δ: steps to its edge would never arrive
BOLDNESS = 0.9  # share of the widest step that two tangent balls on a plane allow: surfaces may bend towards the ray
STEEPEST_RISE = 0.6  # slope away from the surface above which steps grow no wider
FLOOR = 8  # rounding errors from zero that count as zero


class Expected(NamedTuple):
    """Expectations of rays ``(...,)``, which set the depth of the first evaluation.

    Where ``value`` fits an even slope, the ray is evaluated at its expected hit at once.
    """

    depth: Tensor  # of their hits, infinite if unknown
    slope: Tensor  # how fast the field falls along the ray there, positive
    value: Tensor  # of the field where the ray begins, infinite if unknown


class Near(NamedTuple):
    """The part of each ray near the surface, ``(...,)`` each."""

    clear: Tensor  # the last depth evaluated before it; infinite for rays that never come near
    value: Tensor  # there, infinite where the ray begins near the surface
    leave: Tensor  # the first depth evaluated behind it, infinite if there is none


class RayHits:
    """Results for every ray of a call, filled in as rays end."""

    def __init__(self, depth: Tensor) -> None:
        self.depth = depth.clone()
        self.mask = torch.zeros_like(depth, dtype=torch.bool)
        self.level = torch.zeros_like(depth, dtype=torch.int64)
        self.steps = torch.zeros_like(self.level)
        self.slope = torch.ones_like(self.depth)
        unknown = torch.full_like(depth, torch.inf)
        self.near = Near(unknown, unknown.clone(), unknown.clone())

    def record(
        self, at: Tensor, mask: Tensor, depth: Tensor, level: Tensor | int, steps: Tensor | int, slope: Tensor | float
    ) -> None:
        """Record results of the rays ``at`` these places of the call."""
        self.mask[at], self.depth[at], self.level[at], self.steps[at] = mask, depth, level, steps
        self.slope[at] = slope  # how fast the field fell along the ray at its last step

    def record_near(self, rays: Rays, close: Tensor, there: Tensor | None = None) -> None:
        """Record where rays come near the surface and leave it again; only of those ``there`` ``(K,)``, if given."""
        clear, value, leave = (column[rays.ray] for column in self.near)
        first = close & clear.isinf()
        left = torch.where(clear.isfinite(), torch.minimum(leave, rays.depth), torch.inf)
        noted = (
            torch.where(first, rays.low, clear),
            torch.where(first, rays.low_value, value),
            torch.where(close, torch.inf, left),
        )
        for column, new, old in zip(self.near, noted, (clear, value, leave), strict=True):
            column[rays.ray] = new if there is None else torch.where(there, new, old)


class Rays(NamedTuple):
    """The rays still under way, one row ``(K,)`` or ``(K, 3)`` each."""

    ray: Tensor  # row of the call
    origin: Tensor
    direction: Tensor
    depth: Tensor  # where to evaluate next
    entry: Tensor  # where the search may begin, at most `depth`
    far: Tensor  # where to stop
    sign: Tensor  # −1 for a ray that began inside, else 1; values are multiplied by it
    low: Tensor  # last depth known to be in front of the surface
    low_value: Tensor  # value there, infinite before the first
    free: Tensor  # radius of the empty ball there
    gap: Tensor  # how much of the step from there may lie outside both its balls
    high: Tensor  # a depth known to be behind the surface, infinite if unknown
    high_value: Tensor  # value there, negative
    boldness: Tensor  # share of the widest step that is taken
    expected: Tensor  # depth of the expected hit, infinite if unknown
    fall: Tensor  # how fast the field is expected to fall there

    @classmethod
    def begin(cls, origins: Tensor, directions: Tensor, entries: Tensor, starts: Tensor, ends: Tensor) -> Rays:
        index = (starts < ends).nonzero()[:, 0]
        depth, far = starts[index], ends[index]
        zero, infinite = torch.zeros_like(depth), torch.full_like(depth, torch.inf)
        return cls(
            ray=index,
            origin=origins[index],
            direction=directions[index],
            depth=depth,
            entry=entries[index],
            far=far,
            sign=zero + 1,
            low=depth,
            low_value=infinite,
            free=zero,
            gap=infinite,
            high=infinite,
            high_value=zero,
            boldness=zero + BOLDNESS,
            expected=infinite,
            fall=zero + 1,
        )

    def expecting(self, expected: Expected, rule: Rule) -> Rays:
        """The rays, each to be evaluated first where its ball just reaches back to the start, if all is as expected."""
        depth, fall, value = (column[self.ray] for column in expected)
        known = depth.isfinite() & (depth > self.depth) & (depth < self.far)
        # The field falls steadily if the way is at most 1.5 times as long as its fall on it tells.
        steady = known & value.isfinite() & (fall * (depth - self.depth) <= 1.5 * value)
        fall = fall.clamp(0.1, 1)  # a ray with a slower fall grazes the surface
        way = torch.where(known, depth - self.depth, 0)
        ahead = torch.zeros_like(way)
        for _ in range(len(rule.deltas) + 1):  # a ball outside a band is smaller by its δ, so its middle is further off
            delta = rule.band(fall * ahead)[1]
            reach = way - rule.resolution + delta / rule.lipschitz
            ahead = (reach / (1 + fall / rule.lipschitz)).clamp(min=0)
        ahead = torch.minimum(1.2 * ahead, way)  # a little nearer to the start than it would have to be
        ahead = torch.where(steady, 0, ahead)
        return self._replace(
            depth=torch.where(known, depth - ahead, self.depth),
            low_value=torch.where(steady, value, self.low_value),
            gap=torch.where(known & (ahead < way) & ~steady, rule.resolution, self.gap),
            expected=torch.where(known, depth, torch.inf),
            fall=fall,
        )

    def is_fresh(self) -> Tensor:
        """Which rays are at their start, where nothing is known yet."""
        return self.low_value.isinf() & (self.depth == self.low)

    def overshot(self, value: Tensor, rule: Rule) -> Tensor:
        """Which rays were first evaluated ahead of their start, and are behind the surface there, by the ``value``."""
        # Evaluated at the hit itself, half of all rays that meet it are behind it by less than the tolerance.
        arrived = (value >= -rule.tolerance * self.fall) & (self.expected - self.depth <= rule.resolution)
        # Where the value at the start is known, the surface lies between the two points.
        return (self.depth > self.low) & (value < 0) & ~arrived & self.low_value.isinf()

    def began_behind(self, value: Tensor) -> Tensor:
        """Which rays are at their start, behind the surface, and may begin earlier."""
        return (value < 0) & (self.depth > self.entry) & self.is_fresh()

    def only(self, rows: Tensor) -> Rays:
        return Rays(*(column[rows] for column in self))

    def points(self) -> Tensor:
        return torch.addcmul(self.origin, self.depth[:, None], self.direction)


class Rule(NamedTuple):
    """Bands and settings of a march."""

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


def march(
    field: Field, level: int, rays: Rays, hits: RayHits, rule: Rule, max_steps: int, reach: float | None = None
) -> None:
    """The adaptive mode: one evaluation of every ray under way per pass, then `step`.

    With a ``reach``, where each ray comes so near to the surface and where it leaves it is recorded.
    """
    for count in range(1, max_steps + 1):
        if not len(rays.ray):
            return
        value = field.value(rays.points(), level=level)
        if count == 1:
            rays, value = _sent_back(field, level, rays, value, rays.overshot(value, rule), rays.low)
        if count <= 2:  # a ray that overshot is at its start now, and may begin earlier
            rays, value = _sent_back(field, level, rays, value, rays.began_behind(value), rays.entry)
            rays = rays._replace(sign=torch.where(rays.is_fresh() & (value < 0), -1.0, rays.sign))
        if reach is not None:
            hits.record_near(rays, (value * rays.sign < reach) | (rays.sign < 0))
        gap = rule.resolution * 2.0 ** ((count - 1) // PATIENCE)
        rays, state = step(rays, value * rays.sign, rule, gap)
        ended = state.hit | state.passed if count < max_steps else torch.ones_like(state.hit)
        rows = ended.nonzero()[:, 0]
        ends = RayState(*(column[rows] for column in state))
        hits.record(rays.ray[rows], ends.hit, ends.depth, ends.level, count, ends.slope)
        rays = rays.only((~ended).nonzero()[:, 0])


def _sent_back(field: Field, level: int, rays: Rays, value: Tensor, behind: Tensor, to: Tensor) -> tuple[Rays, Tensor]:
    """Send the rays ``behind`` the surface back to depths before it; returns the rays and the values there."""
    rows = behind.nonzero()[:, 0]
    if not len(rows):
        return rays, value
    depth, low = (column.index_copy(0, rows, to[rows]) for column in (rays.depth, rays.low))
    rays = rays._replace(depth=depth, low=low)
    return rays, value.index_copy(0, rows, field.value(rays.only(rows).points(), level=level))


class RayState(NamedTuple):
    """State of rays after a step, ``(K,)`` each."""

    hit: Tensor
    passed: Tensor
    depth: Tensor
    level: Tensor
    slope: Tensor


def step(rays: Rays, value: Tensor, rule: Rule, resolution: Tensor | float) -> tuple[Rays, RayState]:
    """Take in the ``value`` at ``rays.depth``, and compute the next depth to evaluate."""
    level, delta = rule.band(value.abs())
    free = ((value.abs() - delta) / rule.lipschitz).clamp(min=0)
    # With one value only: the slope to the expected hit, or else that of a head-on ray.
    way = rays.expected - rays.depth
    predicted = torch.where(way > resolution, -value / way, -rays.fall)
    predicted = torch.where(rays.expected.isfinite(), predicted, -1.0)
    slope = torch.where(rays.low_value.isfinite(), (value - rays.low_value) / (rays.depth - rays.low), predicted)
    enclosed = rays.high.isfinite()
    sound = enclosed | (rays.depth - rays.low - rays.free - free <= rays.gap)
    before, behind = sound & (value > 0), sound & (value <= 0)
    low, high = torch.where(before, rays.depth, rays.low), torch.where(behind, rays.depth, rays.high)
    low_value, high_value = torch.where(before, value, rays.low_value), torch.where(behind, value, rays.high_value)

    # Before a change of sign: as far as two tangent balls on a plane reach, or over a gap that may be left.
    gap = torch.maximum(BAND_ENTRY * delta, torch.as_tensor(resolution, dtype=delta.dtype))
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
    state = RayState(
        hit=near | pinned,
        passed=passed & ~near,
        depth=torch.where(near, landing, torch.where(pinned, chord, rays.depth)),
        level=level,
        slope=steep,
    )
    rays = rays._replace(
        depth=torch.minimum(torch.where(closed, closing, ahead), rays.far),
        low=low,
        low_value=low_value,
        free=torch.where(before, free, rays.free),
        gap=gap,
        high=high,
        high_value=high_value,
        boldness=torch.where(sound | rays.low_value.isinf(), rays.boldness, rays.boldness / 2),
    )
    return rays, state


def march_budget(
    field: Field, rays: Rays, hits: RayHits, budget: Sequence[int], tolerance: float, capture: float
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
        missed = torch.zeros_like(gone, dtype=torch.bool)
        hits.record(rays.ray[gone], missed, rays.depth[gone], current, steps[gone], 1.0)
        rays, value, steps = rays.only(inside), value[inside], steps[inside]
    hits.record(rays.ray, value.abs() < capture, rays.depth, level, steps, 1.0)
