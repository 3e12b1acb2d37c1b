"""Rays that march through one network in one launch: each stays in registers until it meets the surface or leaves.

`tracing._march` has some seventy small operations between evaluations; on a GPU each is a launch. Here a program
marches ROWS rays at a time: a value of its tile, then the rules of `tracing._march.step` in registers. A ray that ends
writes its results, and the next ray of a queue, shared by all programs, takes its place.

The rules are those of `sphere_trace` for a field without bands and without expectations. Decisions are the same; values
differ by rounding, and depths by about as much over the slope.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from .launch import half_scratch, launch
from .levels import Levels
from .tensor_tiles import keep, value_of_tile

# One network of up to this width leaves registers enough to keep rays there too.
IN_REGISTERS = 128


class RayTensors(NamedTuple):
    """Rays on a device."""

    origins: Tensor  # (N, 3), or (1, 3) for all of them
    directions: Tensor  # (N, 3) of unit length
    starts: Tensor  # (N,) depth at which each begins
    entries: Tensor  # (N,) depth to which it may go back if that is behind the surface
    ends: Tensor  # (N,) depth at which it stops


class Queue(NamedTuple):
    """Rays to be marched."""

    rays: Tensor  # (N,) int32, their numbers
    state: Tensor  # (2,) int32, how many there are, and how many were taken

    @classmethod
    def of(cls, starts: Tensor, ends: Tensor) -> Queue:
        """All rays that begin before they end, in order; nothing waits."""
        begins = starts < ends
        place = begins.cumsum(0)
        rays = torch.empty(len(starts) + 1, dtype=torch.int32, device=starts.device)
        numbers = torch.arange(len(starts), dtype=torch.int32, device=starts.device)
        rays.scatter_(0, torch.where(begins, place - 1, len(starts)), numbers)
        state = torch.zeros(2, dtype=torch.int32, device=starts.device)
        state[:1] = place[-1:]
        return cls(rays, state)


class Marched(NamedTuple):
    """Results of rays, ``(N,)`` each; the names are those of `Hits`."""

    mask: Tensor  # whether a ray meets the surface
    depth: Tensor  # where, or where its search ended
    steps: Tensor  # evaluations of the network on it
    slope: Tensor  # how fast the field fell along the ray at its last step
    level: Tensor  # how many bands its last value lay in

    @classmethod
    def nothing(cls, starts: Tensor) -> Marched:
        """Memory for results, in the types of kernels, filled in for rays that never begin."""
        small, number = (torch.zeros_like(starts, dtype=dtype) for dtype in (torch.int8, torch.int32))
        return cls(small, starts.clone(), number, torch.ones_like(starts), torch.zeros_like(number))

    def in_own_types(self) -> Marched:
        """The results in the types of `Hits`."""
        return self._replace(mask=self.mask.bool(), steps=self.steps.long(), level=self.level.long())


class March(NamedTuple):
    """All that a march takes; the state of the queue changes, and results go to ``marched``."""

    levels: Levels
    rays: RayTensors
    queue: Queue
    marched: Marched
    numbers: Tensor  # (3,) tolerance, resolution and Lipschitz constant of `sphere_trace`, on the device
    max_steps: int
    constants: dict[str, float]  # those of `march_constants`


@triton.jit
def first_band(value, deltas, LEVELS: tl.constexpr):
    """How many bands values lie in, and the half-width of the first that they do not, 0 inside all of them."""
    level, delta = tl.zeros(value.shape, tl.int32), tl.zeros(value.shape, tl.float32)
    within = value == value
    for index in tl.static_range(LEVELS - 1):
        width = tl.load(deltas + index)
        closer = within & (tl.abs(value) < width)
        delta = tl.where(within & (closer == 0), width, delta)
        level += closer.to(tl.int32)
        within = closer
    return level, delta


@triton.jit
def turned_back(raw, depth, entry, low, low_value, sign):
    """Which rays start behind the surface and go back to where they may begin, and the new sign of values."""
    fresh = (low_value == float("inf")) & (depth == low)
    back = fresh & (raw < 0) & (depth > entry)
    return back, tl.where(fresh & (raw < 0), tl.where(back, 1.0, -1.0), sign)


@triton.jit
def advance(
    value, delta, depth, far, low, low_value, free, gap, high, high_value, boldness, steps, tolerance, resolution,
    lipschitz,
    PATIENCE: tl.constexpr, BOLDNESS: tl.constexpr, STEEPEST_RISE: tl.constexpr, BAND_ENTRY: tl.constexpr,
    FLOOR: tl.constexpr,
):  # fmt: skip
    """Take in values at ``depth``, the ``steps``-th of each ray, outside a band of half-width ``delta``, or 0.

    Returns the columns depth, low, low_value, free, gap, high, high_value and boldness of ``Rays``; then hit, passed,
    the depth of a hit, and the slope.
    """
    infinite = float("inf")
    wide = tl.maximum(BAND_ENTRY * delta, resolution * tl.exp2(((steps - 1) // PATIENCE).to(tl.float32)))
    new_free = tl.maximum((tl.abs(value) - delta) / lipschitz, 0.0)
    known = low_value < infinite
    slope = tl.where(known, (value - low_value) / tl.where(known & (depth != low), depth - low, 1.0), -1.0)
    enclosed = high < infinite
    sound = enclosed | (depth - low - free - new_free <= gap)
    before, behind = sound & (value > 0), sound & (value <= 0)
    new_low, new_high = tl.where(before, depth, low), tl.where(behind, depth, high)
    new_low_value, new_high_value = tl.where(before, value, low_value), tl.where(behind, value, high_value)

    s = tl.minimum(tl.maximum(slope, -1.0), STEEPEST_RISE)
    widest = boldness * new_free * (1 + s) / (1 - s)
    zero_at = tl.where(s < 0, value / tl.where(s < 0, -s, 1.0), infinite)
    ahead = depth + new_free + tl.maximum(widest, tl.minimum(wide, zero_at - new_free))
    ahead = tl.where(before, ahead, low + free)
    closed = new_high < infinite
    width = tl.where(closed, new_high - new_low, 0.0)
    span = tl.where(closed & (new_low_value < infinite), new_low_value - new_high_value, 1.0)
    span = tl.where(span == 0, 1.0, span)  # of rays that have ended; these places are not used
    chord = new_low + width * tl.where(new_low_value < infinite, new_low_value / span, 1.0)
    halved = (enclosed == 0) | (2 * width <= high - low)
    closing = tl.where(halved, chord, new_low + width / 2)

    steep = tl.minimum(tl.abs(slope), 1.0)
    near = sound & (delta == 0) & (tl.abs(value) <= tl.maximum(tolerance * steep, FLOOR))
    pinned = closed & (width <= tolerance)
    passed = before & (closed == 0) & (depth + new_free + wide >= far) & (near == 0)
    step = value / tl.maximum(steep, 1e-30)  # nothing steeper matters: it is cut off at the tolerance
    landing = depth + tl.minimum(tl.maximum(step, -tolerance), tolerance)
    return (
        tl.minimum(tl.where(closed, closing, ahead), far),
        new_low,
        new_low_value,
        tl.where(before, new_free, free),
        wide,
        new_high,
        new_high_value,
        tl.where(sound | (known == 0), boldness, boldness / 2),
        near | pinned,
        passed,
        tl.where(near, landing, tl.where(pinned, chord, depth)),
        steep,
    )


@triton.jit(do_not_specialize=["max_steps"])
def march(
    origins, directions, starts, entries, ends, listed, queue, floats, halves, hit_mask, hit_depth, hit_steps,
    hit_slope, scratch, exchanged, numbers, max_steps,
    PATIENCE: tl.constexpr, BOLDNESS: tl.constexpr, STEEPEST_RISE: tl.constexpr, BAND_ENTRY: tl.constexpr,
    FLOOR: tl.constexpr, ORIGIN: tl.constexpr, SHAPE: tl.constexpr, SCRATCH: tl.constexpr, ROWS: tl.constexpr,
    REFILL: tl.constexpr,
):  # fmt: skip
    """March all rays of a queue; ``numbers`` are the tolerance, the resolution and the Lipschitz constant."""
    infinite = float("inf")
    own = scratch + tl.cast(tl.program_id(0), tl.int64) * SCRATCH
    cell = exchanged + tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    tolerance, resolution = tl.load(numbers).to(tl.float32), tl.load(numbers + 1).to(tl.float32)
    lipschitz = tl.load(numbers + 2).to(tl.float32)
    count = tl.load(queue)
    kept = keep(halves, SHAPE)
    # Nothing under way yet: every place is free.
    ray = tl.full((ROWS,), 0, tl.int64)
    free_place = tl.full((ROWS,), 1, tl.int32)
    zero = tl.zeros((ROWS,), tl.float32)
    ox, oy, oz, dx, dy, dz = zero, zero, zero, zero, zero, zero
    depth, entry, far, sign, low, free = zero, zero, zero, zero + 1, zero, zero
    low_value, gap, high, high_value, boldness = zero, zero, zero, zero, zero
    steps = tl.zeros((ROWS,), tl.int32)
    left = tl.full((), ROWS, tl.int32)  # free places
    more = count > 0
    running = more
    while running:
        if more & (left >= REFILL):  # free places take the next rays
            first = tl.atomic_add(queue + 1, left)
            place = first + tl.cumsum(free_place, axis=0) - 1
            new = (free_place > 0) & (place < count)
            taken = tl.cast(tl.load(listed + place, mask=new, other=0), tl.int64)
            ray = tl.where(new, taken, ray)
            ox = tl.where(new, tl.load(origins + ray * ORIGIN, mask=new, other=0.0), ox)
            oy = tl.where(new, tl.load(origins + ray * ORIGIN + 1, mask=new, other=0.0), oy)
            oz = tl.where(new, tl.load(origins + ray * ORIGIN + 2, mask=new, other=0.0), oz)
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
            more = first + left < count
            free_place = tl.where(new, 0, free_place)
        under_way = free_place == 0

        points = (ox + depth * dx, oy + depth * dy, oz + depth * dz)
        raw = value_of_tile(points, floats, halves, kept, own, SHAPE, ROWS, 3)
        # By way of memory the values leave the layout of a product, in which each ray would take twice the registers.
        tl.store(cell, raw)
        tl.debug_barrier()
        raw = tl.load(cell)

        sent_back, sign = turned_back(raw, depth, entry, low, low_value, sign)
        stepping = under_way & (sent_back == 0)
        steps = tl.where(stepping, steps + 1, steps)
        ahead, new_low, new_low_value, new_free, wide, new_high, new_high_value, bold, hit, passed, end, fall = advance(
            raw * sign, 0.0, depth, far, low, low_value, free, gap, high, high_value, boldness, steps,
            tolerance, resolution, lipschitz, PATIENCE, BOLDNESS, STEEPEST_RISE, BAND_ENTRY, FLOOR,
        )  # fmt: skip
        ended = stepping & (hit | passed | (steps >= max_steps))
        tl.store(hit_mask + ray, hit.to(tl.int8), mask=ended)
        tl.store(hit_depth + ray, end, mask=ended)
        tl.store(hit_steps + ray, steps, mask=ended)
        tl.store(hit_slope + ray, fall, mask=ended)

        depth = tl.where(stepping, ahead, tl.where(sent_back, entry, depth))
        low = tl.where(stepping, new_low, tl.where(sent_back, entry, low))
        low_value, free = tl.where(stepping, new_low_value, low_value), tl.where(stepping, new_free, free)
        high, high_value = tl.where(stepping, new_high, high), tl.where(stepping, new_high_value, high_value)
        boldness, gap = tl.where(stepping, bold, boldness), tl.where(stepping, wide, gap)
        free_place = tl.where(ended, 1, free_place)
        left = tl.sum(free_place, axis=0)
        tl.debug_barrier()  # all have read their values
        running = more | (left < ROWS)


def march_rays(asked: March) -> None:
    """March the rays of a queue to the surface of one three-dimensional network up to 128 units wide."""
    levels, rays, queue, marched, numbers, max_steps, constants = asked
    (network,) = levels.networks
    rows = network.shape.rows
    kept = network.shape.scratch(rows, jet=False)
    launch(
        march,
        rays.starts,
        triton.cdiv(len(rays.starts), rows),
        lambda programs: (
            *rays, *queue, network.floats, network.halves, *marched[:4],
            half_scratch(rays.starts, programs * kept),
            torch.empty(programs * rows, dtype=torch.float32, device=rays.starts.device), numbers, max_steps,
        ),
        **constants,
        ORIGIN=3 * (len(rays.origins) > 1),
        SHAPE=tuple(network.shape),
        SCRATCH=kept,
        ROWS=rows,
        REFILL=16,  # free places before a program takes new rays: fewer waste requests, more waste places
        warps=rows // 16,
    )  # fmt: skip
