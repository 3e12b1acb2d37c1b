"""The finished fit that the variants of a table start from, and single levels trained anew from the fit's own pieces.

The fit is a job of our own method, shared with every other table.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mplicits.datasets import OrientedCloud
from mplicits.neural_fields import Field, MultiscaleSDF, Similarity, Siren, load_field
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.level import LevelObjective, new_level
from mplicits.pipelines.fit.review import review_points
from mplicits.pipelines.fit.samples import (
    Source,
    band_of,
    distance_samples,
    level_weights,
    surface_samples,
    with_previous,
)
from mplicits.pipelines.fit.train import prepare
from mplicits.pipelines.training.folder import find_field
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import Report, Trainer

from ..harness.jobs import Context
from .jobs import PaperJob
from .judge import damaged_cloud
from .ours import Ours, our_config


@dataclass(frozen=True)
class Base:
    """A finished fit and what it was fitted to.

    Attributes:
        field: all levels, frozen, on the device of the work.
        similarity: from input to unit-sphere coordinates.
        config: the settings it was fitted with.
        cloud: what its residual levels learnt from.
    """

    field: MultiscaleSDF
    similarity: Similarity
    config: FitConfig
    cloud: OrientedCloud

    def index(self) -> CloudDistance:
        """Distances to the cloud."""
        points, normals = torch.from_numpy(self.cloud.points), torch.from_numpy(self.cloud.normals)
        return CloudDistance(points, normals, noise=self.cloud.noise, guessed=self.cloud.estimated)


def base_job(job: PaperJob, overrides: tuple[tuple[str, Any], ...] = ()) -> PaperJob:
    """The job of our own method on the same cloud, with its own settings or others."""
    return dataclasses.replace(job, method=Ours.name, overrides=overrides)


def base_of(job: PaperJob, context: Context, overrides: tuple[tuple[str, Any], ...] = ()) -> Base:
    """Load that fit; train it first if there is none.

    Raises:
        InputError: the cloud cannot be read or used.
    """
    wanted = base_job(job, overrides)
    assert context.first is not None
    saved = load_field(find_field(context.first(wanted).run()), device=context.device)
    assert isinstance(saved.field, MultiscaleSDF)
    config = our_config(wanted)
    cloud = reviewed(prepare(damaged_cloud(wanted), config), up_to(saved.field, 0), config)
    return Base(saved.field, saved.similarity, config, cloud)


def reviewed(cloud: OrientedCloud, coarse: Field, config: FitConfig) -> OrientedCloud:
    """The cloud as the fit's residual levels see it, after ``coarse``, its level 0, has judged it."""
    points, normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
    found = review_points(
        points,
        normals,
        coarse,
        device=coarse.like.device,
        outliers=config.drop_outliers,
        turn=config.turn_normals and config.normals == "auto",
    )
    kept = ~found.dropped
    turned = np.where(found.turned[:, None], -cloud.normals, cloud.normals)
    colors = None if cloud.colors is None else cloud.colors[kept]
    return dataclasses.replace(cloud, points=cloud.points[kept], normals=turned[kept], colors=colors)


def up_to(field: MultiscaleSDF, level: int) -> MultiscaleSDF:
    """The levels of a field up to and with ``level``, shared, not copied."""
    return MultiscaleSDF(field.base, field.levels[1 : level + 1], field.deltas[:level])


def without_bands(field: MultiscaleSDF) -> MultiscaleSDF:
    """The plain sum of a field's levels, everywhere."""
    deltas = torch.full_like(field.deltas, math.inf)
    return MultiscaleSDF(field.base, field.levels[1:], deltas)


@torch.no_grad()
def delta_after(index: CloudDistance, previous: Field, config: FitConfig) -> float:
    """Half-width of the band around the finest level of ``previous`` (Eq. 5)."""
    points = torch.from_numpy(index.points).to(previous.like.device)
    values = torch.cat([previous.value(part) for part in points.split(1 << 18)]).cpu()
    return band_of(values, epsilon=config.epsilon, quantile=config.quantile).delta


def domain_sources(
    index: CloudDistance, previous: MultiscaleSDF, config: FitConfig, *, generator: torch.Generator
) -> list[Source]:
    """What a residual learns from on the whole domain: distances everywhere, as level 0 of the fit does."""
    everywhere, device = without_bands(previous), previous.like.device
    spread = distance_samples(index, config.samples, generator=generator)
    surface, domain = (with_previous(s, everywhere, math.inf, device=device) for s in (surface_samples(index), spread))
    data, normal, eikonal = level_weights(config, surface.known("value")[0], index)
    half = config.batch // 2
    return [
        Source("surface", surface, half, data, normal, eikonal),
        Source("domain", domain, half, data * config.domain_weight, 0.0, eikonal),
    ]


def on_its_own(sources: Sequence[Source]) -> list[Source]:
    """The same samples for a level that is no residual: what the levels before say is taken out."""
    return [
        dataclasses.replace(source, samples=dataclasses.replace(source.samples, value=None, gradient=None))
        for source in sources
    ]


def train_level(
    level: int,
    sources: Sequence[Source],
    config: FitConfig,
    *,
    generator: torch.Generator,
    residual: bool = True,
    progress: Report | None = None,
    stage: str = "",
) -> Siren:
    """Train one new SIREN as level ``level`` of the fit would be, from the same start.

    Args:
        level: whose width, depth, frequency, steps and rates in ``config``.
        sources: what it learns from.
        config: settings of the fit.
        generator: draws the batches.
        residual: whether it starts small, as what is added to others does.
        progress: told now and then.
        stage: name for ``progress``.
    """
    siren = new_level(config, level, residual=residual).to(sources[0].samples.points.device)
    rate, turn = config.learning_rates[level], config.turn
    objective = LevelObjective(siren, sources, learning_rate=rate, turn=turn, generator=generator)
    Trainer(objective, stage=stage or f"level {level}", steps=config.steps[level]).run(report=progress)
    return siren.requires_grad_(False)


def generator_for(config: FitConfig, level: int) -> torch.Generator:
    """The generator that the fit draws a level's samples and batches with."""
    return torch.Generator().manual_seed(config.seed * 1009 + level)
