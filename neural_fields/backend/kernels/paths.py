"""Rays that march through all levels in one launch, residuals evaluated only on those in the bands.

Each program has SLOTS places for rays, a ring of free ones, and for each level a ring of those that wait for its value.
Free places take the next rays of a queue that all programs share. A program serves its longest ring, up to ROWS rays at
a time. A value in the next band sends its ray to the ring of the next level. Any other goes through `advance`, after
which the ray has ended or goes back to level 0. So tiles of every level stay full. The state of rays lies in a scratch
of the program's own. The rules are those of `sphere_trace` without expectations; see `tracing.py`.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false
# pyright: reportOperatorIssue=false

from __future__ import annotations

import torch
import triton
import triton.language as tl

from . import tracing
from .launch import half_scratch, launch
from .levels import gate_of, level_of_tile
from .tensor_tiles import keep
from .tracing import March, advance, first_band, turned_back

# Rays under way in a program: more fill the tiles, fewer shorten the end. Twice as many above MANY_RAYS rays in all.
SLOTS, MANY_RAYS = 256, 1 << 19


@triton.jit
def added(numbers, INDEX: tl.constexpr, number, LEVELS: tl.constexpr):
    """A tuple of numbers with ``number`` added to one of them."""
    result = ()
    for level in tl.static_range(LEVELS):
        if level == INDEX:  # noqa: SIM108  only the chosen branch is compiled
            result = result + (numbers[level] + number,)
        else:
            result = result + (numbers[level],)
    return result


@triton.jit
def put(rings, heads, lengths, INDEX: tl.constexpr, entry, chosen, place, SLOTS: tl.constexpr):
    """Put the ``chosen`` of a tile behind the others of a ring, each at its ``place`` among them, from 1 on."""
    place = heads[INDEX] + lengths[INDEX] + place - 1
    tl.store(rings + INDEX * SLOTS + place % SLOTS, entry, mask=chosen)


@triton.jit
def serve(
    LEVEL: tl.constexpr,
    heads, lengths, weights, origins, directions, entries, ends, floats, halves, deltas, hit_mask, hit_depth,
    hit_steps, hit_slope, hit_level, kept, rings, scratch, tolerance, resolution, lipschitz, max_steps, taper,
    PATIENCE: tl.constexpr, BOLDNESS: tl.constexpr, STEEPEST_RISE: tl.constexpr, BAND_ENTRY: tl.constexpr,
    FLOOR: tl.constexpr, ORIGIN: tl.constexpr, TAPERED: tl.constexpr, SHAPES: tl.constexpr, SLOTS: tl.constexpr,
    ROWS: tl.constexpr,
):  # fmt: skip
    """Evaluate a level on the first rays of its ring, and route each → the rings' heads and lengths."""
    LEVELS: tl.constexpr = len(SHAPES)
    rays = rings + SLOTS * (LEVELS + 1)
    taken = rays + SLOTS
    line = tl.arange(0, ROWS)
    served = tl.minimum(lengths[LEVEL], ROWS)
    there = line < served
    head = heads[LEVEL]
    slot = tl.load(rings + LEVEL * SLOTS + (head + line) % SLOTS, mask=there, other=0)
    heads = added(heads, LEVEL, tl.where(head + served < SLOTS, served, served - SLOTS), LEVELS + 1)
    lengths = added(lengths, LEVEL, -served, LEVELS + 1)

    ray = tl.cast(tl.load(rays + slot, mask=there, other=0), tl.int64)
    depth = tl.load(kept + SLOTS + slot, mask=there, other=0.0)
    points = ()
    for axis in tl.static_range(3):
        o = tl.load(origins + ray * ORIGIN + axis, mask=there, other=0.0)
        points = points + (o + depth * tl.load(directions + ray * 3 + axis, mask=there, other=0.0),)
    raw = level_of_tile(LEVEL, points, floats, halves, weights, scratch, False, SHAPES, ROWS, 3)[0]
    if LEVEL > 0:
        before = tl.load(kept + slot, mask=there, other=0.0)
        raw = before + gate_of(before, tl.load(deltas + LEVEL - 1), taper, TAPERED)[0] * raw
    # By way of memory the values leave the layout of a product, in which each of the columns below would have to be
    # brought to it, one barrier or two for each.
    tl.store(kept + slot, raw, mask=there)
    tl.debug_barrier()
    raw = tl.load(kept + slot, mask=there, other=0.0)

    deeper = there & (line < 0)
    if LEVEL < LEVELS - 1:
        deeper = there & (tl.abs(raw) < tl.load(deltas + LEVEL))
    final = there & (deeper == 0)

    far = tl.load(ends + ray, mask=final, other=0.0)
    entry = tl.load(entries + ray, mask=final, other=0.0)
    low = tl.load(kept + 2 * SLOTS + slot, mask=final, other=0.0)
    low_value = tl.load(kept + 3 * SLOTS + slot, mask=final, other=0.0)
    free = tl.load(kept + 4 * SLOTS + slot, mask=final, other=0.0)
    gap = tl.load(kept + 5 * SLOTS + slot, mask=final, other=0.0)
    high = tl.load(kept + 6 * SLOTS + slot, mask=final, other=0.0)
    high_value = tl.load(kept + 7 * SLOTS + slot, mask=final, other=0.0)
    boldness = tl.load(kept + 8 * SLOTS + slot, mask=final, other=0.0)
    sign = tl.load(kept + 9 * SLOTS + slot, mask=final, other=0.0)
    steps = tl.load(taken + slot, mask=final, other=0)

    back, sign = turned_back(raw, depth, entry, low, low_value, sign)
    stepping = final & (back == 0)
    steps = tl.where(stepping, steps + 1, steps)
    value = raw * sign
    level_there, delta = first_band(value, deltas, LEVELS)
    ahead, low, low_value, free, gap, high, high_value, boldness, hit, passed, end, slope = advance(
        value, delta, depth, far, low, low_value, free, gap, high, high_value, boldness, steps,
        tolerance, resolution, lipschitz, PATIENCE, BOLDNESS, STEEPEST_RISE, BAND_ENTRY, FLOOR,
    )  # fmt: skip
    ended = stepping & (hit | passed | (steps >= max_steps))
    tl.store(hit_mask + ray, hit.to(tl.int8), mask=ended)
    tl.store(hit_depth + ray, end, mask=ended)
    tl.store(hit_steps + ray, steps, mask=ended)
    tl.store(hit_slope + ray, slope, mask=ended)
    tl.store(hit_level + ray, level_there, mask=ended)

    left = final & (ended == 0)
    went_on = left & (back == 0)
    tl.store(kept + SLOTS + slot, tl.where(back, entry, ahead), mask=left)
    tl.store(kept + 2 * SLOTS + slot, tl.where(back, entry, low), mask=left)
    tl.store(kept + 3 * SLOTS + slot, low_value, mask=went_on)
    tl.store(kept + 4 * SLOTS + slot, free, mask=went_on)
    tl.store(kept + 5 * SLOTS + slot, gap, mask=went_on)
    tl.store(kept + 6 * SLOTS + slot, high, mask=went_on)
    tl.store(kept + 7 * SLOTS + slot, high_value, mask=went_on)
    tl.store(kept + 8 * SLOTS + slot, boldness, mask=went_on)
    tl.store(kept + 9 * SLOTS + slot, sign, mask=left)
    tl.store(taken + slot, steps, mask=went_on)

    # One prefix sum for three rings: counts of up to 128 have ten bits each. The head of a full ring was read before
    # the barrier above.
    counts = left.to(tl.int32) + (ended.to(tl.int32) << 10) + (deeper.to(tl.int32) << 20)
    places, total = tl.cumsum(counts, axis=0), tl.sum(counts, axis=0)
    put(rings, heads, lengths, 0, slot, left, places & 1023, SLOTS)
    put(rings, heads, lengths, LEVELS, slot, ended, (places >> 10) & 1023, SLOTS)
    if LEVEL < LEVELS - 1:
        put(rings, heads, lengths, LEVEL + 1, slot, deeper, places >> 20, SLOTS)
        lengths = added(lengths, LEVEL + 1, total >> 20, LEVELS + 1)
    lengths = added(lengths, 0, total & 1023, LEVELS + 1)
    lengths = added(lengths, LEVELS, (total >> 10) & 1023, LEVELS + 1)
    tl.debug_barrier()  # what one thread wrote, others read
    return heads, lengths


