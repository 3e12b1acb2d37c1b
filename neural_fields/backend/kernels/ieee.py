"""Value and gradient of a SIREN in one launch, with products in IEEE float32, for training."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from .launch import Network, on_device, program_count, scratch_for, tiling_of
from .tensor_tiles import points_of, rows_of
from .tiles import jet_of_tile, planes


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
                scratch_for(x, programs, kept * tiling.rows * tiling.stride(network.width)),
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
