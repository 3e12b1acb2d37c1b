"""One level of a fit: its untrained network, its loss (Eq. 4), and the held-out points that judge it."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, Siren
from ...neural_fields.backend.devices import upload
from ...neural_fields.fields.losses import data_loss, normal_loss, pseudo_huber
from ..training.settings import EvolveConfig, FitConfig
from ..training.trainer import Objective, seeded, siren_groups, without_prefix
from .cloud import drawn
from .samples import LEAST, SQUARES, RobustScales, Samples, Source, at_feet, value_and_gradient, with_previous


@dataclass(frozen=True)
class LevelOptions:
    """Numbers of `new_level` and `calm_omega`."""

    # Output scale of an untrained residual: 0.1 tilts the normals of sparse clouds by degrees.
    residual_gain: float = 0.01
    moving_gain: float = 0.1  # the same of a residual in space and time
    # Largest frequency of a residual times the smoothed noise. Of 0.4, 0.22, 0.16 and 0.12 it was best for the bunny.
    calm: float = 0.22
    worse: float = 2.0  # error at the points over that of the level before, above which a level is set to zero


LEVEL = LevelOptions()

MEAN, BEST = "mean.", "best."  # prefixes of the mean weights, and of the best of them, in checkpoints


def new_level(
    config: FitConfig | EvolveConfig,
    level: int,
    *,
    residual: bool,
    in_dim: int = 3,
    gain: float = LEVEL.residual_gain,
    omega: float | None = None,
    options: LevelOptions = LEVEL,
) -> Siren:
    """The untrained SIREN of a level, seeded by the configuration.

    ``gain`` scales the output of a residual; ``omega`` replaces the configured frequency.
    """
    width, depth, omega = config.widths[level], config.depths[level], omega or config.omegas[level]
    with seeded(config.seed * 1009 + level):
        return Siren(width, depth, omega=omega, in_dim=in_dim, output_gain=gain if residual else 1.0)


def calm_omega(config: FitConfig, level: int, noise: float, options: LevelOptions = LEVEL) -> float:
    """The frequency of a level where normals were estimated from points with ``noise`` (0 for none).

    At most `calm` / noise, but at least that of level 0.
    """
    omega = config.omegas[level]
    return min(omega, max(config.omegas[0], options.calm / noise)) if noise else omega


@dataclass(frozen=True)
class JudgeOptions:
    """Numbers of `held_out` and `Judge`."""

    fewest: int = 200  # held-out points: their mean square is known to a tenth
    wanted: int = 600  # held-out points where that is at most the share `spared` of the cloud
    spared: float = 0.05
    most: float = 0.1  # largest held-out share; a smaller cloud spares none
    learnt: float = 0.8  # root mean square at training points over that without the level: less is a large gain
    voxel: float = 2.0  # edge of a voxel in spacings: about four points, a gap that neighbours can still fill
    surely: float = 2.0  # standard errors
    averaged: float = 0.07  # time constant of the mean of weights, in parts of the schedule
    # Judgements of a level during its training. None of them ends it: most gains come late, as the rate falls.
    looks: int = 20


JUDGE = JudgeOptions()


def held_out(
    points: NDArray[np.float32], spacing: float, share: float, *, seed: int = 0, options: JudgeOptions = JUDGE
) -> NDArray[np.bool_]:
    """Which points ``(N,)`` of a cloud are held out: about a ``share``, in whole voxels drawn at random.

    Neighbouring points share what a network overfits, so a voxel is held out whole. A small cloud spares none.
    """
    count = max(
        options.fewest, math.ceil(share * len(points)), min(options.wanted, math.floor(options.spared * len(points)))
    )
    if not share or count > options.most * len(points) or not spacing > 0:
        return np.zeros(len(points), bool)
    owner = voxels_of(points, spacing, options=options)
    order = np.random.default_rng(seed).permutation(int(owner.max()) + 1)
    total = np.cumsum(np.bincount(owner)[order])
    chosen = np.zeros(len(order), bool)
    chosen[order[: int(np.searchsorted(total, count)) + 1]] = True
    return chosen[owner]


def noisy_points(count: int, share: float, options: JudgeOptions = JUDGE) -> int:
    """How many of ``count`` points are set apart with their noise: the share `spared`, none of a small cloud."""
    spared = math.ceil(max(options.spared, share) * count)
    return spared if share and spared >= options.fewest else 0


def voxels_of(points: NDArray[np.float32], spacing: float, options: JudgeOptions = JUDGE) -> NDArray[np.int64]:
    """The voxel ``(N,)`` of each point, numbered from 0; its edge is `voxel` times the ``spacing``."""
    cells = np.floor(points.astype(np.float64) / (options.voxel * spacing)).astype(np.int64)
    owner = np.unique(cells @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)[1]
    return owner.reshape(-1).astype(np.int64)


def standard_errors(falls: Tensor, voxels: Tensor, areas: Tensor | None = None) -> float:
    """The mean of ``falls`` ``(n,)`` over the surface in units of its standard error; above 2 it is hardly chance.

    Points of a voxel are correlated, so the standard error is that of the K voxels (cluster-robust, Liang and Zeger,
    Biometrika 1986). With areas a_i, the mean m = Σ a_i f_i / Σ a_i and the sum e_v of a voxel's a_i (f_i − m), it is
    ``√(K / (K − 1) Σ_v e_v²) / Σ a_i``. ``voxels`` ``(n,)`` are numbered from 0; ``areas`` ``(n,)`` are equal if None.
    """
    if not len(falls):
        return 0.0
    falls = falls.double().cpu()
    areas = torch.ones_like(falls) if areas is None else areas.double().cpu()
    mean = (areas * falls).sum() / areas.sum()
    sums = torch.zeros(int(voxels.max()) + 1, dtype=torch.float64).index_add_(0, voxels.cpu(), areas * (falls - mean))
    count = len(voxels.unique())
    error = float((sums.square().sum() * count / max(count - 1, 1)).sqrt() / areas.sum())
    if math.isnan(error):  # a level that has diverged
        return -math.inf
    return float(mean) / error if error > 0 else math.copysign(math.inf, mean) if mean else 0.0


class Error(NamedTuple):
    """Mean errors of a field at held-out points."""

    loss: float  # of the level, without the eikonal term
    distance: float  # |f| in the unit sphere
    angle: float  # between gradient and normal, in degrees


class Fall(NamedTuple):
    """Decrease of the mean errors at held-out points, in standard errors; negative for an increase."""

    distance: float
    angle: float


class Verdict(NamedTuple):
    """The judgement of a level at held-out points."""

    points: int  # in the band
    before: Error  # without the level
    after: Error  # with it
    at: float  # fraction of the steps after which the weights were kept
    fall: Fall
    learnt: float = 1.0  # root mean square of |f| at the training points over that without the level
    guessed: bool = False  # whether the normals were estimated
    noisy: bool = False  # whether the points, then of estimated normals, have their noise
    until: int | None = None  # the last of several levels that are judged together, and then not by the loss

    @property
    def better(self) -> bool:
        """Whether the level is kept: one error is significantly less, the other not significantly more, or it `learns`.

        Either may grow where the surface comes nearer: the distance to points that smoothing has rounded off, the angle
        to normals of vertices, which are means of those of faces. If it does significantly, the loss has to be less,
        which weighs both as the training does. Estimated normals share the noise of the points: with them the distance
        may not be significantly more, and the loss says nothing. The noise of points that were set apart is independent
        of the level: |f| there falls where the surface comes nearer to the truth, often by less than its standard
        error. So a level is kept unless it rises significantly, with its last weights: the best of several looks would
        fall by chance.
        """
        sound = (self.fall.distance if self.guessed else min(self.fall)) > -JUDGE.surely
        sound |= not self.guessed and self.after.loss < self.before.loss
        return sound if self.noisy else ((max(self.fall) > JUDGE.surely and sound) or self.learns)

    @property
    def unsettled(self) -> bool:
        """Whether it is neither better nor significantly worse in both errors, so that the next level decides."""
        return max(self.fall) > -JUDGE.surely and not (self.better or self.noisy)

    @property
    def learns(self) -> bool:
        """Whether both errors are less, and that at the points the level was trained on is less by far."""
        return min(self.fall) > 0 and self.learnt < JUDGE.learnt

    def words(self, level: int, *, scale: float = 1.0) -> str:
        """One line for people; ``scale`` takes distances to input units."""
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
        which, it = (f"level {level}", "it") if self.until is None else (f"levels {level} to {self.until}", "them")
        if self.until is None:
            errors += f", loss {self.before.loss:.3g} → {self.after.loss:.3g}"
        if not self.noisy and self.learns and max(self.fall) <= JUDGE.surely:
            errors += f"; at the points it was trained on the root mean square is {self.learnt:.2f} of what it was"
        return f"{which} {judged}: without {it} → with {it}, at {self.points:,} points held out: {errors}"

    def record(self, level: int, *, scale: float = 1.0) -> dict[str, Any]:
        """For ``run.json``, with distances in input units and angles in degrees."""
        return {
            "points": self.points,
            "before": self.before.loss,
            "after": self.after.loss,
            "at": self.at,
            "distance": [error.distance * scale for error in (self.before, self.after)],
            "angle": [error.angle for error in (self.before, self.after)],
            "fall_in_standard_errors": self.fall._asdict(),
            "learnt": self.learnt,
            "kept": self.better,
            "verdict": self.words(level, scale=scale),
        }


def _sure(fall: float, options: JudgeOptions = JUDGE) -> str:
    if abs(fall) <= options.surely:
        return "no significant difference"
    return "significantly less" if fall > 0 else "significantly more"


class Each(NamedTuple):
    """Errors at every held-out point, and the areas, ``(count,)`` each."""

    loss: Tensor
    distance: Tensor
    angle: Tensor
    areas: Tensor

    def mean(self) -> Error:
        """The means over the surface."""
        return Error(*(float((self.areas * error).sum() / self.areas.sum()) for error in self[:3]))


class Judge:
    """The errors of a level at ``points`` ``(n, 3)`` that it is not trained on.

    They are means over the surface, by ``areas`` ``(n,)``, of the points in the band of half-width ``delta`` around
    ``previous``, or of all points if they are ``noisy``, see `at_feet`. The loss is Eq. 4 without its eikonal term.
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
        scales: RobustScales = SQUARES,
        guessed: bool = False,
        noisy: bool = False,
        options: JudgeOptions = JUDGE,
    ) -> None:
        self.options = options
        areas = torch.ones(len(points)) if areas is None else areas
        samples = Samples(points, distance=torch.zeros(len(points)), normal=normals, area=areas)
        placed = at_feet if noisy else partial(with_previous, delta=delta)
        self.samples = placed(samples, previous, device=previous.like.device)
        self.data, self.normal, self.count = data, normal, len(self.samples)
        self.guessed, self.noisy = guessed, noisy
        self.voxels = torch.from_numpy(voxels_of(self.samples.points.cpu().numpy(), spacing, options=self.options))
        value, gradient = self.samples.known("value", "gradient")
        # Squares of distances at level 1 are mostly those of few points that level 0 has missed.
        usual = math.inf if not self.count else float(value.square().median())
        self.scales = scales._replace(data=min(scales.data, max(usual, LEAST.data)))
        self.without = self._errors(value, gradient)
        self.before = self.without.mean()

    @torch.no_grad()
    def errors(self, siren: Siren) -> Each:
        """Errors with the residual ``siren`` added to the levels before; `without` are those without it."""
        value, gradient = self.samples.known("value", "gradient")
        jet = siren.jet(self.samples.points)
        return self._errors(value + jet.value, gradient + jet.gradient)

    def errors_of(self, field: Field) -> Each:
        """Errors of a field that has more levels than those before; points must not be `noisy`."""
        return self._errors(*value_and_gradient(field, self.samples.points))

    def score(self, error: Error) -> float:
        """What the best weights have least of: the loss, or the distance where normals were estimated."""
        return error.distance if self.guessed else error.loss

    def verdict(self, each: Each, at: float) -> Verdict:
        """The verdict on a level with these errors, kept after the fraction ``at`` of its steps."""
        pairs = zip(self.without[1:3], each[1:3], strict=True)
        fall = Fall(*(standard_errors(before - after, self.voxels, each.areas) for before, after in pairs))
        return Verdict(self.count, self.before, each.mean(), at, fall, guessed=self.guessed, noisy=self.noisy)

    def _errors(self, value: Tensor, gradient: Tensor) -> Each:
        distance, normal, area = self.samples.known("distance", "normal", "area")
        data, turn = data_loss(value, distance), normal_loss(gradient, normal)
        # From the chord: the cosine of a small angle rounds to 1.
        chord = (torch.nn.functional.normalize(gradient, dim=1) - normal).norm(dim=1)
        angle = torch.rad2deg(2 * (chord.clamp(max=2) / 2).asin())
        loss = self.data * pseudo_huber(data, self.scales.data) + self.normal * pseudo_huber(turn, self.scales.normal)
        return Each(loss, data.sqrt(), angle, area)


