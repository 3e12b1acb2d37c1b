"""Trilinear interpolation on cubic grids over a cube.

A grid of resolution R has R cells and R + 1 vertices along each side of the cube [-extent, extent]³. Points outside the
cube take the value at the point of the cube that is nearest to them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Place(NamedTuple):
    """Where points lie in a grid.

    Attributes:
        cell: ``(N, 3)`` int64, the lowest vertex of the cell.
        within: ``(N, 3)`` where in the cell, in [0, 1].
        scale: ``(N, 3)`` derivative of ``within`` by x, cells per unit; 0 along the axes on which x is outside.
    """

    cell: Tensor
    within: Tensor
    scale: Tensor


def locate(x: Tensor, resolution: int, extent: float) -> Place:
    """Find the cells of ``(N, 3)`` points."""
    # Autograd sees the clamp as `scale` does: slope 1 from edge to edge, both included.
    inside = x.clamp(-extent, extent)
    cells = (inside + extent) * (resolution / (2 * extent))
    cell = cells.detach().floor().clamp(max=resolution - 1)
    scale = (inside == x).to(x.dtype) * (resolution / (2 * extent))
    return Place(cell.long(), cells - cell, scale)


def vertices(cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Both coordinates of the eight vertices of cells ``(N, 3)`` along x, y and z, ready to be broadcast.

    Returns:
        ``(N, 2, 1, 1)``, ``(N, 1, 2, 1)`` and ``(N, 1, 1, 2)``; any sum of them is ``(N, 2, 2, 2)``.
    """
    both = torch.stack((cell, cell + 1), dim=1)  # (N, 2, 3)
    return both[:, :, None, None, 0], both[:, None, :, None, 1], both[:, None, None, :, 2]


def interpolate(corners: Tensor, within: Tensor) -> Tensor:
    """Interpolate ``(N, 2, 2, 2, F)`` values at the vertices → ``(N, F)``."""
    u, v, w = within[:, None, None, None, 0], within[:, None, None, 1], within[:, None, 2]
    edges = torch.lerp(corners[:, 0], corners[:, 1], u)  # (N, 2, 2, F)
    ends = torch.lerp(edges[:, 0], edges[:, 1], v)
    return torch.lerp(ends[:, 0], ends[:, 1], w)


def interpolate_jet(corners: Tensor, place: Place) -> tuple[Tensor, Tensor]:
    """Interpolate, and differentiate by x; both differentiable with respect to values and x.

    Returns:
        ``(N, F)`` values and ``(N, F, 3)`` derivatives.
    """
    u, v, w = place.within[:, None, None, None, 0], place.within[:, None, None, 1], place.within[:, None, 2]
    by_x = corners[:, 1] - corners[:, 0]
    edges = torch.lerp(corners[:, 0], corners[:, 1], u)
    by_y, ends = edges[:, 1] - edges[:, 0], torch.lerp(edges[:, 0], edges[:, 1], v)
    by_x = torch.lerp(by_x[:, 0], by_x[:, 1], v)
    by_z, value = ends[:, 1] - ends[:, 0], torch.lerp(ends[:, 0], ends[:, 1], w)
    by_x, by_y = (torch.lerp(slope[:, 0], slope[:, 1], w) for slope in (by_x, by_y))
    return value, torch.stack((by_x, by_y, by_z), dim=-1) * place.scale[:, None]
