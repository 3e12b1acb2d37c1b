"""Training of ``evolve``: one level of a field of space-time on what is known, on bounds and on the law."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from ...neural_fields import Jet, Siren, SpaceTimeSDF, key_loss, law_loss, spacetime_jet
from ...neural_fields.losses import eikonal_loss
from ..run.settings import EvolveConfig
from ..run.trainer import Progress, StopFlag, pack_training, set_rate, unpack_training
from .problem import Problem
from .samples import Known, _inside, band_points, uniform_spacetime

__all__ = ["EvolveTrainer", "learn_start"]

REFRESH = 25  # steps after which the points near the surface are drawn anew, since it has moved
POOL_STEPS = 6  # batches that a pool near the surface holds
# Norm of the gradient by the weights. Second derivatives have spikes, and a single one, at the peak of the learning
# rate, would throw the field so far from any distance that it does not come back.
LONGEST_GRADIENT = 1.0


class EvolveTrainer:
    """Trains the finest level of a field; interruptible, resumable.

    A batch is half known samples, a sixteenth bounds (level 0 only), a sixteenth anywhere, which shall only obey the
    eikonal equation, and the rest near the surface, where the law holds.

    Args:
        field: on the device of the training. Only parameters that require gradients are trained.
        problem: what it learns.
        config: settings.
        level: the level that is trained, the finest of ``field``.
        generator: CPU generator that draws the batches.
        seconds: end the schedule after this long even if steps remain; None for no limit.

    Raises:
        ValueError: a level above 0 has no known samples in its band.
    """

    def __init__(
        self,
        field: SpaceTimeSDF,
        problem: Problem,
        config: EvolveConfig,
        *,
        level: int,
        generator: torch.Generator,
        seconds: float | None = None,
    ) -> None:
        self.field, self.config, self.level, self.generator = field, config, level, generator
        self.steps, self.seconds = config.steps[level], seconds
        self.law, device = problem.law, field.like.device
        self.known, self.bounds = problem.known.to(device), problem.bounds.to(device)
        # In a residual level the band is where anything can be learnt.
        self.width = config.near
        if level:
            self.width = float(field.deltas[level - 1])
            self.known = self.known.take(_inside(field, self.known.points, level))
            if not len(self.known):
                raise ValueError(f"level {level}: no known samples in its band")
        self.trained = [parameter for parameter in field.parameters() if parameter.requires_grad]
        self.adam = torch.optim.Adam(self.trained, lr=config.learning_rates[level], betas=(0.9, 0.99), fused=True)
        self.pool = torch.empty(0, 4, device=device)
        self.step, self.elapsed, self.ended_early = 0, 0.0, False
        self.losses: dict[str, float] = {}

    @property
    def fraction(self) -> float:
        """How much of the schedule is done, by steps or by time, whichever is further."""
        by_time = self.elapsed / self.seconds if self.seconds else 0.0
        return min(1.0, max(self.step / self.steps, by_time))

    def run(
        self,
        flag: StopFlag,
        *,
        report: Callable[[EvolveTrainer], None],
        save: Callable[[EvolveTrainer], None],
        report_every: int = 20,
        save_every: float = 20.0,
    ) -> bool:
        """Train until the schedule ends → True, or until ``flag`` asks to stop → False; see `LevelTrainer.run`."""
        start, saved = time.monotonic() - self.elapsed, time.monotonic()
        while self.fraction < 1:
            if flag.requested:
                return False
            terms = self._step()
            self.elapsed = time.monotonic() - start
            if self.step % report_every == 0 or self.fraction >= 1:
                self.losses = {name: float(term) for name, term in terms.items()}
                report(self)
            if time.monotonic() - saved > save_every:
                save(self)
                saved = time.monotonic()
        self.ended_early = self.step < self.steps
        return True

    def _step(self) -> dict[str, Tensor]:
        set_rate(self.adam, self.config.learning_rates[self.level], self.fraction)
        if self.step % REFRESH == 0:
            self.pool = self._near_surface()
        terms, total = self._losses()
        self.adam.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.trained, LONGEST_GRADIENT)
        self.adam.step()
        self.step += 1
        return terms

    def _losses(self) -> tuple[dict[str, Tensor], Tensor]:
        """The terms of one batch, unweighted and by name, and their weighted sum."""
        config, device = self.config, self.pool.device
        half, part = config.batch // 2, config.batch // 16
        known = self.known.take(self._draw(len(self.known), half))
        bounds = self.bounds.take(self._draw(len(self.bounds), part if len(self.bounds) and not self.level else 0))
        anywhere = uniform_spacetime(0 if self.level else part, self.generator).to(device)
        near = self.pool[self._draw(len(self.pool), half - len(bounds.points) - len(anywhere))]

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
        target = Jet(known.value, known.gradient, found.features)
        terms = {"known": key_loss(found, target, length=config.length).mean()}
        total = config.data_weights[self.level] * terms["known"]
        slopes = torch.cat((obeying.gradient, rest.gradient[len(known) :]))
        terms["eikonal"] = eikonal_loss(slopes).mean()
        total = total + config.eikonal_weight * terms["eikonal"]
        if self.law is not None and len(near):
            terms["law"] = law_loss(obeying, self.law).mean()
            total = total + config.law_weight * terms["law"]
        if len(bounds):
            value = rest.value[len(known) : len(known) + len(bounds)]
            outside = (bounds.low - value).clamp(min=0) + (value - bounds.high).clamp(min=0)
            terms["bounds"] = outside.square().mean()
            total = total + config.bound_weight * terms["bounds"]
        return {name: term.detach() for name, term in terms.items()}, total

    def _near_surface(self) -> Tensor:
        return band_points(
            self.field, POOL_STEPS * self.config.batch // 2, self.width, self.generator, level=self.level
        )

    def _draw(self, size: int, count: int) -> Tensor:
        if not size:
            return torch.empty(0, dtype=torch.long, device=self.pool.device)
        return torch.randint(size, (count,), generator=self.generator).to(self.pool.device)

    def state(self) -> dict[str, Tensor]:
        """All that `restore` needs to continue as if nothing had happened."""
        state = pack_training(self.field, self.adam, self.generator, step=self.step, elapsed=self.elapsed)
        return state | {"pool": self.pool}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what `state` returned."""
        self.step, self.elapsed = unpack_training(state, self.field, self.adam, self.generator)
        self.pool = state["pool"].to(self.pool)


