"""nerfstudio's two NeuS models around a multiscale field: on any device, and without tiny-cuda-nn."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Tuple, Type, cast  # noqa: UP035 - as nerfstudio writes what it makes flags of
from urllib.error import URLError

import torch
import torchmetrics.image.lpip as lpip  # pyright: ignore[reportMissingImports]
from nerfstudio.configs.base_config import InstantiateConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.engine.callbacks import (  # pyright: ignore[reportMissingImports]
    TrainingCallback,
    TrainingCallbackLocation,
)
from nerfstudio.field_components.field_heads import FieldHeadNames  # pyright: ignore[reportMissingImports]
from nerfstudio.models.neus import NeuSModel, NeuSModelConfig  # pyright: ignore[reportMissingImports]
from nerfstudio.models.neus_facto import NeuSFactoModel, NeuSFactoModelConfig  # pyright: ignore[reportMissingImports]
from torch import Tensor, nn

from ...neural_fields import ColorNetwork, MultiscaleSDF, NerfstudioField, Siren, fit_sphere
from ...neural_fields.hosts.learning_rates import HOST_RATE
from ...neural_fields.networks.grids import HashEncoding, split_tables
from ..training.settings import ReconstructConfig
from .schedule import WarmCosine

OURS = ReconstructConfig()  # colours are those of `mplicits reconstruct`
COLOR_RATE = OURS.color_rate * OURS.learning_rate
# Peak rates of Adam for the groups of parameters; the geometry is made to suit its own (`rescale_parameters`).
RATES = {
    "fields": HOST_RATE,
    "colors": COLOR_RATE,
    "color_grid": OURS.grid_rate * COLOR_RATE,
    "deviation": OURS.sharpening * OURS.learning_rate,
    "field_background": HOST_RATE,
}


@dataclass
class MultiscaleFieldConfig(InstantiateConfig):
    """Geometry and colours; takes the place of nerfstudio's ``SDFFieldConfig``."""

    _target: Type = field(default_factory=lambda: cast(Any, build_field))  # noqa: UP006
    widths: Tuple[int, ...] = (128, 256)  # noqa: UP006
    """Neurons per layer of each level, coarse to fine."""
    depths: Tuple[int, ...] = (2, 3)  # noqa: UP006
    """Sine layers of each level."""
    omegas: Tuple[float, ...] = (10.0, 30.0)  # noqa: UP006
    """SIREN frequency of each level."""
    features: int = 32
    """Numbers that the geometry hands to the colour network beside the normal."""
    taper: float = 0.3
    """Share of a band over which the next level fades out."""
    radius: float = 0.5
    """Of the sphere that the geometry begins as, in half sides of the scene box."""
    band: float = 4.0
    """Half-width of the bands in units of the surface's uncertainty 1/s."""
    least_band: float = 0.02
    """Half-width that a band keeps, in units of the sphere around the scene box."""
    widest_band: float = 0.3
    """Half-width that a band begins with and does not exceed, in the same units."""
    color_width: int = OURS.color_width
    """Neurons per layer of the colour network."""
    color_depth: int = OURS.color_depth
    """Layers of the colour network."""
    color_frequencies: int = OURS.color_frequencies
    """Octaves of the position that the colour network sees."""
    color_grid: int = OURS.color_grid
    """Cells along the finest grid of the hash encoding that the colour network sees; 0 for none."""
    deviation: float = 0.3
    """Where the deviation begins: s = exp(10 v)."""
    learning_rate: float = HOST_RATE
    """Peak rate of the optimiser of "fields", which the geometry is made to suit; change both together."""


def build_field(config: MultiscaleFieldConfig, *, aabb: Tensor, **_: object) -> NerfstudioField:
    """The untrained field of a scene, a sphere of unknown colour, in the scene box ``aabb`` ``(2, 3)``.

    The hash encoding of its colours covers the cube around the box. What else nerfstudio hands to its field is ignored.
    """
    sdf = MultiscaleSDF.from_widths(
        list(zip(config.widths, config.depths, strict=True)),
        omegas=config.omegas,
        deltas=[config.widest_band] * (len(config.widths) - 1),
        taper=config.taper,
        num_features=config.features,
        residual_gain=0.01,
    )
    finest, extent = config.color_grid, float(aabb.abs().max())
    color = ColorNetwork(
        config.features,
        width=config.color_width,
        depth=config.color_depth,
        point_frequencies=config.color_frequencies,
        grid=HashEncoding.up_to(finest, extent=extent) if finest else None,
    )
    shell = NerfstudioField(
        sdf, color, heads=FieldHeadNames, bounds=aabb, deviation=config.deviation, learning_rate=config.learning_rate
    )
    assert isinstance(sdf.base, Siren)
    with torch.enable_grad():
        fit_sphere(sdf.base, config.radius * float((aabb[1] - aabb[0]).min()) / 2 * shell.scale)
    return shell