@triton.jit(do_not_specialize=["max_steps"])
def march_bands(
    origins, directions, starts, entries, ends, listed, queue, floats, halves, deltas, hit_mask, hit_depth,
    hit_steps, hit_slope, hit_level, columns, counts, scratch, numbers, max_steps, taper,
    PATIENCE: tl.constexpr, BOLDNESS: tl.constexpr, STEEPEST_RISE: tl.constexpr, BAND_ENTRY: tl.constexpr,
    FLOOR: tl.constexpr, ORIGIN: tl.constexpr, TAPERED: tl.constexpr, SHAPES: tl.constexpr, SCRATCH: tl.constexpr,
    COLUMNS: tl.constexpr, COUNTS: tl.constexpr, SLOTS: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """March all rays of a queue; ``numbers`` are the tolerance, the resolution and the Lipschitz constant."""
    LEVELS: tl.constexpr = len(SHAPES)
    infinite = float("inf")
    program = tl.cast(tl.program_id(0), tl.int64)
    own = scratch + program * SCRATCH
    tolerance, resolution = tl.load(numbers).to(tl.float32), tl.load(numbers + 1).to(tl.float32)
    lipschitz = tl.load(numbers + 2).to(tl.float32)
    count = tl.load(queue)
    COARSEST: tl.constexpr = SHAPES[0]
    weights = keep(halves[0], COARSEST)
    kept = columns + program * SLOTS * COLUMNS
    rings = counts + program * SLOTS * (LEVELS + 1 + COUNTS)  # one for each level, and one of free slots
    rays = rings + SLOTS * (LEVELS + 1)
    taken = rays + SLOTS
    line = tl.arange(0, ROWS)
    zero = tl.zeros((ROWS,), tl.float32)
    for first in range(0, SLOTS, ROWS):
        tl.store(rings + LEVELS * SLOTS + first + line, first + line)
    tl.debug_barrier()

    none = tl.full((), 0, tl.int32)
    heads, lengths = (none,), (none,)
    for _ in tl.static_range(1, LEVELS):
        heads, lengths = heads + (none,), lengths + (none,)
    heads, lengths = heads + (none,), lengths + (none + SLOTS,)
    more = count > 0
    running = more
    while running:
        if more & (lengths[LEVELS] >= ROWS):  # free slots take the next rays
            first = tl.atomic_add(queue + 1, ROWS)
            new = first + line < count
            slot = tl.load(rings + LEVELS * SLOTS + (heads[LEVELS] + line) % SLOTS)
            ray = tl.load(listed + first + line, mask=new, other=0)
            depth = tl.load(starts + ray, mask=new, other=0.0)
            tl.store(kept + SLOTS + slot, depth, mask=new)
            tl.store(kept + 2 * SLOTS + slot, depth, mask=new)
            tl.store(kept + 3 * SLOTS + slot, zero + infinite, mask=new)
            tl.store(kept + 4 * SLOTS + slot, zero, mask=new)
            tl.store(kept + 5 * SLOTS + slot, zero + infinite, mask=new)
            tl.store(kept + 6 * SLOTS + slot, zero + infinite, mask=new)
            tl.store(kept + 7 * SLOTS + slot, zero, mask=new)
            tl.store(kept + 8 * SLOTS + slot, zero + BOLDNESS, mask=new)
            tl.store(kept + 9 * SLOTS + slot, zero + 1.0, mask=new)
            tl.store(rays + slot, ray, mask=new)
            tl.store(taken + slot, tl.zeros((ROWS,), tl.int32), mask=new)
            got = tl.maximum(tl.minimum(count - first, ROWS), 0)
            heads = added(heads, LEVELS, tl.where(heads[LEVELS] + got < SLOTS, got, got - SLOTS), LEVELS + 1)
            lengths = added(lengths, LEVELS, -got, LEVELS + 1)
            put(rings, heads, lengths, 0, slot, new, line + 1, SLOTS)
            lengths = added(lengths, 0, got, LEVELS + 1)
            more = first + ROWS < count
            tl.debug_barrier()  # what one thread wrote, others read

        turn, most = none, lengths[0]
        for level in tl.static_range(1, LEVELS):
            turn = tl.where(lengths[level] > most, level, turn)
            most = tl.maximum(most, lengths[level])
        # A loop of none or one: the compiler moves the weights that are kept out of a loop, and not out of a branch.
        for _once in range((turn == 0).to(tl.int32)):
            heads, lengths = serve(
                0, heads, lengths, weights, origins, directions, entries, ends, floats, halves, deltas,
                hit_mask, hit_depth, hit_steps, hit_slope, hit_level, kept, rings, own,
                tolerance, resolution, lipschitz, max_steps, taper,
                PATIENCE, BOLDNESS, STEEPEST_RISE, BAND_ENTRY, FLOOR, ORIGIN, TAPERED, SHAPES, SLOTS, ROWS,
            )  # fmt: skip
        for level in tl.static_range(1, LEVELS):
            if turn == level:
                heads, lengths = serve(
                    level, heads, lengths, (), origins, directions, entries, ends, floats, halves, deltas,
                    hit_mask, hit_depth, hit_steps, hit_slope, hit_level, kept, rings, own,
                    tolerance, resolution, lipschitz, max_steps, taper,
                    PATIENCE, BOLDNESS, STEEPEST_RISE, BAND_ENTRY, FLOOR, ORIGIN, TAPERED, SHAPES, SLOTS, ROWS,
                )  # fmt: skip
        running = more | (lengths[LEVELS] < SLOTS)


def march_fused(asked: March) -> None:
    """`march_rays` for one network that leaves registers for rays, `march_levels` for all others."""
    networks = asked.levels.networks
    if len(networks) == 1 and networks[0].shape.width <= tracing.IN_REGISTERS:
        tracing.march_rays(asked)
    else:
        march_levels(asked)


def march_levels(asked: March) -> None:
    """March the rays of a queue to the surface of the finest of one or more levels."""
    levels, rays, queue, marched, numbers, max_steps, constants = asked
    kept, like, rows = levels.scratch(jet=False), rays.starts, levels.rows
    # Numbers of a ray: value so far, depth, low, low_value, free, gap, high, high_value, boldness, sign.
    floats = 10
    whole = 2  # its number, and its number of steps
    slots = SLOTS if len(like) <= MANY_RAYS else 2 * SLOTS

    def arguments(programs: int) -> tuple[object, ...]:
        columns = torch.empty(programs * slots * floats, dtype=torch.float32, device=like.device)
        counts = torch.empty(
            programs * slots * (len(levels.networks) + 1 + whole), dtype=torch.int32, device=like.device
        )
        scratch = half_scratch(like, programs * kept)
        return *rays, *queue, *levels.arguments(), *marched, columns, counts, scratch, numbers, max_steps, levels.taper

    launch(
        march_bands,
        like,
        triton.cdiv(len(like), rows),
        arguments,
        **constants,
        ORIGIN=3 * (len(rays.origins) > 1),
        TAPERED=levels.taper > 0,
        SHAPES=levels.shapes,
        SCRATCH=kept,
        COLUMNS=floats,
        COUNTS=whole,
        SLOTS=slots,
        ROWS=rows,
        warps=rows // 16,
    )
