"""Rays that march through all levels in one launch, residuals evaluated only on those in the bands.

Each program has its share of the rays, and for each level a ring of those that wait for its value. It serves the
longest ring, up to ROWS rays at a time. A value that lies in the next band sends its ray on to the ring of the next
level; any other is looked at (`rules.py`), and the ray has ended or goes back to the ring of level 0. So tiles of every
level are full as long as there are rays enough, and neither the host nor another program has a say. Where rays stand
lies in a scratch of the program's own, small enough for caches: some eleven numbers of each.

The rules are those of `sphere_trace` without expectations; see `tracing.py`.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .launch import on_device, program_count, scratch_for
from .levels import Levels, gate_of, level_of_tile
from .rules import first_band, look_at, turned_back
from .tracing import Marched

__all__ = ["march_levels"]

# Numbers of a ray, in this order: value so far, depth, low, low_value, free, gap, high, high_value, boldness, sign.
COLUMNS = 10


@triton.jit
def scalar_of(numbers, index, LEVELS: tl.constexpr):
    """One of a tuple of numbers, by an index that is not known when the kernel is compiled."""
    found = numbers[0]
    for level in tl.static_range(1, LEVELS):
        found = tl.where(index == level, numbers[level], found)
    return found


@triton.jit
def added(numbers, index, number, LEVELS: tl.constexpr):
    """A tuple of numbers with one of them more by ``number``."""
    result = ()
    for level in tl.static_range(LEVELS):
        result = result + (numbers[level] + tl.where(index == level, number, 0),)
    return result


@triton.jit
def push(rings, heads, lengths, index, entry, chosen, share, LEVELS: tl.constexpr):
    """Put the ``chosen`` of a tile behind the others of a ring → all rings' lengths."""
    count = chosen.to(tl.int32)
    place = scalar_of(heads, index, LEVELS) + scalar_of(lengths, index, LEVELS) + tl.cumsum(count, axis=0) - 1
    tl.store(rings + index * share + place % share, entry, mask=chosen)
    return added(lengths, index, tl.sum(count, axis=0), LEVELS)


