"""Value and gradient of a network of any width for a tile of points, in IEEE float32.

A tile is a matrix of ROWS points. Products are made COLUMNS units at a time, in an accumulator (ROWS, COLUMNS) in
registers, PIECE inner units after PIECE. Where it is as wide as the network (up to 128 units), less is kept.
The first sine layer is never kept: each piece of it is made from the points when a product needs it.
The last one goes from its accumulator into the output's sum.
The first layer's cosines are made again from the points for the end of the sweep back.

Other matrices lie in a scratch of the program's own: `planes` of ROWS times its width. Layer i is in plane i mod 2 on
both sweeps; the cosines of the layers between first and last follow. Products read a plane piece by piece, in a loop:
an unrolled one would spill thousands of bytes of registers. Units beyond the width have weights and biases of 0.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import triton
import triton.language as tl
from triton.language.extra import libdevice

# The interpreter runs kernels with numpy and has no libdevice; its sine is numpy's.
INTERPRETED = tl.constexpr(bool(triton.knobs.runtime.interpret))


def planes(depth: int) -> int:
    """Number of matrices of ROWS points in a program's scratch."""
    return max(2, depth)


@triton.jit
def sine(z):
    """Sin z, to two units in the last place for any z, by CUDA's libdevice (``sin.approx`` loses digits with z)."""
    if INTERPRETED:
        return tl.sin(z)
    else:
        return libdevice.sin(z)


@triton.jit
def cosine(z):
    """Cos z, as `sine`."""
    if INTERPRETED:
        return tl.cos(z)
    else:
        return libdevice.cos(z)


@triton.jit
def first_phase(points, weight, bias, unit, omega, WIDTH: tl.constexpr, IN: tl.constexpr):
    """ω₀(W₁x + b₁) for some units; too few inner columns for ``tl.dot``, which wants 16."""
    real = unit < WIDTH
    z = tl.load(bias + unit, mask=real, other=0.0)[None, :]
    for axis in tl.static_range(IN):
        column = tl.load(weight + unit * IN + axis, mask=real, other=0.0)
        z += points[axis][:, None] * column[None, :]
    return omega * z


@triton.jit
def product_from(
    plane, z, weight, unit,
    WIDTH: tl.constexpr, STRIDE: tl.constexpr, PIECE: tl.constexpr, TRANSPOSED: tl.constexpr,
):  # fmt: skip
    """Z + P Wᵀ (``TRANSPOSED``: on the way up) or z + P W (on the way back) for some units, P a plane."""
    row = tl.arange(0, z.shape[0])
    for first in range(0, WIDTH, PIECE):
        inner = first + tl.arange(0, PIECE)
        kept = tl.load(plane + row[:, None] * STRIDE + inner[None, :])
        real = (inner < WIDTH)[:, None] & (unit < WIDTH)[None, :]
        if TRANSPOSED:
            matrix = tl.load(weight + unit[None, :] * WIDTH + inner[:, None], mask=real, other=0.0)
        else:
            matrix = tl.load(weight + inner[:, None] * WIDTH + unit[None, :], mask=real, other=0.0)
        z = tl.dot(kept, matrix, z, input_precision="ieee")
    return z


@triton.jit
def _second_from_points(
    points, z, parameters, unit, omega,
    WIDTH: tl.constexpr, IN: tl.constexpr, PIECE: tl.constexpr,
):  # fmt: skip
    """Z + h₁W₂ᵀ for some units, each piece of h₁ made on the way."""
    for first in range(0, WIDTH, PIECE):
        inner = first + tl.arange(0, PIECE)
        h = sine(first_phase(points, parameters[0], parameters[1], inner, omega, WIDTH, IN))
        real = (inner < WIDTH)[:, None] & (unit < WIDTH)[None, :]
        matrix = tl.load(parameters[2] + unit[None, :] * WIDTH + inner[:, None], mask=real, other=0.0)
        z = tl.dot(h, matrix, z, input_precision="ieee")
    return z


@triton.jit
def _phase(
    points, parameters, scratch, unit, omega,
    LAYER: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr, STRIDE: tl.constexpr,
    COLUMNS: tl.constexpr, PIECE: tl.constexpr,
):  # fmt: skip
    """The phases ω₀(W h + b) of some units of a layer, counted from 0, whose layer below is kept or easily made."""
    if LAYER == 0:
        return first_phase(points, parameters[0], parameters[1], unit, omega, WIDTH, IN)
    else:
        bias = tl.load(parameters[2 * LAYER + 1] + unit, mask=unit < WIDTH, other=0.0)
        z = tl.zeros((ROWS, COLUMNS), tl.float32) + bias[None, :]
        if LAYER == 1 and STRIDE == COLUMNS:
            z = _second_from_points(points, z, parameters, unit, omega, WIDTH, IN, PIECE)
        else:
            below = scratch + ((LAYER - 1) % 2) * ROWS * STRIDE
            z = product_from(below, z, parameters[2 * LAYER], unit, WIDTH, STRIDE, PIECE, True)
        return omega * z


