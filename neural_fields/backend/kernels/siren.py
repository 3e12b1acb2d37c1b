"""Value, or value and gradient, of a SIREN in one launch, without a graph."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from .launch import half_scratch, launch
from .packing import Packed
from .tensor_tiles import jet_of_tile, keep, points_of, rows_of, value_of_tile


@triton.jit(do_not_specialize=["count"])
def evaluate(
    x, floats, halves, value, gradient, scratch, count,
    JET: tl.constexpr, SHAPE: tl.constexpr, SCRATCH: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr,
):  # fmt: skip
    """Every program takes tiles from its own number on, in steps of the number of programs."""
    own = scratch + tl.program_id(0).to(tl.int64) * SCRATCH
    kept = ()
    if not JET:
        kept = keep(halves, SHAPE)
    for tile in range(tl.program_id(0), tl.cdiv(count, ROWS), tl.num_programs(0)):
        row = rows_of(tile, ROWS)
        real = row < count
        points = points_of(x, row, real, IN)
        if JET:
            f, slope = jet_of_tile(points, floats, halves, own, SHAPE, ROWS, IN)
            for axis in tl.static_range(IN):
                tl.store(gradient + row * IN + axis, slope[axis], mask=real)
        else:
            f = value_of_tile(points, floats, halves, kept, own, SHAPE, ROWS, IN)
        tl.store(value + row, f, mask=real)


def siren_value(x: Tensor, network: Packed) -> Tensor:
    """F at float32 points ``(N, d)`` → ``(N,)``; N may be 0."""
    value = x.new_empty(len(x))
    _launch(x, network, value, value, jet=False)
    return value


def siren_jet(x: Tensor, network: Packed) -> tuple[Tensor, Tensor]:
    """F and its gradient at points ``(N, d)`` → ``(N,)``, ``(N, d)``."""
    value, gradient = x.new_empty(len(x)), x.new_empty(x.shape)
    _launch(x, network, value, gradient, jet=True)
    return value, gradient


def _launch(x: Tensor, network: Packed, value: Tensor, gradient: Tensor, *, jet: bool) -> None:
    if not len(x):
        return
    x, rows = x.contiguous(), network.shape.rows
    kept = network.shape.scratch(rows, jet=jet)
    launch(
        evaluate,
        x,
        triton.cdiv(len(x), rows),
        lambda programs: (x, network.floats, network.halves, value, gradient, half_scratch(x, programs * kept), len(x)),
        JET=jet,
        SHAPE=tuple(network.shape),
        SCRATCH=kept,
        ROWS=rows,
        IN=x.shape[1],
        warps=rows // 16,
    )
