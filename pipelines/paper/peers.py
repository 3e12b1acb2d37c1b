"""The others: every `Recipe` as a `Method`, and screened Poisson, which needs no training."""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...neural_fields.meshing import Mesh
from ..bench.cells import Cell, Findings, Method, Workplace
from ..bench.fits import has_poisson, screened_poisson
from .judge import Judge
from .protocol import oriented_cloud, protocol_of
from .recipe import Recipe

__all__ = ["FromRecipe", "Poisson"]


class FromRecipe(Method):
    """A recipe, trained on the cell's cloud, and the figures of each of its outputs."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.name, self.source, self.differs = recipe.name, recipe.source, recipe.differs

    def settings(self, cell: Cell) -> Mapping[str, Any]:
        """Size and schedule at the cell's preset."""
        return {"recipe": repr(self.recipe.presets[cell.preset])}

    def run(self, cell: Cell, work: Workplace) -> Findings:
        """Train, then measure every output."""
        judge, cloud = Judge(cell, work), oriented_cloud(cell)
        trained = self.recipe.train(cloud, cell.preset, seed=cell.seed, device=work.device, progress=work.progress)
        outputs = [
            judge.field(
                output.name,
                output.field,
                cloud.similarity,
                level=output.level,
                parameters=output.parameters,
                train_seconds=trained.seconds,
            )
            for output in trained.outputs
        ]
        return Findings(tuple(outputs), details={"steps": trained.steps})


class Poisson(Method):
    """Screened Poisson reconstruction.

    Args:
        trim: this part of the vertices, those of least density, is cut away, with their faces; 0 cuts nothing.
        smoothed: noise is smoothed off the cloud first, as our fit does, so that the rest of the two can be compared.
    """

    source = "Kazhdan and Hoppe 2013, octree depth 10"

    def __init__(self, *, trim: float = 0.0, smoothed: bool = False) -> None:
        self.trim, self.smoothed = trim, smoothed
        self.name = f"poisson{'-trim' if trim else ''}{'-smoothed' if smoothed else ''}"
        self.label = "Screened Poisson"
        self.differs = "MeshLab's implementation with its defaults; the paper's is Open3D's"
        if trim:
            self.label += f" ({trim:.0%} trim)"
            self.differs += "; the trim follows Open3D's rule"
        if smoothed:
            self.label += " (our smoothing)"
            self.differs += "; it gets the cloud from which ours has smoothed the noise, not the noisy one"

    def missing(self) -> str | None:
        """The extra, where it is not installed."""
        return None if has_poisson() else "needs pip install mplicits[poisson]"

    def run(self, cell: Cell, work: Workplace) -> Findings:
        """Reconstruct, and measure."""
        judge, cloud = Judge(cell, work), oriented_cloud(cell, smooth_noise=self.smoothed)
        importlib.import_module("pymeshlab")  # so that loading it is not timed
        started = time.perf_counter()
        surface = screened_poisson(cloud, depth=protocol_of(cell.preset).poisson_depth, trim=self.trim)
        seconds = time.perf_counter() - started
        mesh = Mesh(surface.vertices, surface.faces.astype(np.int32))
        return Findings((judge.mesh(self.label, mesh, cloud.similarity, train_seconds=seconds),))