@triton.jit
def jet_of_tile(
    points, parameters, scratch, omega, gain,
    ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr, COLUMNS: tl.constexpr,
    PIECE: tl.constexpr,
):  # fmt: skip
    """F of a tile (ROWS,), and its gradient, a tuple of IN columns (ROWS,); both sweeps.

    As in `siren.py`, with ω₀ beside the cosines: s_i = g_i ⊙ ω₀ cos ω₀z_i, g_{i−1} = s_i W_i. ``points`` is a tuple of
    IN columns, ``parameters`` pointers (W₁, b₁, …, w_out, b_out) without ω₀, ``scratch`` has `planes` times ROWS times
    the padded width; ``omega`` and ``gain`` are those of `Network`, the constants those of `Tiling`.
    """
    BLOCKS: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS
    STRIDE: tl.constexpr = BLOCKS * COLUMNS
    PLANE: tl.constexpr = ROWS * STRIDE
    row = tl.arange(0, ROWS)
    value = tl.zeros((ROWS,), tl.float32)
    for layer in tl.static_range(DEPTH - 1):  # up, but for the last
        if layer > 0 or BLOCKS > 1:
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                cell = row[:, None] * STRIDE + unit[None, :]
                z = _phase(
                    points, parameters, scratch, unit, omega,
                    layer, ROWS, IN, WIDTH, STRIDE, COLUMNS, PIECE,
                )  # fmt: skip
                tl.store(scratch + (layer % 2) * PLANE + cell, sine(z))
                if layer > 0:
                    tl.store(scratch + (1 + layer) * PLANE + cell, omega * cosine(z))
            tl.debug_barrier()

    gradient = ()
    for _ in tl.static_range(IN):
        gradient = gradient + (tl.zeros((ROWS,), tl.float32),)
    for block in range(BLOCKS):  # the last layer, there and back
        unit = block * COLUMNS + tl.arange(0, COLUMNS)
        z = _phase(
            points, parameters, scratch, unit, omega,
            DEPTH - 1, ROWS, IN, WIDTH, STRIDE, COLUMNS, PIECE,
        )  # fmt: skip
        last = gain * tl.load(parameters[2 * DEPTH] + unit, mask=unit < WIDTH, other=0.0)
        value += tl.sum(sine(z) * last[None, :], axis=1)
        s = last[None, :] * (omega * cosine(z))
        if DEPTH == 1:
            gradient = add_first(gradient, s, parameters[0], unit, WIDTH, IN)
        else:
            tl.store(scratch + ((DEPTH - 1) % 2) * PLANE + row[:, None] * STRIDE + unit[None, :], s)
    tl.debug_barrier()

    for layer in tl.static_range(DEPTH - 2, -1, -1):  # s of this layer from that of the layer above
        for block in range(BLOCKS):
            unit = block * COLUMNS + tl.arange(0, COLUMNS)
            cell = row[:, None] * STRIDE + unit[None, :]
            above = scratch + ((layer + 1) % 2) * PLANE
            g = tl.zeros((ROWS, COLUMNS), tl.float32)
            g = product_from(above, g, parameters[2 * layer + 2], unit, WIDTH, STRIDE, PIECE, False)
            if layer == 0:
                s = g * (omega * cosine(first_phase(points, parameters[0], parameters[1], unit, omega, WIDTH, IN)))
                gradient = add_first(gradient, s, parameters[0], unit, WIDTH, IN)
            else:
                tl.store(scratch + (layer % 2) * PLANE + cell, g * tl.load(scratch + (1 + layer) * PLANE + cell))
        tl.debug_barrier()
    return value + gain * tl.load(parameters[2 * DEPTH + 1]), gradient


@triton.jit
def add_first(gradient, s, weight, unit, WIDTH: tl.constexpr, IN: tl.constexpr):
    """A gradient, IN columns, with the share of some units of the first layer, s₁W₁."""
    added = ()
    for axis in tl.static_range(IN):
        column = tl.load(weight + unit * IN + axis, mask=unit < WIDTH, other=0.0)
        added = added + (gradient[axis] + tl.sum(s * column[None, :], axis=1),)
    return added