def learn_start(
    known: Known, config: EvolveConfig, generator: torch.Generator, report: Callable[[Progress], None]
) -> SpaceTimeSDF:
    """A field of one level that stands still: the shape at time 0, learnt in space alone and then lifted."""
    still = known.take((known.points[:, 3] == 0).nonzero()[:, 0])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        siren = Siren(config.widths[0], config.depths[0], omega=config.omegas[0]).to(known.points)
    adam = torch.optim.Adam(siren.parameters(), lr=config.learning_rates[0], betas=(0.9, 0.99), fused=True)
    for step in range(config.start_steps):
        fraction = step / config.start_steps
        set_rate(adam, config.learning_rates[0], fraction)
        batch = still.take(
            torch.randint(len(still), (config.batch // 2,), generator=generator).to(siren.output.weight.device)
        )
        jet = siren.jet(batch.points[:, :3])
        loss = key_loss(jet, Jet(batch.value, batch.gradient, jet.features), length=config.length).mean()
        adam.zero_grad(set_to_none=True)
        loss.backward()
        adam.step()
        if step % 20 == 0 or step + 1 == config.start_steps:
            done = (step + 1) / config.start_steps
            report(Progress("first shape", step + 1, config.start_steps, done, {"known": float(loss.detach())}))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return SpaceTimeSDF.from_static(siren)
