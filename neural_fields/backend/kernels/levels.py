"""All levels of a `MultiscaleSDF` in one launch: value, or value and gradient, with the gates evaluated inside.

Each program evaluates level 0 on its tiles, and lists the rows in the band, in order. Then it evaluates the next level
on the list, ROWS at a time, adds it behind its gate, and keeps the rows in the next band; and so on. So a level costs
what the rows in its band cost, rounded up to one tile for each program.

With f the value so far, δ the half-width of the band, τ the taper and r the next level, as in `multiscale.py`:

    u = clamp((|f|/δ − (1 − τ)) / τ, 0, 1),   γ = 1 − u²(3 − 2u),   γ′ = −6u(1 − u) sign(f) / (δτ),
    f ← f + γr,   ∇f ← (1 + γ′r) ∇f + γ ∇r,

and γ = 1 for τ = 0.
"""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportAssignmentType=false

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from .launch import half_scratch, launch
from .packing import Packed, Shape
from .tensor_tiles import jet_of_tile, points_of, rows_of, value_of_tile


class Levels(NamedTuple):
    """A `MultiscaleSDF` for the kernels."""

    networks: tuple[Packed, ...]  # coarse to fine
    deltas: Tensor  # (len(networks) − 1,) half-widths of the bands, float32 on the networks' device
    taper: float  # share of a band over which its gate closes

    @classmethod
    def of(cls, networks: Sequence[Packed], deltas: Tensor, taper: float) -> Levels:
        """The levels of ``networks``, with as many bands as they need."""
        return cls(tuple(networks), deltas[: len(networks) - 1].to(torch.float32).contiguous(), float(taper))

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Compile-time shape of each level."""
        return tuple(tuple(network.shape) for network in self.networks)

    def arguments(self) -> tuple[object, ...]:
        """Pointers to the levels' numbers and to half-widths, as kernels take them."""
        floats, halves = (tuple(getattr(one, name) for one in self.networks) for name in ("floats", "halves"))
        return floats, halves, self.deltas

    def scratch(self, *, jet: bool) -> int:
        """Float16 numbers that a program needs for any of the levels."""
        return max(Shape(*shape).scratch(self.rows, jet=jet) for shape in self.shapes)

    @property
    def rows(self) -> int:
        """Points of a tile of any level."""
        return max(network.shape.rows for network in self.networks)


@triton.jit
def level_of_tile(
    LEVEL: tl.constexpr,
    points, floats, halves, kept, scratch,
    JET: tl.constexpr, SHAPES: tl.constexpr, ROWS: tl.constexpr, IN: tl.constexpr,
):  # fmt: skip
    """Value of one level of a tile, and its gradient as a tuple of columns, empty unless ``JET``."""
    SHAPE: tl.constexpr = SHAPES[LEVEL]
    if JET:
        return jet_of_tile(points, floats[LEVEL], halves[LEVEL], scratch, SHAPE, ROWS, IN)
    else:
        return value_of_tile(points, floats[LEVEL], halves[LEVEL], kept, scratch, SHAPE, ROWS, IN), ()


@triton.jit
def gate_of(f, delta, taper, TAPERED: tl.constexpr):
    """γ and γ′ at values in the band."""
    if TAPERED:
        u = (tl.abs(f) / delta - (1 - taper)) / taper
        u = tl.minimum(tl.maximum(u, 0.0), 1.0)
        fall = 6 * u * (1 - u) / (delta * taper)
        return 1 - u * u * (3 - 2 * u), tl.where(f < 0, fall, -fall)
    else:
        return tl.full(f.shape, 1.0, tl.float32), tl.zeros(f.shape, tl.float32)


@triton.jit
def append(entries, length, entry, chosen):
    """Append the ``chosen`` of a tile of entries to a list, in order → its new length."""
    place = length + tl.cumsum(chosen.to(tl.int32), axis=0) - 1
    tl.store(entries + place, entry, mask=chosen)
    return length + tl.sum(chosen.to(tl.int32), axis=0)