@triton.jit(do_not_specialize=["count", "share", "max_steps"])
def march_bands(
    origins,
    directions,
    starts,
    entries,
    ends,
    parameters,
    omegas,
    gains,
    deltas,
    found_mask,
    found_depth,
    found_steps,
    found_slope,
    found_level,
    columns,
    counts,
    scratch,
    count,
    share,
    max_steps,
    tolerance,
    resolution,
    lipschitz,
    taper,
    PATIENCE: tl.constexpr,
    BOLDNESS: tl.constexpr,
    STEEPEST_RISE: tl.constexpr,
    BAND_ENTRY: tl.constexpr,
    FLOOR: tl.constexpr,
    TAPERED: tl.constexpr,
    SIZES: tl.constexpr,
    FLOATS: tl.constexpr,
    NUMBERS: tl.constexpr,
    ROWS: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """A program has the rays from its number on, in steps of how many programs there are: ``share`` at most."""
    LEVELS: tl.constexpr = len(SIZES)
    infinite = float("inf")
    program = tl.cast(tl.program_id(0), tl.int64)
    programs = tl.cast(tl.num_programs(0), tl.int64)
    share = tl.cast(share, tl.int32)
    own = scratch + program * FLOATS
    kept = columns + program * share * NUMBERS
    rings = counts + program * share * (LEVELS + 1)  # and behind them, how often each ray was looked at
    taken = rings + share * LEVELS
    mine = tl.cast((count - program + programs - 1) // programs, tl.int32)
    line = tl.arange(0, ROWS)
    zero = tl.zeros((ROWS,), tl.float32)
    for first in range(0, mine, ROWS):
        local = first + line
        real = local < mine
        depth = tl.load(starts + local * programs + program, mask=real, other=0.0)
        tl.store(kept + share + local, depth, mask=real)
        tl.store(kept + 2 * share + local, depth, mask=real)
        tl.store(kept + 3 * share + local, zero + infinite, mask=real)
        tl.store(kept + 4 * share + local, zero, mask=real)
        tl.store(kept + 5 * share + local, zero + infinite, mask=real)
        tl.store(kept + 6 * share + local, zero + infinite, mask=real)
        tl.store(kept + 7 * share + local, zero, mask=real)
        tl.store(kept + 8 * share + local, zero + BOLDNESS, mask=real)
        tl.store(kept + 9 * share + local, zero + 1.0, mask=real)
        tl.store(taken + local, tl.zeros((ROWS,), tl.int32), mask=real)
        tl.store(rings + local, local, mask=real)
    tl.debug_barrier()

    none = tl.full((), 0, tl.int32)
    heads, lengths = (none,), (none + mine,)
    for _ in tl.static_range(1, LEVELS):
        heads, lengths = heads + (none,), lengths + (none,)
    waiting = mine
    while waiting > 0:
        turn, most = none, lengths[0]
        for level in tl.static_range(1, LEVELS):
            turn = tl.where(lengths[level] > most, level, turn)
            most = tl.maximum(most, lengths[level])
        served = tl.minimum(most, ROWS)
        there = line < served
        turns = tl.zeros((ROWS,), tl.int32) + turn
        head = scalar_of(heads, turn, LEVELS)
        local = tl.load(rings + turn * share + (head + line) % share, mask=there, other=0)
        heads = added(heads, turn, tl.where(head + served < share, served, served - share), LEVELS)
        lengths = added(lengths, turn, -served, LEVELS)

        ray = local * programs + program
        depth = tl.load(kept + share + local, mask=there, other=0.0)
        points = ()
        for axis in tl.static_range(3):
            o = tl.load(origins + ray * 3 + axis, mask=there, other=0.0)
            points = points + (o + depth * tl.load(directions + ray * 3 + axis, mask=there, other=0.0),)
        raw = tl.load(kept + local, mask=there & (turns > 0), other=0.0)
        gate = zero + 1.0
        if LEVELS > 1:
            gate = gate_of(raw, tl.load(deltas + tl.maximum(turn - 1, 0)), taper, TAPERED)[0]
        for level in tl.static_range(LEVELS):
            if turn == level:
                raw += (
                    gate
                    * level_of_tile(level, points, parameters, own, omegas, gains, False, SIZES, ROWS, 3, PRECISION)[0]
                )

        deeper = there & (turns < LEVELS - 1)
        if LEVELS > 1:
            deeper = deeper & (tl.abs(raw) < tl.load(deltas + tl.minimum(turn, LEVELS - 2)))
        tl.store(kept + local, raw, mask=deeper)
        seen = there & (deeper == 0)

        far = tl.load(ends + ray, mask=seen, other=0.0)
        entry = tl.load(entries + ray, mask=seen, other=0.0)
        low = tl.load(kept + 2 * share + local, mask=seen, other=0.0)
        low_value = tl.load(kept + 3 * share + local, mask=seen, other=0.0)
        free = tl.load(kept + 4 * share + local, mask=seen, other=0.0)
        gap = tl.load(kept + 5 * share + local, mask=seen, other=0.0)
        high = tl.load(kept + 6 * share + local, mask=seen, other=0.0)
        high_value = tl.load(kept + 7 * share + local, mask=seen, other=0.0)
        boldness = tl.load(kept + 8 * share + local, mask=seen, other=0.0)
        sign = tl.load(kept + 9 * share + local, mask=seen, other=0.0)
        steps = tl.load(taken + local, mask=seen, other=0)

        back, sign = turned_back(raw, depth, entry, low, low_value, sign)
        looks = seen & (back == 0)
        steps = tl.where(looks, steps + 1, steps)
        value = raw * sign
        level_there, delta = first_band(value, deltas, LEVELS)
        ahead, low, low_value, free, gap, high, high_value, boldness, hit, passed, end, slope = look_at(
            value, delta, depth, far, low, low_value, free, gap, high, high_value, boldness, steps,
            tolerance, resolution, lipschitz, PATIENCE, BOLDNESS, STEEPEST_RISE, BAND_ENTRY, FLOOR,
        )  # fmt: skip
        ended = looks & (hit | passed | (steps >= max_steps))
        tl.store(found_mask + ray, hit.to(tl.int8), mask=ended)
        tl.store(found_depth + ray, end, mask=ended)
        tl.store(found_steps + ray, steps, mask=ended)
        tl.store(found_slope + ray, slope, mask=ended)
        tl.store(found_level + ray, level_there, mask=ended)

        again = back & seen
        left = seen & (ended == 0)
        tl.store(kept + share + local, tl.where(back, entry, ahead), mask=left)
        tl.store(kept + 2 * share + local, tl.where(back, entry, low), mask=left)
        tl.store(kept + 9 * share + local, sign, mask=left)
        went_on = left & (again == 0)
        tl.store(kept + 3 * share + local, low_value, mask=went_on)
        tl.store(kept + 4 * share + local, free, mask=went_on)
        tl.store(kept + 5 * share + local, gap, mask=went_on)
        tl.store(kept + 6 * share + local, high, mask=went_on)
        tl.store(kept + 7 * share + local, high_value, mask=went_on)
        tl.store(kept + 8 * share + local, boldness, mask=went_on)
        tl.store(taken + local, steps, mask=went_on)

        tl.debug_barrier()  # a full ring is written where it was read
        if LEVELS > 1:
            lengths = push(rings, heads, lengths, tl.minimum(turn + 1, LEVELS - 1), local, deeper, share, LEVELS)
        lengths = push(rings, heads, lengths, none, local, left, share, LEVELS)
        waiting = lengths[0]
        for level in tl.static_range(1, LEVELS):
            waiting += lengths[level]
        tl.debug_barrier()  # what one thread wrote, others read


def march_levels(
    levels: Levels,
    rays: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    *,
    tolerance: float,
    resolution: float,
    lipschitz: float,
    max_steps: int,
    constants: dict[str, float],
    precision: str,
) -> Marched:
    """March rays to the surface of the finest of some levels.

    Args:
        levels: one or more, on the rays' device, in three dimensions.
        rays: see `mplicits.neural_fields.kernels.tracing.march_rays`, as are all that follow.
        tolerance: see there.
        resolution: see there.
        lipschitz: see there.
        max_steps: see there.
        constants: those, and BAND_ENTRY of `_march`.
        precision: see there.
    """
    origins, directions, starts, entries, ends = (part.contiguous() for part in rays)
    count, device = len(origins), origins.device
    found = Marched.nothing(starts)
    if count:
        shape = levels.shape(jet=False)
        programs = program_count(device, triton.cdiv(count, shape.rows))
        share = triton.cdiv(count, programs)
        lists = torch.empty(programs * share * (len(shape.sizes) + 1), dtype=torch.int32, device=device)
        with on_device(origins):
            march_bands[(programs,)](  # pyright: ignore[reportIndexIssue]
                origins, directions, starts, entries, ends, *levels.arguments(), *found,
                scratch_for(origins, programs, share * COLUMNS), lists,
                scratch_for(origins, programs, shape.floats), count, share, max_steps,
                float(tolerance), float(resolution), float(lipschitz), levels.taper,
                **constants,
                TAPERED=levels.taper > 0, SIZES=shape.sizes, FLOATS=shape.floats, NUMBERS=COLUMNS, ROWS=shape.rows,
                PRECISION=precision, num_warps=shape.warps, num_stages=2,
            )  # fmt: skip
    return found.in_own_types()
