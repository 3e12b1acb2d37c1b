"""Cones for tiles of an image, all of one size in one launch: `tracing.cones.cone_starts`."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false
# pyright: reportOperatorIssue=false

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .launch import half_scratch, launch
from .packing import Packed
from .tensor_tiles import keep, rows_of, value_of_tile


@triton.jit(do_not_specialize=["count", "max_steps"])
def march(
    origin, axes, spreads, leaves, depths, margin, free, floats, halves, scratch, count, max_steps, lipschitz,
    SHAPE: tl.constexpr, SCRATCH: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Every program marches a tile of cones until all have stopped, then the next of its own."""
    infinite = float("inf")
    own = scratch + tl.cast(tl.program_id(0), tl.int64) * SCRATCH
    kept = keep(halves, SHAPE)
    ox, oy, oz = tl.load(origin), tl.load(origin + 1), tl.load(origin + 2)
    delta = tl.load(margin)
    for tile in range(tl.program_id(0), tl.cdiv(count, ROWS), tl.num_programs(0)):
        row = rows_of(tile, ROWS)
        real = row < count
        dx = tl.load(axes + row * 3, mask=real, other=0.0)
        dy = tl.load(axes + row * 3 + 1, mask=real, other=0.0)
        dz = tl.load(axes + row * 3 + 2, mask=real, other=0.0)
        sigma = tl.load(spreads + row, mask=real, other=0.0)
        leave = tl.load(leaves + row, mask=real, other=0.0)
        depth = tl.load(depths + row, mask=real, other=infinite)
        before, value_before = depth, tl.zeros((ROWS,), tl.float32)
        on = (depth < infinite).to(tl.int32)
        left, steps = tl.sum(on, axis=0), tl.full((), 0, tl.int32)
        while left > 0:
            t = tl.where(on > 0, depth, 0.0)
            points = (ox + t * dx, oy + t * dy, oz + t * dz)
            value = value_of_tile(points, floats, halves, kept, own, SHAPE, ROWS, 3)
            passed = value * value_before < 0
            step = ((tl.abs(value) - delta) / lipschitz - t * sigma) / (1 + sigma)
            ahead = tl.where(passed, before, t + tl.maximum(step, 0.0))
            depth = tl.where(on > 0, tl.where(ahead >= leave, infinite, ahead), depth)
            before, value_before = tl.where(on > 0, t, before), tl.where(on > 0, value, value_before)
            on = tl.where((step > t * sigma) & (ahead < leave) & (passed == 0), on, 0)
            steps += 1
            left = tl.where(steps < max_steps, tl.sum(on, axis=0), 0)
        tl.store(free + row, depth, mask=real)


def march_cones(
    network: Packed,
    cones: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    margin: Tensor,
    lipschitz: float,
    max_steps: int,
) -> Tensor:
    """How far each cone is empty ``(C,)``, infinite where it leaves untouched.

    ``cones`` are their common origin ``(3,)``; axes ``(C, 3)``, spreads ``(C,)``, where they leave the ball of the
    surface, and where they begin, infinite for those that never enter. ``margin`` is their distance from the surface,
    on the device.
    """
    origin, axes, spreads, leaves, depths = (part.contiguous() for part in cones)
    free = torch.empty_like(depths)
    if len(axes):
        rows = network.shape.rows
        kept = network.shape.scratch(rows, jet=False)
        launch(
            march,
            axes,
            triton.cdiv(len(axes), rows),
            lambda programs: (
                origin, axes, spreads, leaves, depths, margin, free, network.floats, network.halves,
                half_scratch(axes, programs * kept), len(axes), max_steps, float(lipschitz),
            ),
            SHAPE=tuple(network.shape),
            SCRATCH=kept,
            ROWS=rows,
            warps=rows // 16,
        )  # fmt: skip
    return free
