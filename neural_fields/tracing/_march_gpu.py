"""`march` for accelerators: `PASSES` passes are launched before the host reads how many rays are left.

Bands have a capacity that earlier passes suggest (`fixed_shapes`); a ray that overflows waits for a pass. So every ray
sees the values that it would see in `march`, but for rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext

import torch
from torch import Tensor

from ..backend.fixed_shapes import FixedShapes, first_rows, fixed_shapes
from ..fields.field import Field
from ._march import PATIENCE, RayHits, Rays, RayState, Rule, step

FIRST_PASSES, PASSES = 8, 16  # before the first read by the host, when many rays end, and between later ones
FEW, SHARE = 4096, 0.25  # first capacity of a band: this many rows, or this share of the rays if that is more
SPARE, LEAST_CAPACITY = 1.25, 256  # later capacity: factor on the rows last requested, and the least


def march_ahead(
    field: Field, level: int, rays: Rays, hits: RayHits, rule: Rule, max_steps: int, reach: float | None = None
) -> None:
    """`march`, with one wait after the first `FIRST_PASSES` passes, and then every `PASSES`."""
    count = torch.zeros_like(rays.ray)
    capacity = [max(FEW, int(SHARE * len(rays.ray)))] * level
    passes = FIRST_PASSES
    while len(rays.ray) and max_steps > 0:
        chunk = _Chunk(field, level, rays, count, rule, max_steps)
        requested = chunk.run(passes, hits, reach, capacity)
        left, *counts = torch.stack([(~chunk.ended).sum(), *requested]).tolist()  # the only wait of the host
        rows = first_rows(~chunk.ended, left)
        rays, count = chunk.rays.only(rows), chunk.count[rows]
        capacity = [max(LEAST_CAPACITY, int(SPARE * number)) for number in counts]
        passes = PASSES


class _Chunk:
    """Some passes of rays, without dropping any.

    Attributes:
        rays: see `Rays`; those that have ended stay where they were.
        count: ``(K,)`` evaluations of each.
        ended: ``(K,)`` bool.
        state: state of each when it ended.
    """

    def __init__(self, field: Field, level: int, rays: Rays, count: Tensor, rule: Rule, max_steps: int) -> None:
        self.field, self.level, self.rule, self.max_steps = field, level, rule, max_steps
        self.rays, self.count = rays, count
        self.ended = torch.zeros_like(count, dtype=torch.bool)
        self.state = RayState(self.ended, self.ended, rays.depth, count, torch.ones_like(rays.depth))

    def run(self, passes: int, hits: RayHits, reach: float | None, capacity: Sequence[int]) -> list[Tensor]:
        """Do ``passes`` passes, record the rays that ended, and return the requested capacity of each band."""
        # A field that is evaluated at other rows could not tell which rows overflow.
        with fixed_shapes(capacity) if self.field.same_rows else nullcontext() as shapes:
            for _ in range(passes):
                self._pass(shapes, hits, reach)
        state = self.state
        hits.record(self.rays.ray, state.hit, state.depth, state.level, self.count, state.slope)
        return [] if shapes is None else shapes.requested

    def _pass(self, shapes: FixedShapes | None, hits: RayHits, reach: float | None) -> None:
        """Let the rays under way, but for those that overflow, take in their values."""
        rays, there = self.rays, ~self.ended
        if shapes is not None:
            shapes.mask = there
        value = self.field.value(rays.points(), level=self.level)
        if shapes is not None and shapes.overflow is not None:
            there = there & ~shapes.overflow
        # A ray that is behind the surface at its first value goes back, and begins again.
        back = there & (self.count == 0) & rays.overshot(value, self.rule)
        early = there & (self.count <= 1) & ~back
        front = early & rays.began_behind(value)
        low = torch.where(front, rays.entry, rays.low)
        rays = rays._replace(depth=torch.where(back | front, low, rays.depth), low=low)
        there = there & ~back & ~front
        sign = torch.where(early & there & rays.is_fresh() & (value < 0), -1.0, rays.sign)
        rays = rays._replace(sign=sign)
        if reach is not None:
            hits.record_near(rays, (value * sign < reach) | (sign < 0), there)
        doublings = (self.count // PATIENCE).clamp(max=60)  # more than any ray sees; a longer shift would overflow
        gap = self.rule.resolution * torch.bitwise_left_shift(torch.ones_like(doublings), doublings).to(value.dtype)
        moved, state = step(rays, value * sign, self.rule, gap)
        self.count = self.count + there
        ends = there & (state.hit | state.passed | (self.count >= self.max_steps))
        self.state = RayState(*(torch.where(ends, new, old) for new, old in zip(state, self.state, strict=True)))
        self.ended = self.ended | ends
        self.rays = Rays(
            *(old if new is old else torch.where(there, new, old) for new, old in zip(moved, rays, strict=True))
        )
