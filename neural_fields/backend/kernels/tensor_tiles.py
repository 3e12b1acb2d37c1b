"""Value, or value and gradient, of a tile of points on tensor cores.

A tile is a matrix of ROWS points. A product of matrices is three of float16 with sums in float32: both operands are
split into a high and a low half, and the product of the low ones, about 2⁻²² of a term, is left out. So values and
gradients have the error of float32.

The first sine layer is made from the points, piece by piece, as the product with the second one needs it. The last one
goes from its accumulator into the output's sum. Layers between them, and all layers of networks wider than one
accumulator, lie as halves in a scratch of the program's own: layer i in plane i mod 2, behind these the cosines of the
layers between first and last. See `packing.py` for the weights.

Arguments that functions have in common:
    points: the coordinates, a tuple of IN columns (ROWS,).
    floats, halves: see `Packed`.
    scratch: float16 pointer to what the program may write; see `Shape.scratch`.
    kept: halves of the hidden matrix from `keep`, which stay in shared memory; or ().
    SHAPE: `Shape` as a tuple.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import triton
import triton.language as tl

from .packing import SINES

# sin 2πq on [−¼, ¼] as the odd polynomial of degree 9 with the smallest largest error, 3.3e-9 (Remez exchange).
C1 = tl.constexpr(6.283185005187988)
C3 = tl.constexpr(-41.34165573120117)
C5 = tl.constexpr(81.60100555419922)
C7 = tl.constexpr(-76.5497817993164)
C9 = tl.constexpr(39.536705017089844)
# Added to a number below 2²² and taken away again, it rounds to the nearest integer, whose last bit is the sum's.
ROUND = tl.constexpr(12582912.0)
SCALE = tl.constexpr(SINES)


@triton.jit
def _polynomial(q, FACTOR: tl.constexpr):
    """FACTOR sin 2πq for |q| ≤ ¼; a power of two as factor costs nothing."""
    s = q * q
    p = s * (C9 * FACTOR) + C7 * FACTOR
    p = p * s + C5 * FACTOR
    p = p * s + C3 * FACTOR
    p = p * s + C1 * FACTOR
    return p * q


@triton.jit
def _reduced(turns):
    """|r| ≤ ¼ and the bit of a sign, with sin 2πτ = ± sin 2πr; exact for |τ| < 2²¹."""
    k = turns * 2 + ROUND
    return turns - 0.5 * (k - ROUND), k.to(tl.int32, bitcast=True) << 31


@triton.jit
def _signed(p, sign):
    return (p.to(tl.int32, bitcast=True) ^ sign).to(tl.float32, bitcast=True)


@triton.jit
def sine(turns, FACTOR: tl.constexpr = 1.0):
    """FACTOR sin 2πτ, to FACTOR · 2e-7 for a given τ below 2²¹."""
    r, sign = _reduced(turns)
    return _signed(_polynomial(r, FACTOR), sign)


@triton.jit
def cosine(turns, FACTOR: tl.constexpr = 1.0):
    """FACTOR cos 2πτ, as `sine`."""
    r, sign = _reduced(turns)
    return _signed(_polynomial(0.25 - tl.abs(r), FACTOR), sign)


@triton.jit
def sine_cosine(turns):
    """Sin 2πτ and cos 2πτ."""
    r, sign = _reduced(turns)
    return _signed(_polynomial(r, 1.0), sign), _signed(_polynomial(0.25 - tl.abs(r), 1.0), sign)


@triton.jit
def halves_of(h):
    """A float32 matrix as the sum of two of float16, high and low."""
    high = h.to(tl.float16)
    return high, (h - high.to(tl.float32)).to(tl.float16)


@triton.jit
def rows_of(tile, ROWS: tl.constexpr):
    """The rows of a tile (ROWS,), in 64 bits: offsets of 2³¹ and more occur."""
    return tl.full((ROWS,), ROWS, tl.int64) * tile + tl.arange(0, ROWS)


@triton.jit
def points_of(x, row, real, IN: tl.constexpr):
    """The coordinates of the points ``row`` (ROWS,), a tuple of IN columns."""
    points = ()
    for axis in tl.static_range(IN):
        points = points + (tl.load(x + row * IN + axis, mask=real, other=0.0),)
    return points


@triton.jit
def _first_turns(points, floats, unit, WIDTH: tl.constexpr, IN: tl.constexpr):
    """Phases of some units of the first layer, in turns; in float32, since large phases need 24 bits."""
    z = tl.load(floats + IN * WIDTH + unit)[None, :]
    for axis in tl.static_range(IN):
        z += points[axis][:, None] * tl.load(floats + axis * WIDTH + unit)[None, :]
    return z


@triton.jit
def keep(halves, SHAPE: tl.constexpr):
    """The halves of the only hidden matrix, loaded before a loop so that they stay in shared memory; or ()."""
    WIDTH: tl.constexpr = SHAPE[0]
    KEPT: tl.constexpr = SHAPE[5]
    if KEPT:
        unit = tl.arange(0, WIDTH)
        cell = unit[:, None] * WIDTH + unit[None, :]
        return tl.load(halves + cell), tl.load(halves + WIDTH * WIDTH + cell)
    else:
        return ()


@triton.jit
def _kept_turns(points, floats, kept, ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr):
    """Phases of the second of two sine layers, by the kept matrix."""
    unit = tl.arange(0, WIDTH)
    high, low = halves_of(sine(_first_turns(points, floats, unit, WIDTH, IN), SCALE))
    z = tl.zeros((ROWS, WIDTH), tl.float32)
    z = tl.dot(low, kept[0], z)
    z = tl.dot(high, kept[1], z)
    z = tl.dot(high, kept[0], z)
    bias = tl.load(floats + (IN + 1) * WIDTH + unit)
    return z * tl.load(floats + (IN + 4) * WIDTH + 2) + bias[None, :]


@triton.jit
def _store_halves(plane, cell, h, LOW: tl.constexpr):
    """Store the halves of a matrix, the low one LOW numbers behind the high one."""
    high, low = halves_of(h)
    tl.store(plane + cell, high)
    tl.store(plane + LOW + cell, low)


@triton.jit
def _add_product(z, high, low, matrix, inner, unit, WIDTH: tl.constexpr, BACK: tl.constexpr):
    """Z + h M, or with BACK z + h Mᵀ, for some inner units and some units, with h = high + low."""
    if BACK:  # noqa: SIM108  only the chosen branch is compiled
        cell = unit[None, :] * WIDTH + inner[:, None]
    else:
        cell = inner[:, None] * WIDTH + unit[None, :]
    m_high, m_low = tl.load(matrix + cell), tl.load(matrix + WIDTH * WIDTH + cell)
    z = tl.dot(low, m_high, z)
    z = tl.dot(high, m_low, z)
    return tl.dot(high, m_high, z)


@triton.jit
def _product(
    points, plane, floats, matrix, unit,
    FROM_POINTS: tl.constexpr, BACK: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr, IN: tl.constexpr,
    WIDTH: tl.constexpr, PIECE: tl.constexpr,
):  # fmt: skip
    """The scaled product of a layer with a matrix for some units; the layer is made from the points, or in a plane."""
    row = tl.arange(0, ROWS)
    z = tl.zeros((ROWS, COLUMNS), tl.float32)
    for first in range(0, WIDTH, PIECE):
        inner = first + tl.arange(0, PIECE)
        if FROM_POINTS:
            high, low = halves_of(sine(_first_turns(points, floats, inner, WIDTH, IN), SCALE))
        else:
            cell = row[:, None] * WIDTH + inner[None, :]
            high, low = tl.load(plane + cell), tl.load(plane + ROWS * WIDTH + cell)
        z = _add_product(z, high, low, matrix, inner, unit, WIDTH, BACK)
    return z


@triton.jit
def _turns(
    points, floats, halves, scratch, unit,
    LAYER: tl.constexpr, SHAPE: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr,
):  # fmt: skip
    """Phases of some units of a layer, counted from 0, whose layer below is kept or made from the points."""
    WIDTH: tl.constexpr = SHAPE[0]
    DEPTH: tl.constexpr = SHAPE[1]
    COLUMNS: tl.constexpr = SHAPE[2]
    NUMBERS: tl.constexpr = (IN + DEPTH + 2) * WIDTH
    if LAYER == 0:
        return _first_turns(points, floats, unit, WIDTH, IN)
    else:
        z = _product(
            points,
            scratch + ((LAYER - 1) % 2) * 2 * ROWS * WIDTH,
            floats,
            halves + (LAYER - 1) * 2 * WIDTH * WIDTH,
            unit,
            LAYER == 1 and WIDTH == COLUMNS,
            False,
            ROWS,
            COLUMNS,
            IN,
            WIDTH,
            SHAPE[3],
        )
        bias = tl.load(floats + (IN + LAYER) * WIDTH + unit)
        return z * tl.load(floats + NUMBERS + 1 + LAYER) + bias[None, :]


@triton.jit
def value_of_tile(
    points, floats, halves, kept, scratch,
    SHAPE: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr,
):  # fmt: skip
    """F of a tile, (ROWS,)."""
    WIDTH: tl.constexpr = SHAPE[0]
    DEPTH: tl.constexpr = SHAPE[1]
    COLUMNS: tl.constexpr = SHAPE[2]
    BLOCKS: tl.constexpr = WIDTH // COLUMNS
    PLANE: tl.constexpr = ROWS * WIDTH
    OUTPUT: tl.constexpr = (IN + DEPTH) * WIDTH
    row = tl.arange(0, ROWS)
    value = tl.zeros((ROWS,), tl.float32)
    for layer in tl.static_range(DEPTH):
        if layer == DEPTH - 1 or layer > 0 or BLOCKS > 1:  # else the next product makes this layer itself
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                if len(kept) > 0:
                    turns = _kept_turns(points, floats, kept, ROWS, IN, WIDTH)
                else:
                    turns = _turns(points, floats, halves, scratch, unit, layer, SHAPE, ROWS, IN)
                if layer == DEPTH - 1:
                    value += tl.sum(sine(turns) * tl.load(floats + OUTPUT + unit)[None, :], axis=1)
                else:
                    cell = row[:, None] * WIDTH + unit[None, :]
                    _store_halves(scratch + (layer % 2) * 2 * PLANE, cell, sine(turns, SCALE), PLANE)
            if layer < DEPTH - 1:
                tl.debug_barrier()  # what one thread put aside, others read
    if BLOCKS > 1 or DEPTH > 2:
        tl.debug_barrier()  # the next tile writes where this one was read
    return value + tl.load(floats + OUTPUT + 2 * WIDTH)


@triton.jit
def jet_of_tile(
    points, floats, halves, scratch,
    SHAPE: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr,
):  # fmt: skip
    """F of a tile (ROWS,), and its gradient, a tuple of IN columns (ROWS,); by both sweeps.

    As in `siren.py`, without the 2π of each layer: s_d = w cos 2πτ_d, s_i = (s_{i+1} M_{i+1}ᵀ) cos 2πτ_i and
    ∇f = (2π)^d s_1 M_1ᵀ.
    """
    WIDTH: tl.constexpr = SHAPE[0]
    DEPTH: tl.constexpr = SHAPE[1]
    COLUMNS: tl.constexpr = SHAPE[2]
    PIECE: tl.constexpr = SHAPE[3]
    BLOCKS: tl.constexpr = WIDTH // COLUMNS
    PLANE: tl.constexpr = ROWS * WIDTH
    OUTPUT: tl.constexpr = (IN + DEPTH) * WIDTH
    NUMBERS: tl.constexpr = OUTPUT + 2 * WIDTH
    DIRECT: tl.constexpr = DEPTH == 2 and BLOCKS == 1
    row = tl.arange(0, ROWS)
    value = tl.zeros((ROWS,), tl.float32)
    for layer in tl.static_range(DEPTH - 1):  # up, but for the last
        if layer > 0 or BLOCKS > 1:
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                cell = row[:, None] * WIDTH + unit[None, :]
                turns = _turns(points, floats, halves, scratch, unit, layer, SHAPE, ROWS, IN)
                _store_halves(scratch + (layer % 2) * 2 * PLANE, cell, sine(turns, SCALE), PLANE)
                if layer > 0:
                    _store_halves(scratch + (1 + layer) * 2 * PLANE, cell, cosine(turns, SCALE), PLANE)
            tl.debug_barrier()

    gradient = ()
    for _ in tl.static_range(IN):
        gradient = gradient + (tl.zeros((ROWS,), tl.float32),)
    for block in range(BLOCKS):  # the last layer, there and back
        unit = block * COLUMNS + tl.arange(0, COLUMNS)
        turns = _turns(points, floats, halves, scratch, unit, DEPTH - 1, SHAPE, ROWS, IN)
        sines, cosines = sine_cosine(turns)
        value += tl.sum(sines * tl.load(floats + OUTPUT + unit)[None, :], axis=1)
        if DEPTH == 1:
            s = cosines * tl.load(floats + OUTPUT + unit)[None, :]
            gradient = _add_first(gradient, s, floats, unit, WIDTH, IN)
        else:
            s = cosines * tl.load(floats + OUTPUT + WIDTH + unit)[None, :]
            if DIRECT:
                gradient = _down(points, s, floats, halves, ROWS, IN, WIDTH, PIECE)
            else:
                cell = row[:, None] * WIDTH + unit[None, :]
                _store_halves(scratch + ((DEPTH - 1) % 2) * 2 * PLANE, cell, s, PLANE)

    if DEPTH > 1 and not DIRECT:
        for layer in tl.static_range(DEPTH - 2, -1, -1):  # s of this layer from that of the layer above
            tl.debug_barrier()
            above = scratch + ((layer + 1) % 2) * 2 * PLANE
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                matrix = halves + layer * 2 * WIDTH * WIDTH
                g = _product(
                    points, above, floats, matrix, unit, False, True, ROWS, COLUMNS, IN, WIDTH, PIECE
                )  # fmt: skip
                if layer == 0:
                    s = g * cosine(_first_turns(points, floats, unit, WIDTH, IN))
                    gradient = _add_first(gradient, s, floats, unit, WIDTH, IN)
                else:
                    cell = row[:, None] * WIDTH + unit[None, :]
                    kept = scratch + (1 + layer) * 2 * PLANE + cell
                    c = tl.load(kept).to(tl.float32) + tl.load(kept + PLANE).to(tl.float32)
                    s = g * c * (tl.load(floats + NUMBERS + 1 + DEPTH + layer) / SCALE)
                    _store_halves(scratch + (layer % 2) * 2 * PLANE, cell, s, PLANE)
        tl.debug_barrier()  # the next tile writes where this one was read

    scale = tl.load(floats + NUMBERS + 1)
    if DEPTH > 1:
        scale = scale * tl.load(floats + NUMBERS + 1 + DEPTH)
    scaled = ()
    for axis in tl.static_range(IN):
        scaled = scaled + (gradient[axis] * scale,)
    return value + tl.load(floats + NUMBERS), scaled


@triton.jit
def _down(
    points, s, floats, halves,
    ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr, PIECE: tl.constexpr,
):  # fmt: skip
    """From s₂ in registers to s₁M₁ᵀ, IN columns, piece by piece of the first layer."""
    unit = tl.arange(0, WIDTH)
    high, low = halves_of(s)
    gradient = ()
    for _ in tl.static_range(IN):
        gradient = gradient + (tl.zeros((ROWS,), tl.float32),)
    for first in range(0, WIDTH, PIECE):
        inner = first + tl.arange(0, PIECE)
        g = tl.zeros((ROWS, PIECE), tl.float32)
        g = _add_product(g, high, low, halves, unit, inner, WIDTH, True)
        g = g * cosine(_first_turns(points, floats, inner, WIDTH, IN))
        gradient = _add_first(gradient, g, floats, inner, WIDTH, IN)
    return gradient


@triton.jit
def _add_first(gradient, s, floats, unit, WIDTH: tl.constexpr, IN: tl.constexpr):
    """A gradient, IN columns, with the share of some units of the first layer, s₁M₁ᵀ."""
    added = ()
    for axis in tl.static_range(IN):
        column = tl.load(floats + axis * WIDTH + unit)
        added = added + (gradient[axis] + tl.sum(s * column[None, :], axis=1),)
    return added
