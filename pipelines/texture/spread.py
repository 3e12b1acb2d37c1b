"""Colours at places off a surface, without a jump: the further away, the wider they are averaged.

Samples are counted into the cells of a lattice, and cells into cells of twice the size (pull); where one has no
samples, the coarser one fills in (push), after Gortler et al., "The Lumigraph" (1996). A place at distance r takes the
lattices whose cells are about r wide, linearly in space and in log r.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, grid_sample, interpolate

SPREAD_CELLS = 128  # cells on each side of the cube [-1, 1]³
CELL = 2.0 / SPREAD_CELLS


class SpreadColors:
    """Colours in space, from ``colors`` ``(N, C)`` at ``points`` ``(N, 3)`` of a surface in the cube from −1 to 1.

    Raises:
        ValueError: there are no samples.
    """

    def __init__(self, points: Tensor, colors: Tensor) -> None:
        if not len(points):
            raise ValueError("points has no rows; expected samples of a surface")
        sums = _gathered(points, torch.cat((colors, torch.ones_like(colors[:, :1])), dim=1))
        pulled = [sums]
        while pulled[-1].shape[-1] > 1:
            pulled.append(8 * avg_pool3d(pulled[-1][None], 2)[0])
        pushed = [pulled[-1][:-1] / pulled[-1][-1:]]
        for level in pulled[-2::-1]:
            count = level[-1:]
            below = interpolate(pushed[-1][None], scale_factor=2, mode="trilinear", align_corners=False)[0]
            pushed.append(torch.where(count > 0, level[:-1] / count.clamp(min=1), below))
        self._levels = pushed[::-1]

    def __call__(self, points: Tensor, reach: Tensor) -> Tensor:
        """Colours ``(N, C)`` at points ``(N, 3)`` that are ``reach`` ``(N,)`` away from the surface."""
        wanted = torch.log2(reach.clamp(min=CELL) / CELL).clamp(max=len(self._levels) - 1)
        found = points.new_zeros(len(points), len(self._levels[0]))
        grid = points.to(self._levels[0])[None, :, None, None].flip(-1)
        for index, level in enumerate(self._levels):
            weight = (1 - (wanted - index).abs()).clamp(min=0)
            seen = grid_sample(level[None], grid, padding_mode="border", align_corners=False)[0, :, :, 0, 0].T
            found = found + weight[:, None] * seen.to(found)
        return found


def _gathered(points: Tensor, rows: Tensor) -> Tensor:
    """Sums ``(C, n, n, n)`` of rows ``(N, C)`` over the n = `SPREAD_CELLS` cells per side that their points lie in."""
    cell = ((points + 1) / CELL).floor().long().clamp(0, SPREAD_CELLS - 1)
    index = (cell[:, 0] * SPREAD_CELLS + cell[:, 1]) * SPREAD_CELLS + cell[:, 2]
    sums = rows.new_zeros(SPREAD_CELLS**3, rows.shape[1]).index_add(0, index, rows)
    return sums.T.reshape(-1, SPREAD_CELLS, SPREAD_CELLS, SPREAD_CELLS)