class _Multiscale:
    """What both models change in nerfstudio's; to be mixed in before them."""

    config: Any
    field: NerfstudioField

    def populate_modules(self) -> None:
        """Build everything as nerfstudio does, with our field by its config; the perceptual metric waits."""
        with _metric_later():
            super().populate_modules()  # pyright: ignore[reportAttributeAccessIssue]
        self.anneal_end = self.config.anneal_end

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Those of nerfstudio, its "fields" in parts which want rates of their own: see `RATES`."""
        groups: dict[str, list[nn.Parameter]] = super().get_param_groups()  # pyright: ignore[reportAttributeAccessIssue]
        grid, groups["colors"] = split_tables(self.field.color)
        groups["fields"] = list(self.field.field.parameters())
        groups["deviation"] = list(self.field.deviation_network.parameters())
        return groups | ({"color_grid": grid} if grid else {})

    def get_training_callbacks(self, training_callback_attributes: Any) -> list[Any]:
        """Those of nerfstudio, and bands that follow the deviation; schedules learn how long this training is."""
        trainer = training_callback_attributes.trainer
        steps = trainer._start_step + trainer.config.max_num_iterations  # a resumed one does as many again
        for scheduler in training_callback_attributes.optimizers.schedulers.values():
            for factor in scheduler.lr_lambdas:
                owner = getattr(factor, "__self__", None)
                if isinstance(owner, WarmCosine):
                    owner.steps = steps
        self.anneal_end = min(self.config.anneal_end, math.ceil(self.config.anneal_most * steps))
        before = super().get_training_callbacks(training_callback_attributes)  # pyright: ignore[reportAttributeAccessIssue]
        place = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        return [*before, TrainingCallback(where_to_run=place, update_every_num_iters=1, func=self.follow)]

    def follow(self, step: int) -> None:
        """Narrow the bands; nerfstudio calls it before each step."""
        sizes = self.config.sdf_field
        self.field.follow(band=sizes.band, least=sizes.least_band, most=sizes.widest_band)


@dataclass
class _MultiscaleConfig:
    """The settings that both models have in place of nerfstudio's; to be mixed in before its own."""

    sdf_field: MultiscaleFieldConfig = field(default_factory=MultiscaleFieldConfig)
    """Geometry and colours."""
    anneal_end: int = 4000
    """Step from which slopes are taken as they are; NeuS's cosine annealing."""
    anneal_most: float = 0.2
    """Share of the training that the annealing takes at most."""


@dataclass
class MultiscaleModelConfig(_MultiscaleConfig, NeuSModelConfig):
    """The NeuS of nerfstudio with our field."""

    _target: Type = field(default_factory=lambda: MultiscaleModel)  # noqa: UP006


class MultiscaleModel(_Multiscale, NeuSModel):
    """``ns-train mplicits``."""


@dataclass
class MultiscaleFactoModelConfig(_MultiscaleConfig, NeuSFactoModelConfig):
    """The NeuS-facto of nerfstudio, which samples by proposal networks, with our field."""

    _target: Type = field(default_factory=lambda: MultiscaleFactoModel)  # noqa: UP006


class MultiscaleFactoModel(_Multiscale, NeuSFactoModel):
    """``ns-train mplicits-facto``."""


class LaterMetric(nn.Module):
    """A metric that ``build`` makes when it is first asked for; NaN where its weights cannot be downloaded."""

    def __init__(self, build: Any) -> None:
        super().__init__()
        self._build = build
        self._found: list[Any] = []  # in a list it is no submodule, whose weights would be in some checkpoints only

    def forward(self, *pictures: Tensor) -> Tensor:
        """What the metric says of the pictures, a 0-d tensor."""
        if not self._found:
            try:
                self._found.append(self._build())
            except (URLError, OSError) as error:
                print(f"no LPIPS: its weights cannot be downloaded ({error})")
                self._found.append(None)
        (metric,) = self._found
        return torch.tensor(torch.nan) if metric is None else metric.to(pictures[0].device)(*pictures)


@contextmanager
def _metric_later() -> Iterator[None]:
    """LPIPS is built with the model otherwise, and downloads a network before a training may begin."""
    eager = lpip.LearnedPerceptualImagePatchSimilarity
    lpip.LearnedPerceptualImagePatchSimilarity = lambda *args, **options: LaterMetric(lambda: eager(*args, **options))
    try:
        yield
    finally:
        lpip.LearnedPerceptualImagePatchSimilarity = eager
