"""The jet of a SIREN in IEEE float32 for training, and its backward pass, in one launch each.

The backward pass maps cotangents of value and gradient to those of points, weights and biases.

Let f̄ and ḡ be the cotangents of f and ∇f, with φ_i = ω₀(W_i h_{i−1} + b_i), c_i = ω₀ cos φ_i and s_i = g_i ⊙ c_i as in
`tiles.py`. The sweep back is linear in ḡ, and its adjoint is one tangent forward:

    u_0 = ḡ,   v_i = u_{i−1} W_iᵀ,   u_i = v_i ⊙ c_i.

The adjoint of the value adds what the tangent meets of the cosines' derivative:

    h̄_d = f̄ w,   z̄_i = h̄_i ⊙ c_i − ω₀² v_i ⊙ g_i ⊙ sin φ_i,   h̄_{i−1} = z̄_i W_i,   x̄ = h̄_0,
    W̄_i = Σ s_iᵀ u_{i−1} + z̄_iᵀ h_{i−1},   b̄_i = Σ z̄_i,   w̄ = Σ u_d + f̄ h_d.

Only the points are kept from the forward pass. Sweeps up and back are made again, tile by tile, into five planes for
each layer (h, c, g, s, u; z̄ takes the place of g). Each program sums over its points, and the sums are added in order.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from .launch import Network, Tiling, on_device, program_count, tiling_of
from .tensor_tiles import points_of, rows_of
from .tiles import add_first, cosine, first_phase, jet_of_tile, planes, product_from, sine


@triton.jit(do_not_specialize=["count"])
def evaluate(
    x, parameters, value, gradient, scratch, count, omega, gain,
    PLANES: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr,
    COLUMNS: tl.constexpr, PIECE: tl.constexpr,
):  # fmt: skip
    """Every program takes tiles from its own number on, in steps of the number of programs."""
    STRIDE: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS * COLUMNS
    own = scratch + tl.program_id(0).to(tl.int64) * (PLANES * ROWS * STRIDE)
    for tile in range(tl.program_id(0), tl.cdiv(count, ROWS), tl.num_programs(0)):
        row = rows_of(tile, ROWS)
        real = row < count
        points = points_of(x, row, real, IN)
        f, slope = jet_of_tile(points, parameters, own, omega, gain, ROWS, IN, WIDTH, DEPTH, COLUMNS, PIECE)
        for axis in tl.static_range(IN):
            tl.store(gradient + row * IN + axis, slope[axis], mask=real)
        tl.store(value + row, f, mask=real)


def jet(x: Tensor, network: Network) -> tuple[Tensor, Tensor]:
    """F and its gradient at float32 points ``(N, d)`` → ``(N,)``, ``(N, d)``; N may be 0."""
    value, gradient = x.new_empty(len(x)), x.new_empty(x.shape)
    if len(x):
        tiling = tiling_of(network.width)
        programs = program_count(x.device, triton.cdiv(len(x), tiling.rows))
        kept = planes(network.depth)
        with on_device(x):
            evaluate[(programs,)](  # pyright: ignore[reportIndexIssue]
                x.contiguous(),
                network.parameters,
                value,
                gradient,
                x.new_empty(programs * kept * tiling.rows * tiling.stride(network.width)),
                len(x),
                network.omega,
                network.gain,
                PLANES=kept,
                ROWS=tiling.rows,
                IN=x.shape[1],
                WIDTH=network.width,
                DEPTH=network.depth,
                COLUMNS=tiling.columns,
                PIECE=tiling.piece,
                num_warps=tiling.warps,
                num_stages=2,
            )
    return value, gradient


@triton.jit(do_not_specialize=["count"])
def sweep(
    x, parameters, value_bar, gradient_bar, x_bar, sums, scratch, count, omega, gain,
    ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr, COLUMNS: tl.constexpr,
    PIECE: tl.constexpr,
):  # fmt: skip
    """Every program takes tiles in turn, and adds their share of the weights' cotangents to sums of its own."""
    BLOCKS: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS
    STRIDE: tl.constexpr = BLOCKS * COLUMNS
    PLANE: tl.constexpr = ROWS * STRIDE
    SLOPES: tl.constexpr = DEPTH * PLANE
    BACK: tl.constexpr = 2 * DEPTH * PLANE
    SWEPT: tl.constexpr = 3 * DEPTH * PLANE
    TANGENTS: tl.constexpr = 4 * DEPTH * PLANE
    SUMS: tl.constexpr = WIDTH * (IN + 1) + (DEPTH - 1) * WIDTH * (WIDTH + 1) + WIDTH + 1
    kept = scratch + tl.cast(tl.program_id(0), tl.int64) * (5 * DEPTH * PLANE)
    own = sums + tl.cast(tl.program_id(0), tl.int64) * SUMS
    line = tl.arange(0, ROWS)
    for tile in range(tl.program_id(0), tl.cdiv(count, ROWS), tl.num_programs(0)):
        row = rows_of(tile, ROWS)
        real = row < count
        points = points_of(x, row, real, IN)
        cotangents = points_of(gradient_bar, row, real, IN)
        f_bar = tl.load(value_bar + row, mask=real, other=0.0)

        for layer in tl.static_range(DEPTH):  # up
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                cell = kept + layer * PLANE + line[:, None] * STRIDE + unit[None, :]
                if layer == 0:
                    z = first_phase(points, parameters[0], parameters[1], unit, omega, WIDTH, IN)
                else:
                    bias = tl.load(parameters[2 * layer + 1] + unit, mask=unit < WIDTH, other=0.0)
                    z = tl.zeros((ROWS, COLUMNS), tl.float32) + bias[None, :]
                    below = kept + (layer - 1) * PLANE
                    weight = parameters[2 * layer]
                    z = omega * product_from(below, z, weight, unit, WIDTH, STRIDE, PIECE, True)
                tl.store(cell, sine(z))
                tl.store(cell + SLOPES, omega * cosine(z))
            tl.debug_barrier()

        for layer in tl.static_range(DEPTH - 1, -1, -1):  # back
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                cell = kept + layer * PLANE + line[:, None] * STRIDE + unit[None, :]
                g = tl.zeros((ROWS, COLUMNS), tl.float32)
                if layer == DEPTH - 1:
                    g += gain * tl.load(parameters[2 * DEPTH] + unit, mask=unit < WIDTH, other=0.0)[None, :]
                else:
                    above, weight = kept + SWEPT + (layer + 1) * PLANE, parameters[2 * layer + 2]
                    g = product_from(above, g, weight, unit, WIDTH, STRIDE, PIECE, False)
                tl.store(cell + BACK, g)
                tl.store(cell + SWEPT, g * tl.load(cell + SLOPES))
            tl.debug_barrier()

        for layer in tl.static_range(DEPTH):  # the tangent
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                cell = kept + layer * PLANE + line[:, None] * STRIDE + unit[None, :]
                v = tl.zeros((ROWS, COLUMNS), tl.float32)
                if layer == 0:
                    for axis in tl.static_range(IN):
                        column = tl.load(parameters[0] + unit * IN + axis, mask=unit < WIDTH, other=0.0)
                        v += cotangents[axis][:, None] * column[None, :]
                else:
                    below, weight = kept + TANGENTS + (layer - 1) * PLANE, parameters[2 * layer]
                    v = product_from(below, v, weight, unit, WIDTH, STRIDE, PIECE, True)
                tl.store(cell + TANGENTS, v * tl.load(cell + SLOPES))
                bent = tl.load(cell + BACK) * tl.load(cell)
                tl.store(cell + BACK, -(omega * omega) * v * bent)
            tl.debug_barrier()

        points_bar = ()
        for _ in tl.static_range(IN):
            points_bar = points_bar + (tl.zeros((ROWS,), tl.float32),)
        for layer in tl.static_range(DEPTH - 1, -1, -1):  # the adjoint of the value
            for block in range(BLOCKS):
                unit = block * COLUMNS + tl.arange(0, COLUMNS)
                cell = kept + layer * PLANE + line[:, None] * STRIDE + unit[None, :]
                h_bar = tl.zeros((ROWS, COLUMNS), tl.float32)
                if layer == DEPTH - 1:
                    last = gain * tl.load(parameters[2 * DEPTH] + unit, mask=unit < WIDTH, other=0.0)
                    h_bar += f_bar[:, None] * last[None, :]
                else:
                    above, weight = kept + BACK + (layer + 1) * PLANE, parameters[2 * layer + 2]
                    h_bar = product_from(above, h_bar, weight, unit, WIDTH, STRIDE, PIECE, False)
                z_bar = h_bar * tl.load(cell + SLOPES) + tl.load(cell + BACK)
                tl.store(cell + BACK, z_bar)
                if layer == 0:
                    points_bar = add_first(points_bar, z_bar, parameters[0], unit, WIDTH, IN)
            tl.debug_barrier()
        for axis in tl.static_range(IN):
            tl.store(x_bar + row * IN + axis, points_bar[axis], mask=real)

        _add_ends(own, kept, points, cotangents, f_bar, gain, ROWS, IN, WIDTH, DEPTH, COLUMNS)
        for layer in tl.static_range(1, DEPTH):
            target = own + WIDTH * (IN + 1) + (layer - 1) * WIDTH * (WIDTH + 1)
            _add_products(target, kept + layer * PLANE, ROWS, WIDTH, DEPTH, COLUMNS, PIECE)
        tl.debug_barrier()


