"""Rays that march through one network in one launch: each stays in registers until it meets the surface or leaves.

`mplicits.neural_fields._march` asks the field once a pass for all rays that are left, and between passes has some
seventy small operations for what a value allows; on a GPU each is a launch. Here a program marches ROWS rays at a time:
a value of its tile, then the same rules (`rules.py`) in registers. A ray that ends writes what it found, and its place
is taken by the next ray of the program's own, so that tiles stay full though rays are of different lengths.

The rules are those of `sphere_trace` for a field without bands and without expectations: steps as wide as two tangent
balls on a plane allow, taken back where a gap opens, then the secant and bisection in turn. What they decide is the
same; values differ by rounding, so depths do by about as much over the slope.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from .launch import Network, on_device, program_count, scratch_for, tiling_of
from .rules import look_at, turned_back
from .tiles import planes, value_of_tile

__all__ = ["Marched", "march_rays"]


class Marched(NamedTuple):
    """What rays found, ``(N,)`` each; the names are those of `mplicits.neural_fields.Hits`.

    Attributes:
        mask: whether a ray meets the surface.
        depth: where, or where its search ended.
        steps: how often the network was evaluated on it.
        slope: how fast the field fell along the ray at its last step.
        level: how many bands its last value lay in.
    """

    mask: Tensor
    depth: Tensor
    steps: Tensor
    slope: Tensor
    level: Tensor

    @classmethod
    def nothing(cls, starts: Tensor) -> Marched:
        """Room for what kernels find, in the types that they write."""
        small, number = (torch.zeros_like(starts, dtype=dtype) for dtype in (torch.int8, torch.int32))
        return cls(small, starts.clone(), number, torch.ones_like(starts), torch.zeros_like(number))

    def in_own_types(self) -> Marched:
        """In those of `mplicits.neural_fields.Hits`."""
        return self._replace(mask=self.mask.bool(), steps=self.steps.long(), level=self.level.long())


@triton.jit(do_not_specialize=["count", "share", "max_steps"])
def march(
    origins,
    directions,
    starts,
    entries,
    ends,
    parameters,
    found_mask,
    found_depth,
    found_steps,
    found_slope,
    scratch,
    count,
    share,
    max_steps,
    tolerance,
    resolution,
    lipschitz,
    omega,
    gain,
    PATIENCE: tl.constexpr,
    BOLDNESS: tl.constexpr,
    STEEPEST_RISE: tl.constexpr,
    BAND_ENTRY: tl.constexpr,
    FLOOR: tl.constexpr,
    PLANES: tl.constexpr,
    ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
    DEPTH: tl.constexpr,
    COLUMNS: tl.constexpr,
    PIECE: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """A program has the ``share`` rays from its number times the share on."""
    STRIDE: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS * COLUMNS
    infinite = float("inf")
    own = scratch + tl.cast(tl.program_id(0), tl.int64) * (PLANES * ROWS * STRIDE)
    first = tl.cast(tl.program_id(0), tl.int64) * share
    last = tl.minimum(first + share, count)
    taken = first
    # Nothing under way yet: every place is free.
    ray = tl.full((ROWS,), 0, tl.int64)
    free_place = tl.full((ROWS,), 1, tl.int32)
    zero = tl.zeros((ROWS,), tl.float32)
    ox, oy, oz, dx, dy, dz = zero, zero, zero, zero, zero, zero
    depth, entry, far, sign, low, free = zero, zero, zero, zero + 1, zero, zero
    low_value, gap, high, high_value, boldness = zero, zero, zero, zero, zero
    steps = tl.zeros((ROWS,), tl.int32)
    running = last > first
    while running:
        # Free places take the next rays.
        place = taken + tl.cumsum(free_place, axis=0) - 1
        new = (free_place > 0) & (place < last)
        ray = tl.where(new, place, ray)
        ox = tl.where(new, tl.load(origins + ray * 3, mask=new, other=0.0), ox)
        oy = tl.where(new, tl.load(origins + ray * 3 + 1, mask=new, other=0.0), oy)
        oz = tl.where(new, tl.load(origins + ray * 3 + 2, mask=new, other=0.0), oz)
        dx = tl.where(new, tl.load(directions + ray * 3, mask=new, other=0.0), dx)
        dy = tl.where(new, tl.load(directions + ray * 3 + 1, mask=new, other=0.0), dy)
        dz = tl.where(new, tl.load(directions + ray * 3 + 2, mask=new, other=0.0), dz)
        depth = tl.where(new, tl.load(starts + ray, mask=new, other=0.0), depth)
        entry = tl.where(new, tl.load(entries + ray, mask=new, other=0.0), entry)
        far = tl.where(new, tl.load(ends + ray, mask=new, other=0.0), far)
        sign, low, free = tl.where(new, 1.0, sign), tl.where(new, depth, low), tl.where(new, 0.0, free)
        low_value, gap = tl.where(new, infinite, low_value), tl.where(new, infinite, gap)
        high, high_value = tl.where(new, infinite, high), tl.where(new, 0.0, high_value)
        boldness, steps = tl.where(new, BOLDNESS, boldness), tl.where(new, 0, steps)
        taken += tl.sum(new.to(tl.int64), axis=0)
        free_place = tl.where(new, 0, free_place)
        under_way = free_place == 0

        points = (ox + depth * dx, oy + depth * dy, oz + depth * dz)
        raw = value_of_tile(points, parameters, own, omega, gain, ROWS, 3, WIDTH, DEPTH, COLUMNS, PIECE, PRECISION)

        sent_back, sign = turned_back(raw, depth, entry, low, low_value, sign)
        looks = under_way & (sent_back == 0)
        steps = tl.where(looks, steps + 1, steps)
        ahead, new_low, new_low_value, new_free, wide, new_high, new_high_value, bold, hit, passed, end, fall = look_at(
            raw * sign, 0.0, depth, far, low, low_value, free, gap, high, high_value, boldness, steps,
            tolerance, resolution, lipschitz, PATIENCE, BOLDNESS, STEEPEST_RISE, BAND_ENTRY, FLOOR,
        )  # fmt: skip
        ended = looks & (hit | passed | (steps >= max_steps))
        tl.store(found_mask + ray, hit.to(tl.int8), mask=ended)
        tl.store(found_depth + ray, end, mask=ended)
        tl.store(found_steps + ray, steps, mask=ended)
        tl.store(found_slope + ray, fall, mask=ended)

        depth = tl.where(looks, ahead, tl.where(sent_back, entry, depth))
        low = tl.where(looks, new_low, tl.where(sent_back, entry, low))
        low_value, free = tl.where(looks, new_low_value, low_value), tl.where(looks, new_free, free)
        high, high_value = tl.where(looks, new_high, high), tl.where(looks, new_high_value, high_value)
        boldness, gap = tl.where(looks, bold, boldness), tl.where(looks, wide, gap)
        free_place = tl.where(ended, 1, free_place)
        running = (taken < last) | (tl.sum(free_place, axis=0) < ROWS)


def march_rays(
    network: Network,
    rays: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    *,
    tolerance: float,
    resolution: float,
    lipschitz: float,
    max_steps: int,
    constants: dict[str, float],
    precision: str,
) -> Marched:
    """March rays to the surface of one network.

    Args:
        network: on the rays' device; up to 128 units, in three dimensions.
        rays: origins and directions ``(N, 3)``, and depths ``(N,)``: where each begins, where it may go back to if that
            is behind the surface, and where it gives up. All begin before they give up.
        tolerance: see `mplicits.neural_fields.sphere_trace`.
        resolution: see there.
        lipschitz: see there.
        max_steps: see there.
        constants: PATIENCE, BOLDNESS, STEEPEST_RISE and BAND_ENTRY of `_march`, and FLOOR, the size below which a value
            is zero.
        precision: see `mplicits.neural_fields.kernels.siren.siren_value`.
    """
    origins, directions, starts, entries, ends = (part.contiguous() for part in rays)
    count = len(origins)
    found = Marched.nothing(starts)
    if count:
        tiling = tiling_of(network.width)
        programs = program_count(origins.device, triton.cdiv(count, tiling.rows))
        kept = planes(network.depth, jet=False)
        with on_device(origins):
            march[(programs,)](  # pyright: ignore[reportIndexIssue]
                origins, directions, starts, entries, ends, network.parameters, *found[:4],
                scratch_for(origins, programs, kept * tiling.rows * tiling.stride(network.width)),
                count, triton.cdiv(count, programs), max_steps,
                float(tolerance), float(resolution), float(lipschitz), network.omega, network.gain,
                **constants,
                PLANES=kept, ROWS=tiling.rows, WIDTH=network.width, DEPTH=network.depth, COLUMNS=tiling.columns,
                PIECE=tiling.piece, PRECISION=precision, num_warps=tiling.warps, num_stages=2,
            )  # fmt: skip
    return found.in_own_types()
