"""One level's training: draw from the samples, sum the terms of Eq. 4, step Adam; interruptible and resumable."""

from __future__ import annotations

import math
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import torch
from torch import Tensor, nn

__all__ = ["Interrupted", "Progress", "StopFlag", "pack_training", "set_rate", "stop_on_signals", "unpack_training"]


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


class Interrupted(Exception):  # noqa: N818  what happened is no error
    """Training was asked to stop, and a usable checkpoint was written.

    Attributes:
        directory: the run directory, for ``--resume``; None if the fit had none.
    """

    def __init__(self, directory: Path | None) -> None:
        super().__init__("interrupted" if directory is None else f"interrupted; checkpoint in {directory}")
        self.directory = directory