class LevelObjective(Objective):
    """The terms of Eq. 4 for one SIREN on ``sources``.

    With a ``judge`` the level gets the mean weights that were best at held-out points, see `take_best`.
    """

    def __init__(
        self,
        siren: Siren,
        sources: Sequence[Source],
        *,
        learning_rate: float,
        generator: torch.Generator,
        judge: Judge | None = None,
        turn: float = 0.0,
    ) -> None:
        super().__init__(siren, siren_groups(siren, learning_rate, turn), generator)
        self.siren, self.sources, self.judge = siren, sources, judge
        areas = (source.samples.area for source in sources)
        self.shares = [None if area is None else area.cpu().double().cumsum(0) for area in areas]
        if judge is not None:  # `kept` is part of the checkpoints
            weights = siren.state_dict()
            starts = {"looks": 0.0, "averaged": 0.0, "at": 1.0, "least": math.inf}
            self.kept = {name: torch.tensor(start, dtype=torch.float64) for name, start in starts.items()}
            self.kept |= {prefix + name: weights[name].clone() for prefix in (MEAN, BEST) for name in weights}

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`: the mean of every term of every source."""
        self.look(done)
        pairs = zip(self.sources, self.shares, strict=True)
        batches = [source.samples.take(self._draw(source, shares)) for source, shares in pairs]
        jet = self.siren.jet(torch.cat([batch.points for batch in batches]))
        lengths = [len(batch) for batch in batches]
        terms: dict[str, Tensor] = {}
        total = jet.value.new_zeros(())
        pieces = zip(self.sources, batches, jet.value.split(lengths), jet.gradient.split(lengths), strict=True)
        for source, batch, value, gradient in pieces:
            if batch.value is not None and batch.gradient is not None:
                value, gradient = value + batch.value, gradient + batch.gradient
            for name, weight, loss in source.terms(value, gradient, batch):
                mean = loss.mean()
                total = total + weight * mean
                terms[f"{source.name}.{name}"] = mean
        return terms, total

    @torch.no_grad()
    def look(self, done: float) -> None:
        """Average the weights; at times judge their mean, and keep it if its score is the least or points are noisy."""
        if self.judge is None:
            return
        share = 1 - math.exp((float(self.kept["averaged"]) - done) / JUDGE.averaged)
        self.kept["averaged"].fill_(done)
        for name, weights in self.siren.state_dict().items():
            self.kept[MEAN + name].lerp_(weights, share)
        if int(done * JUDGE.looks) <= int(self.kept["looks"]):
            return
        self.kept["looks"].fill_(int(done * JUDGE.looks))
        mean = copy.deepcopy(self.siren)
        mean.load_state_dict(without_prefix(MEAN, self.kept))
        score = self.judge.score(self.judge.errors(mean).mean())
        if score < float(self.kept["least"]) or self.judge.noisy:
            self.kept["least"].fill_(score)
            self.kept["at"].fill_(done)
            for name, weights in without_prefix(MEAN, self.kept).items():
                self.kept[BEST + name].copy_(weights)

    def take_best(self) -> Verdict | None:
        """Take the mean weights of the least score → the verdict; None, and the last weights, without a judge."""
        if self.judge is None:
            return None
        self.look(1.0)
        self.siren.load_state_dict(without_prefix(BEST, self.kept))
        return self.judge.verdict(self.judge.errors(self.siren), float(self.kept["at"]))

    def _draw(self, source: Source, shares: Tensor | None) -> Tensor:
        if shares is None:
            index = torch.randint(len(source.samples), (source.batch,), generator=self.generator)
        else:
            index = drawn(shares, source.batch, self.generator)
        return upload(index, source.samples.points.device)
