"""Points that a level does not see, and that judge it: how long it trains, and whether it is kept.

Neighbouring points share what a network overfits, so whole voxels are held out. While a level but the first trains,
they judge it by its own loss there, Eq. 4 without the eikonal term: where a level follows the noise of the points that
it sees, its loss falls at those and rises here. In the end it must have made distances or the angles of normals surely
less, and neither surely more. A loss of squares would not do for that: it is mostly that of the few points on sharp
edges, and a level that mends a little there pays for the roughness of all faces with it.

Of thin parts and corners, which a few hundred points hardly know of, they are often not sure of anything. There the
points that the level has learnt from are asked as well: what it has gained at those by far, and the others see too,
if less surely, is no overfitting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, Siren
from ...neural_fields.fields.losses import data_loss, normal_loss, pseudo_huber
from .samples import SQUARES, Samples, Usual, with_previous

__all__ = ["Error", "Fall", "Judge", "JudgeOptions", "Verdict", "held_out", "standard_errors", "voxels_of"]


@dataclass(frozen=True)
class JudgeOptions:
    """Numbers of `held_out` and `Judge`."""

    fewest: int = 200  # whose mean square is known to a tenth
    # so many, of clouds that need not spare more than this part for them
    wanted: int = 600
    spared: float = 0.05
    most: float = 0.1  # of the points; a cloud that would have to spare more spares none
    learnt: float = (
        0.8  # root mean square at the points that a level has learnt from, over that without it: a gain by far
    )
    voxel: float = 2.0  # edge of a voxel in spacings: about four points, whose neighbours can still fill the gap
    surely: float = 2.0  # standard errors
    # From this part of the schedule on, training ends where distances and angles are both surely more than without
    # the level. Levels that were set to zero in the end had both 2.8 to 14 standard errors above it there (three
    # shapes), those that were kept had both below it (four levels).
    hopeless: float = 0.375
    looks: int = 8  # how often a level is judged while it trains


JUDGE = JudgeOptions()


def held_out(
    points: NDArray[np.float32], spacing: float, share: float, *, seed: int = 0, options: JudgeOptions = JUDGE
) -> NDArray[np.bool_]:
    """Which points of a cloud are not trained on: those of voxels drawn at random.

    Args:
        points: ``(N, 3)``.
        spacing: of the cloud; of a voxel of twice that edge all points are taken or none.
        share: of the points; 0 for none.
        seed: of the draw.
        options: numbers of the algorithm.

    Returns:
        ``(N,)``; of a cloud that is too small to spare any, none.
    """
    count = max(
        options.fewest, math.ceil(share * len(points)), min(options.wanted, math.floor(options.spared * len(points)))
    )
    if not share or count > options.most * len(points) or not spacing > 0:
        return np.zeros(len(points), bool)
    owner = voxels_of(points, spacing, options=options)
    order = np.random.default_rng(seed).permutation(int(owner.max()) + 1)
    total = np.cumsum(np.bincount(owner)[order])
    drawn = np.zeros(len(order), bool)
    drawn[order[: int(np.searchsorted(total, count)) + 1]] = True
    return drawn[owner]


def voxels_of(points: NDArray[np.float32], spacing: float, options: JudgeOptions = JUDGE) -> NDArray[np.int64]:
    """The voxel of twice ``spacing``'s edge that each of the points ``(N, 3)`` is in → ``(N,)`` numbers from 0 on."""
    cells = np.floor(points.astype(np.float64) / (options.voxel * spacing)).astype(np.int64)
    owner = np.unique(cells @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)[1]
    return owner.reshape(-1).astype(np.int64)


