"""The rules of `tracing._march.look` for kernels that march rays."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false

from __future__ import annotations

import triton
import triton.language as tl


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
def look_at(
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
    span = tl.where(span == 0, 1.0, span)  # of rays that have ended, on places that nobody takes
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
