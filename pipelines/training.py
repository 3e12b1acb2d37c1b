"""One level's training: draw from the samples, sum the terms of Eq. 4, step Adam; interruptible and resumable."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

import torch
from torch import Tensor, nn

from ..neural_fields import Siren
from ..neural_fields.losses import data_loss, eikonal_loss, normal_loss
from .distributed import agreed, average_gradients, my_share, whole_batch
from .sampling import Samples

__all__ = [
    "LevelTrainer",
    "Progress",
    "Source",
    "StopFlag",
    "pack_training",
    "set_rate",
    "stop_on_signals",
    "unpack_training",
]


@dataclass(frozen=True)
class Source:
    """Samples, how many of them go into each batch, and the weights of their terms."""

    name: str
    samples: Samples
    batch: int
    data: float
    normal: float
    eikonal: float


@dataclass(frozen=True)
class Progress:
    """What a progress display is told.

    Attributes:
        stage: name of the stage.
        step: steps done.
        steps: steps planned.
        fraction: of the stage, in [0, 1]; not step / steps when a time budget may end it earlier.
        losses: unweighted loss terms of the last reported step.
    """

    stage: str
    step: int
    steps: int
    fraction: float
    losses: Mapping[str, float]


class StopFlag:
    """Whether somebody has asked the training to stop after the step under way."""

    def __init__(self) -> None:
        self.requested = False


@contextmanager
def stop_on_signals() -> Iterator[StopFlag]:
    """Turn the first Ctrl-C or SIGTERM into a flag that is read between two steps; a second one acts at once.

    Signals belong to the main thread; elsewhere the flag is simply never raised.
    """
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in signals}

    def request(number: int, frame: FrameType | None) -> None:
        flag.requested = True
        for other in signals:
            signal.signal(other, before[other])

    for number in signals:
        signal.signal(number, request)
    try:
        yield flag
    finally:
        for number in signals:
            signal.signal(number, before[number])


def set_rate(adam: torch.optim.Adam, peak: float, progress: float) -> None:
    """Give the optimiser the learning rate for a schedule done to ``progress`` in [0, 1]: warm-up, then a cosine.

    Adam's first steps are as long as its later ones, whatever the gradient: warm up over 2 % of the schedule.
    """
    rate = peak * min(1.0, (progress + 0.001) / 0.02) * 0.5 * (1 + math.cos(math.pi * progress))
    for group in adam.param_groups:
        group["lr"] = rate


def pack_training(
    network: nn.Module, adam: torch.optim.Adam, generator: torch.Generator, *, step: int, elapsed: float
) -> dict[str, Tensor]:
    """All of a training that `unpack_training` needs to continue as if nothing had happened."""
    state = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    for index, parameter in enumerate(network.parameters()):
        for name, tensor in adam.state.get(parameter, {}).items():
            state[f"adam.{index}.{name}"] = tensor
    state["generator"] = generator.get_state()
    state["progress"] = torch.tensor([step, elapsed], dtype=torch.float64)
    return state


def unpack_training(
    state: Mapping[str, Tensor], network: nn.Module, adam: torch.optim.Adam, generator: torch.Generator
) -> tuple[int, float]:
    """Give network, optimiser and generator what `pack_training` took → steps done and seconds spent."""
    prefix = "network."
    network.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
    for index, parameter in enumerate(network.parameters()):
        prefix = f"adam.{index}."
        # Adam counts its steps on the CPU, or beside the parameter where the kernel is fused.
        found = {k.removeprefix(prefix): v.to(parameter.device) for k, v in state.items() if k.startswith(prefix)}
        if found:
            adam.state[parameter] = found
    generator.set_state(state["generator"].cpu())
    return int(state["progress"][0]), float(state["progress"][1])


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
