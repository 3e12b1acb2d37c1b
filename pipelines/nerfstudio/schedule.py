"""Learning rates of a nerfstudio training: a linear warm-up, then a cosine, as long as the training is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Optional, Type  # noqa: UP035 - as nerfstudio writes what it makes flags of

from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig  # pyright: ignore[reportMissingImports]
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

STEPS = 20_000


@dataclass
class WarmCosineConfig(SchedulerConfig):
    """A linear warm-up, then a cosine down to a share of the rate.

    nerfstudio's own computes with NumPy, whose numbers are then in the checkpoints, and PyTorch from 2.6 on does
    not read them again.
    """

    _target: Type = field(default_factory=lambda: WarmCosine)  # noqa: UP006
    warm_up_end: int = 500
    """Steps of the warm-up; at most a tenth of the training."""
    max_steps: Optional[int] = None  # noqa: UP045
    """Steps until the rate is at its least; None: all of the training."""
    least: float = 0.05
    """Share of the rate that is left."""


class WarmCosine(Scheduler):
    """See `WarmCosineConfig`.

    Attributes:
        steps: of the training, which the model says when it knows.
    """

    config: WarmCosineConfig
    steps: int = STEPS

    def factor(self, step: int) -> float:
        """The rate at a step, in units of the peak."""
        config = self.config
        end = self.steps if config.max_steps is None else config.max_steps
        warm = min(config.warm_up_end, int(0.1 * end))
        if step < warm:
            return (step + 1) / (warm + 1)
        done = min(1.0, (step - warm) / max(1, end - warm))
        return config.least + (1 - config.least) * 0.5 * (1 + math.cos(math.pi * done))

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """The schedule of one optimiser."""
        return LambdaLR(optimizer, self.factor)
