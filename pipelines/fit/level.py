"""One level of a fit: an untrained SIREN, and Eq. 4 on what it learns from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...neural_fields import Siren
from ...neural_fields.backend.devices import upload
from ...neural_fields.fields.losses import data_loss, eikonal_loss, normal_loss, pseudo_huber
from ..training.settings import EvolveConfig, FitConfig
from ..training.trainer import Group, Objective, seeded, warm_cosine
from .cloud import drawn
from .heldout import JUDGE, Judge, Verdict
from .samples import Source

__all__ = ["LevelObjective", "LevelOptions", "calm_omega", "new_level"]


@dataclass(frozen=True)
class LevelOptions:
    """Numbers of `new_level` and `calm_omega`."""

    # A residual starts at a tenth of the usual output scale, close to the level before it.
    residual_gain: float = 0.1
    # Of a sparse cloud: at a tenth of the usual its waves tilt the normals of the level before by degrees.
    small_gain: float = 0.01
    # Largest frequency of a residual, in units of 1 / the standard deviation of noise that was smoothed off along
    # estimated normals: of waves shorter than 2π/0.4 of those, smoothing leaves nothing in the points but noise.
    # Where a cloud is filled in between its points, that smooths them once more, and edges need the higher ones.
    calm: float = 0.4
    # A level whose error at the points is so many times that of the level before is set to zero: data contradict
    # themselves where a part is thinner than their noise.
    worse: float = 2.0


LEVEL = LevelOptions()

BEST = "best."  # before the names of the weights that did best


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
    """The untrained SIREN of a level, whose weights follow from the seed; small by ``gain`` where it is a residual.

    Its frequency is the configuration's, or ``omega``.
    """
    width, depth, omega = config.widths[level], config.depths[level], omega or config.omegas[level]
    with seeded(config.seed * 1009 + level):
        return Siren(width, depth, omega=omega, in_dim=in_dim, output_gain=gain if residual else 1.0)


def calm_omega(config: FitConfig, level: int, noise: float, options: LevelOptions = LEVEL) -> float:
    """The frequency of a level of a cloud whose normals were estimated from points with ``noise``, 0 for none.

    That of the configuration, but no more than `calm` / noise, which is no less than that of level 0.
    """
    omega = config.omegas[level]
    return min(omega, max(config.omegas[0], options.calm / noise)) if noise else omega


class LevelObjective(Objective):
    """The terms of Eq. 4 for one SIREN on sources of samples.

    Args:
        siren: the level being trained.
        sources: what it learns from.
        learning_rate: the peak rate.
        generator: CPU generator that draws the batches.
        judge: points that are not among the sources. Where they say for sure that the level was better on its way than
            at its end, it goes back to that.
    """

    def __init__(
        self,
        siren: Siren,
        sources: Sequence[Source],
        *,
        learning_rate: float,
        generator: torch.Generator,
        judge: Judge | None = None,
    ) -> None:
        super().__init__(siren, [Group(list(siren.parameters()), warm_cosine(learning_rate))], generator)
        self.siren, self.sources, self.judge = siren, sources, judge
        areas = (source.samples.area for source in sources)
        self.shares = [None if area is None else area.cpu().double().cumsum(0) for area in areas]
        if judge is not None:  # in the checkpoints too
            best = {BEST + name: tensor.clone() for name, tensor in siren.state_dict().items()}
            self.kept = {
                "looks": torch.zeros(1),
                "hopeless": torch.zeros(1),
                "least": torch.full((1,), math.inf),
                "at": torch.ones(1),
                **best,
            }

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`: the mean of every term of every source."""
        if self.judge is not None and int(done * JUDGE.looks) > int(self.kept["looks"]):
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
            usual = source.usual
            parts = [("eikonal", source.eikonal, eikonal_loss(gradient), usual.eikonal)]
            if batch.distance is not None:
                parts.append(("data", source.data, data_loss(value, batch.distance), usual.data))
            if batch.normal is not None:
                parts.append(("normal", source.normal, normal_loss(gradient, batch.normal), usual.normal))
            for name, weight, loss, scale in parts:
                mean = pseudo_huber(loss, scale).mean()
                total = total + weight * mean
                terms[f"{source.name}.{name}"] = mean
        return terms, total

    def look(self, done: float) -> None:
        """Ask the judge, and keep the weights if they are the best so far."""
        if self.judge is None:
            return
        self.kept["looks"].fill_(int(done * JUDGE.looks))
        errors = self.judge.errors(self.siren)
        loss = errors.mean().loss
        if done >= JUDGE.hopeless and max(self.judge.verdict(errors, done).fall) < -JUDGE.surely:
            self.kept["hopeless"].fill_(1)
        if loss < float(self.kept["least"]):
            self.kept["least"].fill_(loss)
            self.kept["at"].fill_(done)
            for name, tensor in self.siren.state_dict().items():
                self.kept[BEST + name].copy_(tensor)

    @property
    def hopeless(self) -> bool:
        """See `Objective.hopeless`: whether held-out points say for sure that the level makes everything worse."""
        return self.judge is not None and bool(self.kept["hopeless"])

    def take_best(self) -> Verdict | None:
        """Look once more, and go back to the best weights if they are surely better → what was found; None without.

        The rates have fallen to nothing at the end, and with them the waves that the batches left; a few hundred points
        hardly see those. So the last weights stay, unless they are worse by more than chance, or no better than none:
        neither is their loss less, nor would the level be kept for its distances and angles.
        """
        if self.judge is None:
            return None
        weights = {name: tensor.clone() for name, tensor in self.siren.state_dict().items()}
        last = self.judge.errors(self.siren)
        self.look(1.0)
        self.siren.load_state_dict({name: self.kept[BEST + name] for name in weights})
        best, verdict = self.judge.errors(self.siren), self.judge.verdict(last, 1.0)
        some_use = verdict.after.loss < verdict.before.loss or verdict.better
        if some_use and not self.judge.surely_less(best, last):
            self.siren.load_state_dict(weights)
            return verdict
        return self.judge.verdict(best, float(self.kept["at"]))

    def _draw(self, source: Source, shares: Tensor | None) -> Tensor:
        if shares is None:
            index = torch.randint(len(source.samples), (source.batch,), generator=self.generator)
        else:
            index = drawn(shares, source.batch, self.generator)
        return upload(index, source.samples.points.device)
