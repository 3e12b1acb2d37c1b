"""Points that a level does not see, and that judge it: how long it trains, and whether it is kept.

Neighbouring points share what a network overfits, so whole voxels are held out. They judge every level but the first
by its own loss there, Eq. 4 without the eikonal term: where a level follows the noise of the points that it sees, its
loss falls at those and rises here.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, Siren
from ...neural_fields.losses import data_loss, normal_loss, pseudo_huber
from .samples import Samples, with_previous

__all__ = ["FEWEST", "LOOKS", "Error", "Judge", "Verdict", "held_out", "surely_less"]

FEWEST = 200  # whose mean square is known to a tenth
MOST = 0.1  # of the points; a cloud that would have to spare more spares none
VOXEL = 2.0  # edge of a voxel in spacings: about four points, whose neighbours can still fill the gap
SURELY = 2.0  # standard errors
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


class Error(NamedTuple):
    """How far a field is off at held-out points.

    Attributes:
        loss: that of the level that is judged.
        distance: root mean square of f, in the unit sphere.
        angle: median angle between gradient and normal, in degrees.
    """

    loss: float
    distance: float
    angle: float


class Verdict(NamedTuple):
    """What held-out points say of a level.

    Attributes:
        points: how many there are in its band.
        before: the error there without it.
        after: the error with it.
        at: fraction of its schedule after which its weights were kept.
    """

    points: int
    before: Error
    after: Error
    at: float

    @property
    def better(self) -> bool:
        """Whether the level is worth having."""
        return self.after.loss < self.before.loss

    def words(self, level: int, *, scale: float = 1.0) -> str:
        """One line for people, of the ``level`` with this number; ``scale`` takes distances to input units."""
        if not self.better:
            judged = "set to zero"
        elif self.at == 1:
            judged = "kept"
        else:
            judged = f"kept as it was after {self.at:.0%} of its steps"
        pairs = zip(self.before, self.after, (1.0, scale, 1.0), strict=True)
        loss, distance, angle = (f"{b * unit:.3g} → {a * unit:.3g}" for b, a, unit in pairs)
        errors = f"loss {loss}, rms distance {distance}, median angle {angle}°"
        return f"level {level} {judged}: without it → with it, at {self.points:,} points that it has not seen: {errors}"

    def record(self, level: int, *, scale: float = 1.0) -> dict[str, Any]:
        """For ``run.json``: the losses, and the other errors in input units and degrees."""
        return {
            "points": self.points,
            "before": self.before.loss,
            "after": self.after.loss,
            "at": self.at,
            "distance": [error.distance * scale for error in (self.before, self.after)],
            "angle": [error.angle for error in (self.before, self.after)],
            "verdict": self.words(level, scale=scale),
        }


class Judge:
    """The error of a level at points that it has not seen.

    Args:
        points: ``(n, 3)`` held-out points.
        normals: ``(n, 3)`` their normals.
        previous: the frozen levels.
        delta: half-width of the band around the finest of them; points outside it do not count.
        data: weight of f(x)².
        normal: weight of 1 − cos(∇f, N).
        turn: the scale of `pseudo_huber` around it.
    """

    def __init__(
        self,
        points: Tensor,
        normals: Tensor,
        previous: Field,
        delta: float,
        *,
        data: float,
        normal: float,
        turn: float = math.inf,
    ) -> None:
        samples = Samples(points, distance=torch.zeros(len(points)), normal=normals)
        self.samples = with_previous(samples, previous, delta, device=previous.like.device)
        self.data, self.normal, self.turn, self.count = data, normal, turn, len(self.samples)
        assert self.samples.value is not None
        assert self.samples.gradient is not None
        self.before, _ = self._errors(self.samples.value, self.samples.gradient)

    def error(self, siren: Siren) -> Error:
        """With the residual ``siren`` added to the levels before; ``before`` is without it."""
        return self.errors(siren)[0]

    @torch.no_grad()
    def errors(self, siren: Siren) -> tuple[Error, Tensor]:
        """`error`, and the loss of every point ``(count,)``."""
        value, gradient = self.samples.value, self.samples.gradient
        assert value is not None
        assert gradient is not None
        jet = siren.jet(self.samples.points)
        return self._errors(value + jet.value, gradient + jet.gradient)

    def _errors(self, value: Tensor, gradient: Tensor) -> tuple[Error, Tensor]:
        distance, normal = self.samples.distance, self.samples.normal
        assert distance is not None
        assert normal is not None
        data, turn = data_loss(value, distance), pseudo_huber(normal_loss(gradient, normal), self.turn)
        each = self.data * data + self.normal * turn
        # The chord, for the cosine of a small angle rounds to 1.
        chord = (torch.nn.functional.normalize(gradient, dim=1) - normal).norm(dim=1)
        angle = torch.rad2deg(2 * (chord.quantile(0.5).clamp(max=2) / 2).asin()) if len(chord) else chord.sum()
        return Error(float(each.mean()), float(data.mean().sqrt()), float(angle)), each


def surely_less(first: Tensor, second: Tensor) -> bool:
    """Whether the losses ``(n,)`` of the same points are less in the mean, by more than chance makes them.

    That is twice the standard error of the mean of their differences.
    """
    apart = second - first
    return bool(apart.mean() > SURELY * apart.std() / math.sqrt(len(apart)))
