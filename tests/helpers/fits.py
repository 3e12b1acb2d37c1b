"""What tests of fits share: small settings, Ctrl-C at a chosen step, fields that are the same to the bit."""

import os
import signal
from collections.abc import Callable

import torch
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import Progress
from torch import nn

SMALL = FitConfig(
    widths=(32, 48),
    depths=(2, 2),
    omegas=(10.0, 15.0),
    steps=(150, 80),
    learning_rates=(3e-3, 1e-3),
    batch=1024,
    samples=20_000,
)


def interrupt(stage: str, step: int, number: int = signal.SIGINT) -> Callable[[Progress], None]:
    """A progress display that sends this process a signal at a step of a stage."""

    def report(progress: Progress) -> None:
        if progress.stage == stage and progress.step == step:
            os.kill(os.getpid(), number)

    return report


def assert_same(one: nn.Module, other: nn.Module) -> None:
    """That two fields have the same tensors, to the bit."""
    torch.testing.assert_close(one.state_dict(), other.state_dict(), rtol=0, atol=0)
