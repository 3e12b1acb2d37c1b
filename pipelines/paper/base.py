"""The finished fit that the variants of a table start from: a cell of our own method, shared with every other table."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ...datasets import OrientedCloud
from ...neural_fields import Field, MultiscaleSDF, Similarity, load_field
from ..bench.cells import Cell, Workplace
from ..fit.cloud import CloudDistance
from ..fit.train import prepare, review_points
from ..run.folder import find_field
from ..run.settings import FitConfig
from .levels import up_to
from .ours import Ours, our_config
from .protocol import damaged_cloud

__all__ = ["Base", "base_cell", "base_of", "reviewed"]


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
        return CloudDistance(points, normals, noise=self.cloud.noise)


def base_cell(cell: Cell, overrides: tuple[tuple[str, Any], ...] = ()) -> Cell:
    """The cell of our own method on the same cloud, with its own settings or others."""
    return dataclasses.replace(cell, method=Ours.name, overrides=overrides)


def base_of(cell: Cell, work: Workplace, overrides: tuple[tuple[str, Any], ...] = ()) -> Base:
    """Load that fit; train it first if nobody has.

    Raises:
        InputError: the cloud cannot be read or used.
    """
    wanted = base_cell(cell, overrides)
    assert work.first is not None
    saved = load_field(find_field(work.first(wanted).run()), device=work.device)
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
