"""Cones for tiles of an image: how far whole tiles are empty, before any ray is traced."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..backend.devices import makes_wait
from ..backend.fixed_shapes import first_rows
from ..fields.field import Field, FieldLike, as_field
from ..networks.multiscale import choose_levels, levels_of
from ..networks.siren import Siren
from ._march_gpu import FIRST_PASSES, PASSES
from .sphere import BOUNDING_RADIUS, ball_crossing, check_rays, unit_directions

CONE_LIPSCHITZ = 1.15  # of networks, which are steeper than a distance in places; a cone too far loses thin parts
TILES = (16, 4)  # sides in pixels, each a multiple of the next
CONE_STEPS = 64  # most steps of a cone; rays do the rest


@torch.no_grad()
def cone_starts(
    field: FieldLike,
    origin: Tensor,
    directions: Tensor,
    *,
    level: int = -1,
    tiles: Sequence[int] = TILES,
    lipschitz: float = 1.0,
    radius: float = BOUNDING_RADIUS,
    max_steps: int = CONE_STEPS,
    clearance: float = 0.0,
) -> Tensor:
    """Depths ``(H, W)`` up to which whole tiles of an image are empty, infinite where nothing can be visible.

    They are ``near`` of `sphere_trace` at ``level``, from one cone for each tile, marched on level 0. The spread σ of a
    cone is the largest distance between the directions of a tile and its middle one. At depth t the tile's rays lie
    within tσ of the axis, so with v = |f_0| on the axis the tile is empty up to t + ((v − δ_0)/L − tσ) / (1 + σ). Tiles
    are marched from large to small, each starting where the larger one ended, and keep a ``clearance`` to the surface.

    ``origin`` is ``(3,)``, ``directions`` ``(H, W, 3)`` of any length but 0; ``tiles`` are sides in pixels, each a
    multiple of the next. ValueError for other shapes, or a field that is not three-dimensional.
    """
    field = as_field(field)
    level = field.resolve_level(level)
    if origin.shape != (3,) or directions.ndim != 3:
        shapes = f"origin {tuple(origin.shape)}, directions {tuple(directions.shape)}"
        raise ValueError(f"{shapes}: expected (3,), (H, W, 3)")
    check_rays(field, origin, directions, lipschitz=lipschitz)
    directions, length = unit_directions(directions)
    depth = torch.zeros_like(length)
    for tile in tiles:
        cones = _Cones.of(directions, tile)
        starts = depth[::tile, ::tile].reshape(-1)
        free = _march_cones(field, origin, cones, starts, level, lipschitz, radius, max_steps, clearance)
        depth = free[cones.of_pixel]
    return depth / length


def _march_cones(
    field: Field,
    origin: Tensor,
    cones: _Cones,
    starts: Tensor,
    level: int,
    lipschitz: float,
    radius: float,
    max_steps: int,
    clearance: float,
) -> Tensor:
    """How far each cone is empty; infinite where it leaves the ball of ``radius`` untouched."""
    axis, spread = cones.axis, cones.spread
    # Kept from the surface of level 0; a number on the device of the cones.
    delta = clearance + (field.deltas[0].to(axis) if level else axis.new_zeros(()))
    # A ray of the cone may be in the ball where its axis is not; spread · reach is the most that they are apart.
    reach = origin.norm() + radius
    entry, leave = ball_crossing(origin.expand_as(axis), axis, radius + spread * reach)
    depth = torch.maximum(starts, entry).clamp(min=0)
    depth = torch.where(depth >= leave, torch.inf, depth)
    network = levels_of(field)[0]
    if isinstance(network, Siren) and choose_levels((network,), axis, jet=False).fused:
        from ..backend.kernels.cones import march_cones
        from ..backend.kernels.packing import packed

        return march_cones(packed(network), (origin, axis, spread, leave, depth), delta, lipschitz, max_steps)

    # A CPU drops cones that have stopped after each step; an accelerator is read as rarely as in `_march_gpu`.
    on_cpu, steps = not makes_wait(depth.device), 0
    going, before, value = depth.isfinite(), depth, torch.full_like(depth, torch.nan)
    chunk, left = (1, int(going.sum())) if on_cpu else (FIRST_PASSES, len(going))
    while left and steps < max_steps:
        rows = going.nonzero()[:, 0] if on_cpu else first_rows(going, left)
        if left == len(going):
            rows = torch.arange(left, device=going.device)
        line, sigma, last, on = axis[rows], spread[rows], leave[rows], going[rows]
        moving = (depth[rows], before[rows], value[rows])
        for _ in range(min(chunk, max_steps - steps)):
            t = torch.where(on, moving[0], 0)  # those that have left are at infinity
            here = field.value(origin + t[:, None] * line, level=0)
            # Behind the surface, the field was steeper than ``lipschitz``: step back, and leave it to the rays.
            passed = here * moving[2] < 0
            step = ((here.abs() - delta) / lipschitz - t * sigma) / (1 + sigma)
            ahead = torch.where(passed, moving[1], t + step.clamp(min=0))
            moved = (torch.where(ahead >= last, torch.inf, ahead), t, here)
            moving = tuple(torch.where(on, new, old) for new, old in zip(moved, moving, strict=True))
            # Once a step is shorter than the cone is wide, smaller cones get on better.
            on = on & (step > t * sigma) & (ahead < last) & ~passed
        depth, before, value = (
            old.index_copy(0, rows, new) for old, new in zip((depth, before, value), moving, strict=True)
        )
        going = going.index_copy(0, rows, on)
        steps, left = steps + chunk, int(on.sum())
        chunk = 1 if on_cpu else PASSES
    return depth


class _Cones(NamedTuple):
    """The C tiles of an image."""

    axis: Tensor  # (C, 3) direction of the middle pixel of each
    spread: Tensor  # (C,) largest distance of the directions of its pixels from that
    of_pixel: Tensor  # (H, W) tile of each pixel

    @classmethod
    def of(cls, directions: Tensor, tile: int) -> _Cones:
        height, width = directions.shape[:2]
        rows, columns = (torch.arange(count, device=directions.device) for count in (height, width))
        across = -(-width // tile)
        of_pixel = (rows[:, None] // tile) * across + columns // tile
        middle_row, middle_column = (
            (count // tile * tile + tile // 2).clamp(max=len(count) - 1) for count in (rows, columns)
        )
        axis = directions[middle_row[::tile]][:, middle_column[::tile]].reshape(-1, 3)
        away = (directions - directions[middle_row][:, middle_column]).norm(dim=-1)
        spread = away.new_zeros(len(axis)).scatter_reduce(0, of_pixel.flatten(), away.flatten(), "amax")
        return cls(axis, spread, of_pixel)
