"""What ``evolve`` minimises: losses of a space-time level at known values, at bounds and of the law."""

from __future__ import annotations

import torch
from torch import Tensor

from ...neural_fields import Jet, Siren, SpaceTimeSDF
from ...neural_fields.backend.devices import upload
from ...neural_fields.fields.losses import eikonal_loss
from ...neural_fields.spacetime.evolution import key_loss, law_loss
from ...neural_fields.spacetime.field import spacetime_jet
from ..training.settings import EvolveConfig
from ..training.trainer import ErrorWeightedSampler, Objective, Report, Trainer, seeded, siren_groups
from .problem import Problem
from .samples import Known, band_points, indices_in_band, uniform_spacetime

# Norm of the gradient by the weights. Second derivatives have spikes, and a single one, at the peak of the learning
# rate, would throw the field so far from any distance that it does not come back.
LONGEST_GRADIENT = 1.0


class EvolveObjective(Objective):
    """The terms of one level, the finest of a field; only parameters that require gradients are trained.

    A batch is half known samples, a sixteenth bounds (level 0 only), a sixteenth anywhere, which shall only obey the
    eikonal equation, and the rest near the surface, where the law holds.

    Raises:
        ValueError: a level above 0 has no known samples in its band.
    """

    def __init__(
        self, field: SpaceTimeSDF, problem: Problem, config: EvolveConfig, *, level: int, generator: torch.Generator
    ) -> None:
        device = field.like.device
        groups = siren_groups(field, config.learning_rates[level], config.turn)
        super().__init__(field, groups, generator, {"pool": torch.empty(0, 4, device=device)})
        self.field, self.config, self.level, self.law = field, config, level, problem.law
        self.keys = problem.keys
        self.known, self.bounds = problem.known.to(device), problem.bounds.to(device)
        # In a residual level the band is where anything can be learnt.
        self.width = config.near
        if level:
            self.width = float(field.deltas[level - 1])
            self.known = self.known.take(indices_in_band(field, self.known.points, level))
            if not len(self.known):
                raise ValueError(f"level {level}: no known samples in its band")
        # Without a law, half of a batch of known samples is drawn by the error of the field there. Thin parts are few
        # samples of many, and smoothed away where all count alike.
        self.sampler = ErrorWeightedSampler(len(self.known), 0.0 if self.law else 0.5, device, strip=1)
        self.kept |= self.sampler.kept

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        config = self.config
        # The points near the surface are drawn anew every 25 steps, since it has moved: a pool of 6 batches.
        if step % 25 == 0:
            count = 6 * config.batch // 2
            self.kept["pool"] = band_points(self.field, count, self.width, self.generator, level=self.level)
        pool = self.kept["pool"]
        half, part = config.batch // 2, config.batch // 16
        rows = self.sampler.at_step(step, self.kept).rows(half, self.generator)
        known = self.known.take(rows)
        bounds = self.bounds.take(self._draw(len(self.bounds), part if len(self.bounds) and not self.level else 0))
        anywhere = uniform_spacetime(0 if self.level else part, self.generator).to(pool.device)
        near = pool[self._draw(len(pool), half - len(bounds.points) - len(anywhere))]

        order = 1 if self.law is None else self.law.order
        loose = torch.cat((bounds.points, anywhere))
        if order == 1:
            jet = spacetime_jet(self.field, torch.cat((near, known.points, loose)))
            obeying = type(jet)(*(value[: len(near)] for value in jet))
            rest = Jet(jet.value[len(near) :], jet.gradient[len(near) :], jet.features[len(near) :])
        else:
            obeying = spacetime_jet(self.field, near, order=order)
            later = spacetime_jet(self.field, torch.cat((known.points, loose)))
            rest = Jet(later.value, later.gradient, later.features)

        found = Jet(rest.value[: len(known)], rest.gradient[: len(known)], rest.features[: len(known)])
        wrong = key_loss(found, Jet(known.value, known.gradient, found.features), length=config.length)
        self.sampler.learn(rows, wrong.detach().sqrt())
        terms = {"known": wrong.mean()}
        total = config.data_weights[self.level] * terms["known"]
        slopes = torch.cat((obeying.gradient, rest.gradient[len(known) :]))
        terms["eikonal"] = eikonal_loss(slopes).mean()
        total = total + config.eikonal_weight * terms["eikonal"]
        if self.law is not None and len(near):
            keys = near.new_tensor(self.keys)
            interval = keys.diff()[torch.bucketize(near[:, 3].contiguous(), keys[1:-1])]  # that each point lies in
            terms["law"] = (interval.square() * law_loss(obeying, self.law)).mean()
            total = total + config.law_weight * terms["law"]
        if len(bounds):
            value = rest.value[len(known) : len(known) + len(bounds)]
            outside = (bounds.low - value).clamp(min=0) + (value - bounds.high).clamp(min=0)
            terms["bounds"] = outside.square().mean()
            total = total + config.bound_weight * terms["bounds"]
        return terms, total

    def _draw(self, size: int, count: int) -> Tensor:
        device = self.kept["pool"].device
        if not size:
            return torch.empty(0, dtype=torch.long, device=device)
        return upload(torch.randint(size, (count,), generator=self.generator), device)


class _StillObjective(Objective):
    """The shape at time 0, in space alone."""

    def __init__(self, siren: Siren, known: Known, config: EvolveConfig, generator: torch.Generator) -> None:
        super().__init__(siren, siren_groups(siren, config.learning_rates[0], config.turn), generator)
        self.siren, self.config = siren, config
        self.known = known.take((known.points[:, 3] == 0).nonzero()[:, 0])

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        chosen = torch.randint(len(self.known), (self.config.batch // 2,), generator=self.generator)
        batch = self.known.take(chosen.to(self.known.points.device))
        jet = self.siren.jet(batch.points[:, :3])
        loss = key_loss(jet, Jet(batch.value, batch.gradient, jet.features), length=self.config.length).mean()
        return {"known": loss}, loss


def learn_start(
    known: Known, config: EvolveConfig, generator: torch.Generator, progress: Report, *, seconds: float | None = None
) -> SpaceTimeSDF:
    """A field of one level that stands still: the shape at time 0, learnt in space alone and then lifted."""
    with seeded(config.seed):
        siren = Siren(config.widths[0], config.depths[0], omega=config.omegas[0]).to(known.points)
    objective = _StillObjective(siren, known, config, generator)
    Trainer(objective, stage="first shape", steps=config.start_steps, seconds=seconds).run(report=progress)
    return SpaceTimeSDF.from_static(siren)
