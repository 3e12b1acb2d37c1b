"""All levels of a `MultiscaleSDF` in one launch: value, or value and gradient, with the gates decided inside.

Each program evaluates level 0 on its tiles, writes what it finds, and puts the rows that lie in the band on a list of
its own, in order, by prefix sums. Then it goes through the list, ROWS at a time, evaluates the next level there, adds
it on behind its gate, and keeps those on the list that lie in the next band; and so on. So a level costs what the rows
in its band cost, rounded up to one tile for each program, and no other program and no host has to know how many there
are. A program with an empty list skips the level.

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

from .launch import Network, on_device, program_count, scratch_for, tiling_of
from .tiles import jet_of_tile, planes, points_of, rows_of, value_of_tile

__all__ = ["Levels", "gate_of", "levels_jet", "levels_value"]


class Levels(NamedTuple):
    """A `MultiscaleSDF` as the kernels take it.

    Attributes:
        networks: coarse to fine.
        deltas: ``(len(networks) − 1,)`` half-widths of the bands, float32 on the networks' device.
        taper: the share of a band over which its gate closes.
    """

    networks: tuple[Network, ...]
    deltas: Tensor
    taper: float

    @classmethod
    def of(cls, networks: Sequence[Network], deltas: Tensor, taper: float) -> Levels:
        """Up to as many levels as there are ``networks``."""
        return cls(tuple(networks), deltas[: len(networks) - 1].to(torch.float32).contiguous(), float(taper))

    def arguments(self) -> tuple[object, ...]:
        """Pointers to parameters, ω₀ and gains of the levels, and half-widths, as kernels take them."""
        omegas, gains = (tuple(getattr(one, name) for one in self.networks) for name in ("omega", "gain"))
        return tuple(one.parameters for one in self.networks), omegas, gains, self.deltas

    def shape(self, *, jet: bool) -> Shape:
        """See `Shape`; ``jet`` says whether the kernel makes gradients."""
        tilings = [tiling_of(one.width) for one in self.networks]
        return Shape(
            sizes=tuple((n.width, n.depth, t.columns, t.piece) for n, t in zip(self.networks, tilings, strict=True)),
            rows=tilings[0].rows,
            floats=max(
                planes(n.depth, jet=jet) * t.rows * t.stride(n.width)
                for n, t in zip(self.networks, tilings, strict=True)
            ),
            warps=max(t.warps for t in tilings),
        )


class Shape(NamedTuple):
    """What a kernel over levels is compiled for.

    Attributes:
        sizes: width, depth, units of an accumulator and inner units of a product, of each level.
        rows: of a tile, the same for all levels.
        floats: of scratch that a program needs for the widest level.
        warps: of a program.
    """

    sizes: tuple[tuple[int, int, int, int], ...]
    rows: int
    floats: int
    warps: int


@triton.jit
def level_of_tile(
    LEVEL: tl.constexpr,
    points,
    parameters,
    scratch,
    omegas,
    gains,
    JET: tl.constexpr,
    SIZES: tl.constexpr,
    ROWS: tl.constexpr,
    IN: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """One level of a tile: its value, and its gradient as a tuple of columns, which is empty unless ``JET``."""
    WIDTH: tl.constexpr = SIZES[LEVEL][0]
    DEPTH: tl.constexpr = SIZES[LEVEL][1]
    COLUMNS: tl.constexpr = SIZES[LEVEL][2]
    PIECE: tl.constexpr = SIZES[LEVEL][3]
    own, omega, gain = parameters[LEVEL], omegas[LEVEL], gains[LEVEL]
    if JET:
        return jet_of_tile(points, own, scratch, omega, gain, ROWS, IN, WIDTH, DEPTH, COLUMNS, PIECE, PRECISION)
    else:
        f = value_of_tile(points, own, scratch, omega, gain, ROWS, IN, WIDTH, DEPTH, COLUMNS, PIECE, PRECISION)
        return f, ()


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
    """Put the ``chosen`` of a tile of entries on a list, in order → its new length."""
    place = length + tl.cumsum(chosen.to(tl.int32), axis=0) - 1
    tl.store(entries + place, entry, mask=chosen)
    return length + tl.sum(chosen.to(tl.int32), axis=0)


@triton.jit(do_not_specialize=["count", "room"])
def walk(
    x,
    wanted,
    parameters,
    omegas,
    gains,
    deltas,
    value,
    gradient,
    lists,
    scratch,
    count,
    room,
    taper,
    JET: tl.constexpr,
    WANTED: tl.constexpr,
    TAPERED: tl.constexpr,
    SIZES: tl.constexpr,
    FLOATS: tl.constexpr,
    ROWS: tl.constexpr,
    IN: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Every program takes tiles from its own number on, and has a list with ``room`` for all their rows."""
    LEVELS: tl.constexpr = len(SIZES)
    program = tl.cast(tl.program_id(0), tl.int64)
    own, listed = scratch + program * FLOATS, lists + program * room
    length = tl.full((), 0, tl.int32)
    for tile in range(tl.program_id(0), tl.cdiv(count, ROWS), tl.num_programs(0)):
        row = rows_of(tile, ROWS)
        real = row < count
        points = points_of(x, row, real, IN)
        f, slope = level_of_tile(0, points, parameters, own, omegas, gains, JET, SIZES, ROWS, IN, PRECISION)
        tl.store(value + row, f, mask=real)
        if JET:
            for axis in tl.static_range(IN):
                tl.store(gradient + row * IN + axis, slope[axis], mask=real)
        inside = real & (tl.abs(f) < tl.load(deltas))
        if WANTED:
            inside = inside & (tl.load(wanted + row, mask=real, other=0) != 0)
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
            r, slope = level_of_tile(level, points, parameters, own, omegas, gains, JET, SIZES, ROWS, IN, PRECISION)
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


