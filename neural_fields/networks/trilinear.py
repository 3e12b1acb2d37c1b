"""Trilinear interpolation on cubic grids over a cube.

A grid of resolution R has R cells and R + 1 vertices along each side of the cube [-extent, extent]³. Points outside the
cube take the value at the point of the cube that is nearest to them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Place", "locate", "vertex_weights", "vertices"]


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


def vertex_weights(within: Tensor) -> Tensor:
    """What the eight vertices of a cell count ``(N, 2, 2, 2)`` at ``(N, 3)`` places in it; they add up to 1."""
    u, v, w = torch.stack((1 - within, within), dim=1).unbind(dim=2)  # (N, 2) each
    return u[:, :, None, None] * v[:, None, :, None] * w[:, None, None, :]
