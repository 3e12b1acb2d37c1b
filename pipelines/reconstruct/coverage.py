"""How densely photographs look at each place of a surface, learnt from the rays of a training that end there."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

__all__ = ["Coverage"]

CELLS = 48  # along an edge of the cube around the region: few are wider than the gaps that few cameras look into
FORGET = 1 / 512  # of what is known is forgotten in a step: the surface moves
LITTLE = 0.25  # of a ray, added to both densities: nothing is rare of which nothing is known
MOST = 20.0  # times as much as usual: what one pixel in a thousand shows may be a wrong pixel


class Coverage:
    """Rays per piece of surface, all over the region, and how rare those at a place are.

    A ray that ends at x adds 1 / odds to the vertices of a grid around x, trilinearly, if it was drawn ``odds`` times
    as often as evenly; so the grid holds what even draws would. Read in the same way at x, it is a density d(x) of
    rays, smoothed over a cell: of pixels that see the place, by its area. With the mean d̄ over all rays,

        rarity(x) = (d̄ + 1/4) / (d(x) + 1/4), but from 1 to 20.

    What many cameras face has 1. Gaps and undersides, of which a few pixels of a few cameras show a slanted bit, have
    more: with draws in proportion to it each piece of the surface that is seen has its share of them.

    Args:
        device: of the rays.

    Attributes:
        rays: ``(CELLS + 1,) * 3`` at the vertices, in rays of the last few hundred steps.
        usual: ``(2,)`` running sums of d over the rays, and of the rays.
    """

    def __init__(self, device: torch.device) -> None:
        count = CELLS + 1
        self.rays = torch.zeros(count, count, count, device=device)
        self.usual = torch.zeros(2, device=device)

    @property
    def kept(self) -> Mapping[str, Tensor]:
        """What later steps depend on, for `Objective.kept`."""
        return {"covered": self.rays, "usual_cover": self.usual}

    @torch.no_grad()
    def rarity(self, ends: Tensor) -> Tensor:
        """How rare rays are where these end ``(R,)``.

        Args:
            ends: ``(R, 3)`` in unit-sphere coordinates.
        """
        corners, weights = _around(ends)
        density = (self.rays.view(-1)[corners] * weights).sum(dim=1)
        total, rays = self.usual.unbind()
        mean = total / rays.clamp_min(LITTLE)
        return ((mean + LITTLE) / (density + LITTLE)).clamp(1.0, MOST)

    @torch.no_grad()
    def learn(self, ends: Tensor, odds: Tensor, solid: Tensor) -> None:
        """Take note of where the rays of a step end.

        Args:
            ends: ``(R, 3)``.
            odds: ``(R,)`` how many times as often as evenly each was drawn.
            solid: ``(R,)`` its opacity: what passes the surface is on none.
        """
        corners, weights = _around(ends)
        counts = solid / odds
        flat = self.rays.view(-1)
        flat.mul_(1 - FORGET)
        flat.index_add_(0, corners.reshape(-1), (counts[:, None] * weights).reshape(-1))
        density = (flat[corners] * weights).sum(dim=1)
        self.usual.mul_(1 - FORGET).add_(torch.stack(((counts * density).sum(), counts.sum())))


def _around(points: Tensor) -> tuple[Tensor, Tensor]:
    """The eight vertices around points ``(R, 3)`` and their trilinear weights, ``(R, 8)`` each."""
    at = (points.clamp(-1, 1) + 1) * (0.5 * CELLS)
    cell = at.floor().clamp(max=CELLS - 1)
    part = at - cell
    weights = cell.new_ones(len(points), 1)
    corners = torch.zeros_like(weights, dtype=torch.long)
    for axis in range(3):
        ends = torch.stack((1 - part[:, axis], part[:, axis]), dim=1)
        weights = (weights[:, :, None] * ends[:, None]).flatten(1)
        index = cell[:, axis].long()
        corners = corners[:, :, None] * (CELLS + 1) + torch.stack((index, index + 1), dim=1)[:, None]
        corners = corners.flatten(1)
    return corners, weights