@triton.jit(do_not_specialize=["capacity"])
def walk(
    x, row_mask, floats, halves, deltas, value, gradient, lists, scratch, counted, capacity, taper,
    JET: tl.constexpr, MASKED: tl.constexpr, TAPERED: tl.constexpr, SHAPES: tl.constexpr, SCRATCH: tl.constexpr,
    ROWS: tl.constexpr, IN: tl.constexpr,
):  # fmt: skip
    """Every program takes tiles from its own number on, and has a list whose ``capacity`` holds all their rows."""
    LEVELS: tl.constexpr = len(SHAPES)
    program = tl.cast(tl.program_id(0), tl.int64)
    own, listed = scratch + program * SCRATCH, lists + program * capacity
    length = tl.full((), 0, tl.int32)
    count = tl.load(counted)
    for tile in range(tl.program_id(0), tl.cdiv(count, ROWS), tl.num_programs(0)):
        row = rows_of(tile, ROWS)
        real = row < count
        points = points_of(x, row, real, IN)
        f, slope = level_of_tile(0, points, floats, halves, (), own, JET, SHAPES, ROWS, IN)
        tl.store(value + row, f, mask=real)
        if JET:
            for axis in tl.static_range(IN):
                tl.store(gradient + row * IN + axis, slope[axis], mask=real)
        if LEVELS > 1:
            inside = real & (tl.abs(f) < tl.load(deltas))
            if MASKED:
                inside = inside & (tl.load(row_mask + row, mask=real, other=0) != 0)
            length = append(listed, length, row, inside)

    for level in tl.static_range(1, LEVELS):
        tl.debug_barrier()  # what one thread wrote and listed, others read
        delta = tl.load(deltas + (level - 1))
        waiting, done = length, tl.full((), 0, tl.int32)
        length = tl.full((), 0, tl.int32)
        while done < waiting:
            place = done + tl.arange(0, ROWS)
            there = place < waiting
            row = tl.load(listed + place, mask=there, other=0)
            points = points_of(x, row, there, IN)
            before = tl.load(value + row, mask=there, other=0.0)
            gate, fall = gate_of(before, delta, taper, TAPERED)
            r, slope = level_of_tile(level, points, floats, halves, (), own, JET, SHAPES, ROWS, IN)
            f = before + gate * r
            if JET:
                steeper = 1 + fall * r
                for axis in tl.static_range(IN):
                    g = tl.load(gradient + row * IN + axis, mask=there, other=0.0)
                    tl.store(gradient + row * IN + axis, steeper * g + gate * slope[axis], mask=there)
            tl.store(value + row, f, mask=there)
            if level < LEVELS - 1:
                inside = there & (tl.abs(f) < tl.load(deltas + level))
                tl.debug_barrier()  # the list is written no further than all have read it
                length = append(listed, length, row, inside)
            done += ROWS


def levels_value(x: Tensor, levels: Levels, mask: Tensor | None = None) -> Tensor:
    """The finest of two or more levels at float32 points ``(N, d)`` → ``(N,)``; bands admit ``mask`` only."""
    value = x.new_empty(len(x))
    walk_rows(x, levels, value, value, mask, jet=False)
    return value


def levels_jet(x: Tensor, levels: Levels, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The finest level and its gradient at ``(N, d)`` → ``(N,)``, ``(N, d)``; see `levels_value`."""
    value, gradient = x.new_empty(len(x)), x.new_empty(x.shape)
    walk_rows(x, levels, value, gradient, mask, jet=True)
    return value, gradient


def walk_rows(
    x: Tensor,
    levels: Levels,
    value: Tensor,
    gradient: Tensor,
    mask: Tensor | None = None,
    count: Tensor | None = None,
    *,
    jet: bool,
) -> None:
    """Write values ``(N,)``, and with ``jet`` gradients ``(N, d)``, of the first rows of ``x`` ``(N, d)``.

    ``count`` is the number of rows, an integer tensor on the device, or None for all.
    """
    if not len(x):
        return
    x = x.contiguous()
    rows, kept = levels.rows, levels.scratch(jet=jet)
    tiles = triton.cdiv(len(x), rows)
    counted = x.new_full((1,), len(x), dtype=torch.int64) if count is None else count

    def arguments(programs: int) -> tuple[object, ...]:
        capacity = triton.cdiv(tiles, programs) * rows
        lists = torch.empty(programs * capacity, dtype=torch.int64, device=x.device)
        row_mask = lists if mask is None else mask.contiguous().view(torch.int8)
        scratch = half_scratch(x, programs * kept)
        return x, row_mask, *levels.arguments(), value, gradient, lists, scratch, counted, capacity, levels.taper

    launch(
        walk,
        x,
        tiles,
        arguments,
        JET=jet,
        MASKED=mask is not None,
        TAPERED=levels.taper > 0,
        SHAPES=levels.shapes,
        SCRATCH=kept,
        ROWS=rows,
        IN=x.shape[1],
        stages=1,
        warps=rows // 16,
    )