def levels_value(x: Tensor, levels: Levels, precision: str, wanted: Tensor | None = None) -> Tensor:
    """The finest level at points ``(N, d)`` → ``(N,)``; N may be 0.

    Args:
        x: float32, on a CUDA device, or on the CPU under the interpreter.
        levels: two or more, on the same.
        precision: "ieee", "tf32x3" or "tf32".
        wanted: ``(N,)`` bool, the points that are let into bands; None for all.
    """
    value = x.new_empty(len(x))
    _launch(x, levels, precision, wanted, value, value, jet=False)
    return value


def levels_jet(x: Tensor, levels: Levels, precision: str, wanted: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The finest level and its gradient at ``(N, d)`` → ``(N,)``, ``(N, d)``; for the arguments see `levels_value`."""
    value, gradient = x.new_empty(len(x)), x.new_empty(x.shape)
    _launch(x, levels, precision, wanted, value, gradient, jet=True)
    return value, gradient


def _launch(
    x: Tensor, levels: Levels, precision: str, wanted: Tensor | None, value: Tensor, gradient: Tensor, *, jet: bool
) -> None:
    if not len(x):
        return
    shape = levels.shape(jet=jet)
    tiles = triton.cdiv(len(x), shape.rows)
    programs = program_count(x.device, tiles)
    room = triton.cdiv(tiles, programs) * shape.rows
    lists = torch.empty(programs * room, dtype=torch.int64, device=x.device)
    with on_device(x):
        walk[(programs,)](  # pyright: ignore[reportIndexIssue]
            x.contiguous(), lists if wanted is None else wanted.contiguous().view(torch.int8), *levels.arguments(),
            value, gradient, lists, scratch_for(x, programs, shape.floats), len(x), room, levels.taper,
            JET=jet, WANTED=wanted is not None, TAPERED=levels.taper > 0, SIZES=shape.sizes, FLOATS=shape.floats,
            ROWS=shape.rows, IN=x.shape[1], PRECISION=precision, num_warps=shape.warps, num_stages=2,
        )  # fmt: skip