@triton.jit
def _add_ends(
    own, kept, points, cotangents, f_bar, gain,
    ROWS: tl.constexpr, IN: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Add a tile's share to the first layer and to the output."""
    BLOCKS: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS
    STRIDE: tl.constexpr = BLOCKS * COLUMNS
    PLANE: tl.constexpr = ROWS * STRIDE
    OUTPUT: tl.constexpr = WIDTH * (IN + 1) + (DEPTH - 1) * WIDTH * (WIDTH + 1)
    line = tl.arange(0, ROWS)
    for block in range(BLOCKS):
        unit = block * COLUMNS + tl.arange(0, COLUMNS)
        inside = unit < WIDTH
        first = kept + line[:, None] * STRIDE + unit[None, :]
        s, z_bar = tl.load(first + 3 * DEPTH * PLANE), tl.load(first + 2 * DEPTH * PLANE)
        for axis in tl.static_range(IN):
            found = tl.sum(s * cotangents[axis][:, None] + z_bar * points[axis][:, None], axis=0)
            _add(own + unit * IN + axis, found, inside)
        _add(own + WIDTH * IN + unit, tl.sum(z_bar, axis=0), inside)
        last = first + (DEPTH - 1) * PLANE
        u, h = tl.load(last + 4 * DEPTH * PLANE), tl.load(last)
        _add(own + OUTPUT + unit, gain * tl.sum(u + f_bar[:, None] * h, axis=0), inside)
    target = own + OUTPUT + WIDTH
    tl.store(target, tl.load(target) + gain * tl.sum(f_bar, axis=0))


@triton.jit
def _add_products(
    target, layer,
    ROWS: tl.constexpr, WIDTH: tl.constexpr, DEPTH: tl.constexpr, COLUMNS: tl.constexpr, PIECE: tl.constexpr,
):  # fmt: skip
    """Add a tile's share to a square layer: sᵀ u + z̄ᵀ h, with u and h of the layer below, and the sum of z̄."""
    BLOCKS: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS
    STRIDE: tl.constexpr = BLOCKS * COLUMNS
    PLANE: tl.constexpr = ROWS * STRIDE
    SIDE: tl.constexpr = COLUMNS if COLUMNS < 64 else 64
    for block in range(STRIDE // SIDE):
        unit = block * SIDE + tl.arange(0, SIDE)
        whole = tl.arange(0, ROWS)[:, None] * STRIDE + unit[None, :]
        _add(target + WIDTH * WIDTH + unit, tl.sum(tl.load(layer + 2 * DEPTH * PLANE + whole), axis=0), unit < WIDTH)
        for other in range(STRIDE // SIDE):
            inner = other * SIDE + tl.arange(0, SIDE)
            found = tl.zeros((SIDE, SIDE), tl.float32)
            for first in range(0, ROWS, PIECE):
                line = first + tl.arange(0, PIECE)
                left = layer + line[None, :] * STRIDE + unit[:, None]
                right = layer - PLANE + line[:, None] * STRIDE + inner[None, :]
                s, u = tl.load(left + 3 * DEPTH * PLANE), tl.load(right + 4 * DEPTH * PLANE)
                found = tl.dot(s, u, found, input_precision="ieee")
                z_bar, h = tl.load(left + 2 * DEPTH * PLANE), tl.load(right)
                found = tl.dot(z_bar, h, found, input_precision="ieee")
            _add(
                target + unit[:, None] * WIDTH + inner[None, :],
                found,
                (unit < WIDTH)[:, None] & (inner < WIDTH)[None, :],
            )


@triton.jit
def _add(target, found, inside):
    """Add to sums that no other program touches."""
    tl.store(target, tl.load(target, mask=inside, other=0.0) + found, mask=inside)


def jet_backward(x: Tensor, network: Network, value_bar: Tensor, gradient_bar: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Cotangents of the points ``(N, d)`` and of the parameters of a network of one output, in their order and shapes.

    ``value_bar`` ``(N,)`` and ``gradient_bar`` ``(N, d)`` are the cotangents of f and ∇f.
    """
    x_bar = x.new_empty(x.shape)
    sizes = [parameter.numel() for parameter in network.parameters]
    tiling = _tiling(network.width)
    tiles = triton.cdiv(len(x), tiling.rows)
    # All sums of weights together are at most 256 MiB; wide networks get fewer programs for it.
    programs = max(1, min(program_count(x.device, tiles), (1 << 26) // sum(sizes)))
    sums = x.new_zeros(programs, sum(sizes))
    # Planes of a layer: sines, slopes ω₀ cos, the sweep back before them (then z̄) and after them, the tangent.
    kept = 5 * network.depth * tiling.rows * tiling.stride(network.width)
    if tiles:
        with on_device(x):
            sweep[(programs,)](  # pyright: ignore[reportIndexIssue]
                x.contiguous(),
                network.parameters,
                value_bar.contiguous(),
                gradient_bar.contiguous(),
                x_bar,
                sums,
                x.new_empty(programs * kept),
                len(x),
                network.omega,
                network.gain,
                ROWS=tiling.rows,
                IN=x.shape[1],
                WIDTH=network.width,
                DEPTH=network.depth,
                COLUMNS=tiling.columns,
                PIECE=tiling.piece,
                num_warps=tiling.warps,
                num_stages=2,
            )
    parts = sums.sum(dim=0).split(sizes)
    return x_bar, [part.reshape(like.shape) for part, like in zip(parts, network.parameters, strict=True)]


def _tiling(width: int) -> Tiling:
    """As for a jet, with half the rows where there are many units: ten planes and more are to stay in the cache."""
    tiling = tiling_of(width)
    return tiling._replace(rows=32) if width > 128 else tiling
