"""Points that a level does not see, and that judge it: how long it trains, and whether it is kept.

Neighbouring points share what a network overfits, so whole voxels are held out. They judge every level but the first
by its own loss there, Eq. 4 without the eikonal term: where a level follows the noise of the points that it sees, its
loss falls at those and rises here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, Siren
from ...neural_fields.losses import data_loss, normal_loss
from .samples import Samples, with_previous

__all__ = ["FEWEST", "LOOKS", "Judge", "Verdict", "held_out"]

FEWEST = 200  # whose mean square is known to a tenth
MOST = 0.1  # of the points; a cloud that would have to spare more spares none
VOXEL = 2.0  # edge of a voxel in spacings: about four points, whose neighbours can still fill the gap
LOOKS = 8  # how often a level is judged while it trains


def held_out(points: NDArray[np.float32], spacing: float, share: float, *, seed: int = 0) -> NDArray[np.bool_]:
    """Which points of a cloud are not trained on: those of voxels drawn at random.

    Args:
        points: ``(N, 3)``.
        spacing: of the cloud; of a voxel of twice that edge all points are taken or none.
        share: of the points; 0 for none.
        seed: of the draw.

    Returns:
        ``(N,)``; of a cloud that is too small to spare any, none.
    """
    count = max(FEWEST, math.ceil(share * len(points)))
    if not share or count > MOST * len(points) or not spacing > 0:
        return np.zeros(len(points), bool)
    cells = np.floor(points.astype(np.float64) / (VOXEL * spacing)).astype(np.int64)
    _, owner = np.unique(cells @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)
    owner = owner.reshape(-1)
    order = np.random.default_rng(seed).permutation(int(owner.max()) + 1)
    total = np.cumsum(np.bincount(owner)[order])
    drawn = np.zeros(len(order), bool)
    drawn[order[: int(np.searchsorted(total, count)) + 1]] = True
    return drawn[owner]


class Verdict(NamedTuple):
    """What held-out points say of a level.

    Attributes:
        points: how many there are in its band.
        before: their loss without it.
        after: their loss with it, at its best.
        at: fraction of its schedule at which that was.
    """

    points: int
    before: float
    after: float
    at: float

    @property
    def better(self) -> bool:
        """Whether the level is worth having."""
        return self.after < self.before

    def words(self) -> str:
        """One line for people."""
        losses = f"{self.before:.3g} without it, {self.after:.3g} with"
        said = f"the loss at {self.points:,} points that it has not seen is {losses}"
        if not self.better:
            return f"set to zero, for {said}"
        when = "" if self.at == 1 else f", as it was best: after {self.at:.0%} of its steps"
        return f"kept{when}, for {said}"


class Judge:
    """The loss of a level at points that it has not seen.

    Args:
        points: ``(n, 3)`` held-out points.
        normals: ``(n, 3)`` their normals.
        previous: the frozen levels.
        delta: half-width of the band around the finest of them; points outside it do not count.
        data: weight of f(x)².
        normal: weight of 1 − cos(∇f, N).
    """

    def __init__(
        self, points: Tensor, normals: Tensor, previous: Field, delta: float, *, data: float, normal: float
    ) -> None:
        samples = Samples(points, distance=torch.zeros(len(points)), normal=normals)
        self.samples = with_previous(samples, previous, delta, device=previous.like.device)
        self.data, self.normal, self.count = data, normal, len(self.samples)
        assert self.samples.value is not None
        assert self.samples.gradient is not None
        self.before = self._loss(self.samples.value, self.samples.gradient)

    @torch.no_grad()
    def loss(self, siren: Siren) -> float:
        """With the residual ``siren`` added to the levels before; ``before`` is without it."""
        value, gradient = self.samples.value, self.samples.gradient
        assert value is not None
        assert gradient is not None
        jet = siren.jet(self.samples.points)
        return self._loss(value + jet.value, gradient + jet.gradient)

    def _loss(self, value: Tensor, gradient: Tensor) -> float:
        distance, normal = self.samples.distance, self.samples.normal
        assert distance is not None
        assert normal is not None
        data, turn = data_loss(value, distance).mean(), normal_loss(gradient, normal).mean()
        return float(self.data * data + self.normal * turn)