def standard_errors(falls: Tensor, voxels: Tensor, areas: Tensor | None = None) -> float:
    """The mean of ``falls`` ``(n,)`` over the surface, in units of its standard error: above 2 it is hardly chance.

    Points of one voxel are off together. So what is independent is not the points but the K voxels (cluster-robust
    standard error, Liang and Zeger, Biometrika 1986). With areas a_i, the mean m = Σ a_i f_i / Σ a_i and the sum e_v of
    a voxel's a_i (f_i − m), it is ``√(K / (K − 1) Σ_v e_v²) / Σ a_i``.

    Args:
        falls: what each point has gained.
        voxels: ``(n,)`` the voxel of each, numbered from 0.
        areas: ``(n,)`` of the surface that each stands for; None if they are all alike.
    """
    if not len(falls):
        return 0.0
    falls = falls.double().cpu()
    areas = torch.ones_like(falls) if areas is None else areas.double().cpu()
    mean = (areas * falls).sum() / areas.sum()
    sums = torch.zeros(int(voxels.max()) + 1, dtype=torch.float64).index_add_(0, voxels.cpu(), areas * (falls - mean))
    count = len(voxels.unique())
    error = float((sums.square().sum() * count / max(count - 1, 1)).sqrt() / areas.sum())
    if math.isnan(error):  # what has diverged has not gained
        return -math.inf
    return float(mean) / error if error > 0 else math.copysign(math.inf, mean) if mean else 0.0


class Error(NamedTuple):
    """How far a field is off at held-out points.

    Attributes:
        loss: that of the level that is judged.
        distance: mean of |f|, in the unit sphere.
        angle: mean angle between gradient and normal, in degrees.
    """

    loss: float
    distance: float
    angle: float


class Fall(NamedTuple):
    """By how many standard errors a level has made the mean errors at held-out points less; below 0 more.

    Attributes:
        distance: of |f|.
        angle: of the angle between gradient and normal.
    """

    distance: float
    angle: float


class Verdict(NamedTuple):
    """What held-out points say of a level.

    Attributes:
        points: how many there are in its band.
        before: the error there without it.
        after: the error with it.
        at: fraction of its schedule after which its weights were kept.
        fall: how sure the difference is.
        learnt: root mean square of |f| at the points that it has learnt from, over that without it.
        guessed: whether the normals were estimated from the points, which cannot speak against a level.
    """

    points: int
    before: Error
    after: Error
    at: float
    fall: Fall
    learnt: float = 1.0
    guessed: bool = False

    @property
    def better(self) -> bool:
        """Whether the level is worth having.

        Either one error is surely less, and the other not surely more, unless that is the angle to estimates. Or both
        are less, surely or not, and it has gained by far at the points that it has learnt from.
        """
        against = self.fall.distance if self.guessed else min(self.fall)
        sure = max(self.fall) > JUDGE.surely and against > -JUDGE.surely
        return sure or self.learns

    @property
    def learns(self) -> bool:
        """Whether both errors are less, and those at the points that it has learnt from are by far."""
        return min(self.fall) > 0 and self.learnt < JUDGE.learnt

    def words(self, level: int, *, scale: float = 1.0) -> str:
        """One line for people, of the ``level`` with this number; ``scale`` takes distances to input units."""
        if not self.better:
            judged = "set to zero"
        elif self.at == 1:
            judged = "kept"
        else:
            judged = f"kept as it was after {self.at:.0%} of its steps"
        (_, *before), (_, *after) = self.before, self.after
        pairs = zip(before, after, self.fall, (scale, 1.0), strict=True)
        distance, angle = (f"{b * unit:.3g} → {a * unit:.3g}{{}} ({_sure(fall)})" for b, a, fall, unit in pairs)
        errors = f"mean distance {distance.format('')}, mean angle of the normals {angle.format('°')}"
        if self.learns and max(self.fall) <= JUDGE.surely:
            errors += f"; at those that it has learnt from the root mean square is {self.learnt:.2f} of what it was"
        return f"level {level} {judged}: without it → with it, at {self.points:,} points that it has not seen: {errors}"

    def record(self, level: int, *, scale: float = 1.0) -> dict[str, Any]:
        """For ``run.json``: the losses, the other errors in input units and degrees, and how sure their falls are."""
        return {
            "points": self.points,
            "before": self.before.loss,
            "after": self.after.loss,
            "at": self.at,
            "distance": [error.distance * scale for error in (self.before, self.after)],
            "angle": [error.angle for error in (self.before, self.after)],
            "fall_in_standard_errors": self.fall._asdict(),
            "learnt": self.learnt,
            "verdict": self.words(level, scale=scale),
        }


