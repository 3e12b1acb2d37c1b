"""One level's training: draw from the samples, sum the terms of Eq. 4, step Adam; interruptible and resumable."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from ...neural_fields import Siren
from ...neural_fields.losses import data_loss, eikonal_loss, normal_loss
from ..run.team import agreed, average_gradients, my_share, whole_batch
from ..run.trainer import StopFlag, pack_training, set_rate, unpack_training
from .samples import Source

__all__ = ["LevelTrainer"]


class LevelTrainer:
    """Trains one SIREN on sources of samples, with Adam and a warm-up + cosine schedule.

    Args:
        network: the level being trained.
        sources: what it learns from.
        steps: how many steps.
        learning_rate: the peak rate.
        seconds: end the schedule after this long even if steps remain; None for no limit.
        generator: CPU generator that draws the batches.
    """

    def __init__(
        self,
        network: Siren,
        sources: Sequence[Source],
        *,
        steps: int,
        learning_rate: float,
        seconds: float | None,
        generator: torch.Generator,
    ) -> None:
        self.network, self.sources, self.generator = network, sources, generator
        self.steps, self.learning_rate, self.seconds = steps, learning_rate, seconds
        self.adam = torch.optim.Adam(network.parameters(), lr=learning_rate, betas=(0.9, 0.99), fused=True)
        self.step, self.elapsed, self.ended_early = 0, 0.0, False
        self.losses: dict[str, float] = {}

    @property
    def fraction(self) -> float:
        """How much of the schedule is done, by steps or by time, whichever is further."""
        by_time = self.elapsed / self.seconds if self.seconds else 0.0
        return min(1.0, max(self.step / self.steps if self.steps else 1.0, by_time))

    def run(
        self,
        flag: StopFlag,
        *,
        report: Callable[[LevelTrainer], None],
        save: Callable[[LevelTrainer], None],
        report_every: int = 20,
        save_every: float = 20.0,
    ) -> bool:
        """Train until the schedule ends → True, or until ``flag`` asks to stop → False.

        Args:
            flag: see `stop_on_signals`.
            report: called every ``report_every`` steps, and at the end, with fresh ``losses``.
            save: called every ``save_every`` seconds.
            report_every: steps between reports; reading the losses makes a GPU wait.
            save_every: seconds between checkpoints.
        """
        start, saved = time.monotonic() - self.elapsed, time.monotonic()
        device = next(self.network.parameters()).device
        stop, self.elapsed = agreed(flag.requested, self.elapsed, device)
        while self.fraction < 1:
            if stop:
                return False
            terms = self._step()
            stop, self.elapsed = agreed(flag.requested, time.monotonic() - start, device)
            if self.step % report_every == 0 or self.fraction >= 1:
                self.losses = {name: float(term) for name, term in terms.items()}
                report(self)
            if time.monotonic() - saved > save_every:
                save(self)
                saved = time.monotonic()
        self.ended_early = self.step < self.steps
        return True

    def _step(self) -> dict[str, Tensor]:
        set_rate(self.adam, self.learning_rate, self.fraction)
        terms, total = self._losses()
        self.adam.zero_grad(set_to_none=True)
        total.backward()
        average_gradients(self.network.parameters())
        self.adam.step()
        self.step += 1
        return terms

    def _losses(self) -> tuple[dict[str, Tensor], Tensor]:
        """Mean of every term on one batch, unweighted and by name, and their weighted sum."""
        batches = [source.samples.take(self._draw(source)) for source in self.sources]
        jet = self.network.jet(torch.cat([batch.points for batch in batches]))
        lengths = [len(batch) for batch in batches]
        terms: dict[str, Tensor] = {}
        total = jet.value.new_zeros(())
        pieces = zip(self.sources, batches, jet.value.split(lengths), jet.gradient.split(lengths), strict=True)
        for source, batch, value, gradient in pieces:
            if batch.value is not None and batch.gradient is not None:
                value, gradient = value + batch.value, gradient + batch.gradient
            parts = [("eikonal", source.eikonal, eikonal_loss(gradient))]
            if batch.distance is not None:
                parts.append(("data", source.data, data_loss(value, batch.distance)))
            if batch.normal is not None:
                parts.append(("normal", source.normal, normal_loss(gradient, batch.normal)))
            for name, weight, loss in parts:
                mean = loss.mean()
                total = total + weight * mean
                terms[f"{source.name}.{name}"] = mean.detach()
        return terms, total

    def _draw(self, source: Source) -> Tensor:
        index = torch.randint(len(source.samples), (whole_batch(source.batch),), generator=self.generator)
        return my_share(index).to(source.samples.points.device)

    def state(self) -> dict[str, Tensor]:
        """All that `restore` needs to continue as if nothing had happened."""
        return pack_training(self.network, self.adam, self.generator, step=self.step, elapsed=self.elapsed)

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what `state` returned."""
        self.step, self.elapsed = unpack_training(state, self.network, self.adam, self.generator)
