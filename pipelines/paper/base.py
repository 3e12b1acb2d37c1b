"""The finished fit that the variants of a table start from: a cell of our own method, shared with every other table."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch

from ...datasets import OrientedCloud
from ...neural_fields import MultiscaleSDF, Similarity, load_field
from ..cloud_distance import CloudDistance
from ..fit import prepare
from ..fit_config import FitConfig
from ..runs import find_field
from .cell import Cell
from .method import Workplace
from .ours import Ours, our_config
from .protocol import damaged_cloud

__all__ = ["Base", "base_cell", "base_of"]


@dataclass(frozen=True)
class Base:
    """A finished fit and what it was fitted to.

    Attributes:
        field: all levels, frozen, on the device of the work.
        similarity: from input to unit-sphere coordinates.
        config: the settings it was fitted with.
        cloud: what it learnt from.
    """

    field: MultiscaleSDF
    similarity: Similarity
    config: FitConfig
    cloud: OrientedCloud

    def index(self) -> CloudDistance:
        """Distances to the cloud."""
        return CloudDistance(torch.from_numpy(self.cloud.points), torch.from_numpy(self.cloud.normals))


def base_cell(cell: Cell, overrides: tuple[tuple[str, Any], ...] = ()) -> Cell:
    """The cell of our own method on the same cloud, with its own settings or others."""
    return dataclasses.replace(cell, method=Ours.name, overrides=overrides)


def base_of(cell: Cell, work: Workplace, overrides: tuple[tuple[str, Any], ...] = ()) -> Base:
    """Load that fit; train it first if nobody has.

    Raises:
        InputError: the cloud cannot be read or used.
    """
    from .run import cell_key, run_cell  # the list of methods, which `run` needs, names those that need this

    wanted = base_cell(cell, overrides)
    run_cell(wanted, work.out, device=work.device, progress=work.progress)
    directory = dataclasses.replace(work, key=cell_key(wanted, Ours())).run()
    saved = load_field(find_field(directory), device=work.device)
    assert isinstance(saved.field, MultiscaleSDF)
    config = our_config(wanted)
    return Base(saved.field, saved.similarity, config, prepare(damaged_cloud(wanted), config))