def _sure(fall: float, options: JudgeOptions = JUDGE) -> str:
    if abs(fall) <= options.surely:
        return "no sure difference"
    return "surely less" if fall > 0 else "surely more"


class Each(NamedTuple):
    """Errors of every held-out point and the area that it stands for, ``(count,)`` each."""

    loss: Tensor
    distance: Tensor
    angle: Tensor
    areas: Tensor

    def mean(self) -> Error:
        """The means over the surface."""
        return Error(*(float((self.areas * error).sum() / self.areas.sum()) for error in self[:3]))


class Judge:
    """The error of a level at points that it has not seen.

    Args:
        points: ``(n, 3)`` held-out points.
        normals: ``(n, 3)`` their normals.
        previous: the frozen levels.
        delta: half-width of the band around the finest of them; points outside it do not count.
        spacing: of the cloud; see `voxels_of`.
        areas: ``(n,)`` of the surface that each point stands for; None if they are all alike.
        data: weight of f(x)².
        normal: weight of 1 − cos(∇f, N).
        usual: the scales of `pseudo_huber` around them.
        guessed: whether the normals were estimated from the points.
        options: numbers of the algorithm.
    """

    def __init__(
        self,
        points: Tensor,
        normals: Tensor,
        previous: Field,
        delta: float,
        *,
        spacing: float,
        areas: Tensor | None = None,
        data: float,
        normal: float,
        usual: Usual = SQUARES,
        guessed: bool = False,
        options: JudgeOptions = JUDGE,
    ) -> None:
        self.options = options
        areas = torch.ones(len(points)) if areas is None else areas
        samples = Samples(points, distance=torch.zeros(len(points)), normal=normals, area=areas)
        self.samples = with_previous(samples, previous, delta, device=previous.like.device)
        self.data, self.normal, self.usual, self.count = data, normal, usual, len(self.samples)
        self.guessed = guessed
        self.voxels = torch.from_numpy(voxels_of(self.samples.points.cpu().numpy(), spacing, options=self.options))
        assert self.samples.value is not None
        assert self.samples.gradient is not None
        self.without = self._errors(self.samples.value, self.samples.gradient)
        self.before = self.without.mean()

    @torch.no_grad()
    def errors(self, siren: Siren) -> Each:
        """Those of every point, with the residual ``siren`` added to the levels before; `without` is without it."""
        value, gradient = self.samples.value, self.samples.gradient
        assert value is not None
        assert gradient is not None
        jet = siren.jet(self.samples.points)
        return self._errors(value + jet.value, gradient + jet.gradient)

    def surely_less(self, first: Each, second: Each) -> bool:
        """Whether the first losses are less in the mean, by more than chance makes them."""
        return standard_errors(second.loss - first.loss, self.voxels, first.areas) > self.options.surely

    def verdict(self, each: Each, at: float) -> Verdict:
        """On a level with these errors; see `Verdict`."""
        pairs = zip(self.without[1:3], each[1:3], strict=True)
        fall = Fall(*(standard_errors(before - after, self.voxels, each.areas) for before, after in pairs))
        return Verdict(self.count, self.before, each.mean(), at, fall, guessed=self.guessed)

    def _errors(self, value: Tensor, gradient: Tensor) -> Each:
        distance, normal = self.samples.distance, self.samples.normal
        assert distance is not None
        assert normal is not None
        assert self.samples.area is not None
        data, turn = data_loss(value, distance), normal_loss(gradient, normal)
        # The chord, for the cosine of a small angle rounds to 1.
        chord = (torch.nn.functional.normalize(gradient, dim=1) - normal).norm(dim=1)
        angle = torch.rad2deg(2 * (chord.clamp(max=2) / 2).asin())
        loss = self.data * pseudo_huber(data, self.usual.data) + self.normal * pseudo_huber(turn, self.usual.normal)
        return Each(loss, data.sqrt(), angle, self.samples.area)
