"""How densely photographs look at each place of a surface, learnt from the rays of a training that end there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ....neural_fields.networks.trilinear import locate, vertex_weights, vertices

__all__ = ["Around", "Coverage"]

CELLS = 48  # along an edge of the cube around the region: few are wider than the gaps that few cameras look into
FORGET = 1 / 512  # of what is known is forgotten in a step: the surface moves
LITTLE = 0.25  # of a ray, added to both densities: nothing is rare of which nothing is known
MOST = 20.0  # times as much as usual: what one pixel in a thousand shows may be a wrong pixel


class Around(NamedTuple):
    """The eight vertices around places.

    Attributes:
        rows: ``(R, 8)`` of the grid, flat.
        weights: ``(R, 8)`` trilinear, that add up to 1.
    """

    rows: Tensor
    weights: Tensor


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

    def take_up(self, kept: Mapping[str, Tensor]) -> None:
        """Go on with what `kept` has put into the objective's, which may be that of a run which is resumed."""
        self.rays, self.usual = kept["covered"], kept["usual_cover"]

    @torch.no_grad()
    def around(self, ends: Tensor) -> Around:
        """Where rays end ``(R, 3)``, in unit-sphere coordinates, as the two below want it."""
        place, count = locate(ends, CELLS, 1.0), CELLS + 1
        x, y, z = vertices(place.cell)
        return Around(((x * count + y) * count + z).flatten(1), vertex_weights(place.within).flatten(1))

    @torch.no_grad()
    def rarity(self, around: Around) -> Tensor:
        """How rare rays are there ``(R,)``."""
        total, rays = self.usual.unbind()
        mean = total / rays.clamp_min(LITTLE)
        return ((mean + LITTLE) / (self._density(around) + LITTLE)).clamp(1.0, MOST)

    @torch.no_grad()
    def learn(self, around: Around, odds: Tensor, solid: Tensor) -> None:
        """Take note of where the rays of a step end.

        Args:
            around: their ends.
            odds: ``(R,)`` how many times as often as evenly each was drawn.
            solid: ``(R,)`` its opacity: what passes the surface is on none.
        """
        counts = solid / odds
        flat = self.rays.view(-1)
        flat.mul_(1 - FORGET)
        flat.index_add_(0, around.rows.flatten(), (counts[:, None] * around.weights).flatten())
        sums = torch.stack(((counts * self._density(around)).sum(), counts.sum()))
        self.usual.mul_(1 - FORGET).add_(sums)

    def _density(self, around: Around) -> Tensor:
        return (self.rays.view(-1)[around.rows] * around.weights).sum(dim=1)
