"""Cones for tiles of an image, all of one size in one launch: `mplicits.neural_fields.cones.cone_starts`."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false
# pyright: reportOperatorIssue=false

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from .launch import Network, on_device, program_count, scratch_for, tiling_of
from .tiles import planes, rows_of, value_of_tile

__all__ = ["march_cones"]


@triton.jit(do_not_specialize=["count", "max_steps"])
def march(
    origin,
    axes,
    spreads,
    leaves,
    depths,
    margin,
    free,
    parameters,
    scratch,
    count,
    max_steps,
    lipschitz,
    omega,
    gain,
    PLANES: tl.constexpr,
    ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
    DEPTH: tl.constexpr,
    COLUMNS: tl.constexpr,
    PIECE: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Every program marches a tile of cones until all have stopped, then the next of its own."""
    STRIDE: tl.constexpr = (WIDTH + COLUMNS - 1) // COLUMNS * COLUMNS
    infinite = float("inf")
    own = scratch + tl.cast(tl.program_id(0), tl.int64) * (PLANES * ROWS * STRIDE)
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
            value = value_of_tile(
                points, parameters, own, omega, gain, ROWS, 3, WIDTH, DEPTH, COLUMNS, PIECE, PRECISION
            )
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
    network: Network,
    cones: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    margin: Tensor,
    lipschitz: float,
    max_steps: int,
    precision: str,
) -> Tensor:
    """How far each cone is empty ``(C,)``, infinite where it leaves untouched.

    Args:
        network: level 0, on the cones' device.
        cones: their common origin ``(3,)``; of each its axis ``(C, 3)``, its spread ``(C,)``, where it leaves the ball
            of the surface, and where it begins, infinite for those that never enter.
        margin: how far they keep from the surface, a number on the same device.
        lipschitz: see `mplicits.neural_fields.cone_starts`.
        max_steps: see there.
        precision: see `mplicits.neural_fields.kernels.siren.siren_value`.
    """
    origin, axes, spreads, leaves, depths = (part.contiguous() for part in cones)
    free = depths.clone()
    if len(axes):
        tiling, kept = tiling_of(network.width), planes(network.depth, jet=False)
        programs = program_count(axes.device, triton.cdiv(len(axes), tiling.rows))
        with on_device(axes):
            march[(programs,)](  # pyright: ignore[reportIndexIssue]
                origin, axes, spreads, leaves, depths, margin, free, network.parameters,
                scratch_for(axes, programs, kept * tiling.rows * tiling.stride(network.width)),
                len(axes), max_steps, float(lipschitz), network.omega, network.gain,
                PLANES=kept, ROWS=tiling.rows, WIDTH=network.width, DEPTH=network.depth, COLUMNS=tiling.columns,
                PIECE=tiling.piece, PRECISION=precision, num_warps=tiling.warps, num_stages=2,
            )  # fmt: skip
    return free
