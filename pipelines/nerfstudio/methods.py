"""The methods as nerfstudio's entry points find them."""

from __future__ import annotations

from typing import Any

from nerfstudio.configs.base_config import ViewerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.data.datamanagers.base_datamanager import (  # pyright: ignore[reportMissingImports]
    VanillaDataManagerConfig,
)
from nerfstudio.data.dataparsers.nerfstudio_dataparser import (  # pyright: ignore[reportMissingImports]
    NerfstudioDataParserConfig,
)
from nerfstudio.engine.optimizers import AdamOptimizerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.engine.trainer import TrainerConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.plugins.types import MethodSpecification  # pyright: ignore[reportMissingImports]

from .model import RATES, MultiscaleFactoModelConfig, MultiscaleModelConfig
from .schedule import STEPS, WarmCosineConfig


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
                # middle, nerfstudio's default, is beside it where they stand on one side. They are twice as far away as
                # by default, on the box: what they look at then fills half of it, and not a quarter.
                dataparser=NerfstudioDataParserConfig(center_method="focus", scale_factor=2.0),
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
        MultiscaleModelConfig(num_samples=48, num_samples_importance=16, eval_num_rays_per_chunk=1024),
        RATES,
    ),
    description="Nested multiscale SIRENs as surface, rendered as in NeuS; on GPU or CPU.",
)

mplicits_facto = MethodSpecification(
    config=_trainer(
        "mplicits-facto",
        MultiscaleFactoModelConfig(background_model="none", eval_num_rays_per_chunk=1024),
        RATES | {"proposal_networks": 1e-2},
    ),
    description="The same, with samples from proposal networks; on GPU or CPU.",
)
