"""The part of nerfstudio that our methods use, so that they can be tested where it is not installed."""

import enum
import sys
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from hosts import Heads, ray_samples
from torch import Tensor, nn


@dataclass
class Config:
    """``InstantiateConfig``: builds what its target names, with itself as the first argument."""

    _target: Any = None

    def setup(self, **options: Any) -> Any:
        return self._target(self, **options)


class Kept(SimpleNamespace):
    """Any configuration that is only carried along."""


class Location(enum.Enum):
    BEFORE_TRAIN_ITERATION = enum.auto()


class Lpips(nn.Module):
    """Downloads its weights when it is built; there is no network."""

    def __init__(self) -> None:
        raise OSError("no network")


@dataclass
class ModelConfig(Config):
    sdf_field: Any = None
    num_samples: int = 64
    num_samples_importance: int = 64
    eval_num_rays_per_chunk: int = 4096
    background_model: str = "mlp"


class Model(nn.Module):
    """What ``NeuSModel`` does with its field."""

    def __init__(self, config: ModelConfig, scene_box: Any, num_train_data: int) -> None:
        super().__init__()
        self.config, self.scene_box, self.num_train_data = config, scene_box, num_train_data
        self.populate_modules()

    def populate_modules(self) -> None:
        options = {"spatial_distortion": None, "use_average_appearance_embedding": False}
        self.field = self.config.sdf_field.setup(aabb=self.scene_box.aabb, num_images=self.num_train_data, **options)
        self.lpips = sys.modules["torchmetrics.image.lpip"].LearnedPerceptualImagePatchSimilarity()
        self.anneal_end = 50000

    def get_training_callbacks(self, attributes: Any) -> list[Any]:
        def anneal(step: int) -> None:
            self.field.set_cos_anneal_ratio(min(1.0, step / self.anneal_end))

        return [Kept(where_to_run=[Location.BEFORE_TRAIN_ITERATION], update_every_num_iters=1, func=anneal)]

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"fields": list(self.field.parameters())}

    def step(self, depths: Tensor) -> Tensor:
        samples = ray_samples(depths)
        with torch.no_grad():
            self.field.get_sdf(samples)
        outputs = self.field(samples, return_alphas=True)
        eikonal = ((outputs[Heads.GRADIENT].norm(dim=-1) - 1) ** 2).mean()
        return (outputs[Heads.RGB] - 0.5).abs().mean() + outputs[Heads.ALPHA].mean() + 0.1 * eikonal


class SchedulerConfig(Config):
    pass


class Scheduler:
    def __init__(self, config: SchedulerConfig) -> None:
        self.config = config


@dataclass
class Specification:
    config: Any = None
    description: str = ""


MODULES: dict[str, dict[str, Any]] = {
    "torchmetrics.image.lpip": {"LearnedPerceptualImagePatchSimilarity": Lpips},
    "nerfstudio.configs.base_config": {"InstantiateConfig": Config, "ViewerConfig": Kept},
    "nerfstudio.data.datamanagers.base_datamanager": {"VanillaDataManagerConfig": Kept},
    "nerfstudio.data.dataparsers.nerfstudio_dataparser": {"NerfstudioDataParserConfig": Kept},
    "nerfstudio.engine.callbacks": {"TrainingCallback": Kept, "TrainingCallbackLocation": Location},
    "nerfstudio.engine.optimizers": {"AdamOptimizerConfig": Kept},
    "nerfstudio.engine.schedulers": {"Scheduler": Scheduler, "SchedulerConfig": SchedulerConfig},
    "nerfstudio.engine.trainer": {"TrainerConfig": Kept},
    "nerfstudio.field_components.field_heads": {"FieldHeadNames": Heads},
    "nerfstudio.models.neus": {"NeuSModel": Model, "NeuSModelConfig": ModelConfig},
    "nerfstudio.models.neus_facto": {"NeuSFactoModel": Model, "NeuSFactoModelConfig": ModelConfig},
    "nerfstudio.pipelines.base_pipeline": {"VanillaPipelineConfig": Kept},
    "nerfstudio.plugins.types": {"MethodSpecification": Specification},
    "nerfstudio.utils.eval_utils": {},
}
PLUGIN = "mplicits.pipelines.nerfstudio."


def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make ``import nerfstudio…`` lead here, and our methods be loaded anew on top of it."""
    for name, contents in MODULES.items():
        for end in [index for index, letter in enumerate(name) if letter == "."]:
            if name[:end] not in MODULES:
                monkeypatch.setitem(sys.modules, name[:end], ModuleType(name[:end]))
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, own = name.rpartition(".")
        setattr(sys.modules[parent], own, module)
    for name in [name for name in sys.modules if name.startswith(PLUGIN)]:
        monkeypatch.delitem(sys.modules, name)
