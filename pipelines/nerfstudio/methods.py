"""The methods as nerfstudio's entry points find them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Type  # noqa: UP035 - as nerfstudio writes what it makes flags of

from nerfstudio.configs.base_config import ViewerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.data.datamanagers.base_datamanager import (  # pyright: ignore[reportMissingImports]
    VanillaDataManagerConfig,
)
from nerfstudio.data.dataparsers.nerfstudio_dataparser import (  # pyright: ignore[reportMissingImports]
    NerfstudioDataParserConfig,
)
from nerfstudio.engine.optimizers import AdamOptimizerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.engine.trainer import TrainerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.plugins.types import MethodSpecification  # pyright: ignore[reportMissingImports]
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from ...neural_fields.rates import HOST_RATE
from .model import MultiscaleFactoModelConfig, MultiscaleModelConfig

__all__ = ["WarmCosine", "WarmCosineConfig", "mplicits", "mplicits_facto"]

STEPS = 20_000


@dataclass
class WarmCosineConfig(SchedulerConfig):
    """A linear warm-up, then a cosine down to a share of the rate.

    nerfstudio's own computes with NumPy, whose numbers are then in the checkpoints, and PyTorch from 2.6 on does
    not read them again.
    """

    _target: Type = field(default_factory=lambda: WarmCosine)  # noqa: UP006
    warm_up_end: int = 500
    """Steps of the warm-up."""
    max_steps: int = STEPS
    """Steps until the rate is at its least."""
    least: float = 0.05
    """Share of the rate that is left."""


class WarmCosine(Scheduler):
    """See `WarmCosineConfig`."""

    config: WarmCosineConfig

    def factor(self, step: int) -> float:
        """The rate at a step, in units of the peak."""
        config = self.config
        if step < config.warm_up_end:
            return (step + 1) / (config.warm_up_end + 1)
        done = min(1.0, (step - config.warm_up_end) / max(1, config.max_steps - config.warm_up_end))
        return config.least + (1 - config.least) * 0.5 * (1 + math.cos(math.pi * done))

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """The schedule of one optimiser."""
        return LambdaLR(optimizer, self.factor)


def _trainer(name: str, model: Any, groups: dict[str, float]) -> Any:
    """A training with one optimiser for each group of parameters, by its rate."""
    return TrainerConfig(
        method_name=name,
        steps_per_eval_image=1000,
        steps_per_eval_batch=1000,
        steps_per_save=1000,
        steps_per_eval_all_images=10**9,
        max_num_iterations=STEPS,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                # A surface is looked for in the scene box, so what the cameras look at belongs in its middle. Their own
                # middle, nerfstudio's default, is beside it where they stand on one side.
                dataparser=NerfstudioDataParserConfig(center_method="focus"),
                train_num_rays_per_batch=512,
                eval_num_rays_per_batch=512,
            ),
            model=model,
        ),
        optimizers={
            group: {"optimizer": AdamOptimizerConfig(lr=rate, eps=1e-15), "scheduler": WarmCosineConfig()}
            for group, rate in groups.items()
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 13),
        vis="viewer",
    )


mplicits = MethodSpecification(
    config=_trainer(
        "mplicits",
        MultiscaleModelConfig(eval_num_rays_per_chunk=1024),
        {"fields": HOST_RATE, "field_background": HOST_RATE},
    ),
    description="Nested multiscale SIRENs as surface, rendered as in NeuS; on GPU or CPU.",
)

mplicits_facto = MethodSpecification(
    config=_trainer(
        "mplicits-facto",
        MultiscaleFactoModelConfig(background_model="none", eval_num_rays_per_chunk=1024),
        {"fields": HOST_RATE, "field_background": HOST_RATE, "proposal_networks": 1e-2},
    ),
    description="The same, with samples from proposal networks; on GPU or CPU.",
)
