"""The methods: ours, whose levels are coarse, medium and fine rows of the paper, recipes, and screened Poisson."""

from __future__ import annotations

import dataclasses
import importlib
import time
from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import numpy as np
from mplicits.neural_fields.meshing.extract import Mesh
from mplicits.pipelines.surface.surface import read_support
from mplicits.pipelines.training.folder import FIELD_FILE
from mplicits.pipelines.training.settings import FitConfig

from ..harness.jobs import Context, Method, Results
from ..shapes.fits import has_poisson, kept_fit, screened_poisson, stage_seconds
from .jobs import PaperJob
from .judge import Judge, damaged_cloud, fit_config, oriented_cloud, protocol_of
from .recipe import Recipe

LIPSCHITZ = 1.25  # the eikonal term keeps |∇f| near 1


def our_config(job: PaperJob) -> FitConfig:
    """The preset's settings with what the job overrides.

    Raises:
        ValueError: a setting is out of range.
    """
    return dataclasses.replace(fit_config(job.preset), **dict(job.overrides), seed=job.seed)


def level_names(count: int) -> list[str]:
    """Names of the outputs, as in the paper's tables.

    Example:
        >>> level_names(3)
        ['Ours coarse', 'Ours medium', 'Ours fine']
    """
    middle = ["medium"] if count == 3 else [f"medium {i}" for i in range(1, count - 1)]
    return [f"Ours {name}" for name in ["coarse", *middle, "fine"][:count]]


class Ours(Method[PaperJob]):
    """One training; every level is an output, with the time and the parameters up to and with it."""

    name = "ours"
    source = "the paper, Sec. 3.2 and Eq. 4 and 5"
    differs = (
        "distances come from the cloud, not from a mesh; see docs/fit.md. The cpu preset is the preset fast of "
        "`mplicits fit`, whose finest level is (256, 2), not (400, 2)"
    )

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """All settings of the fit but the device, and those of how a table is read."""
        left_out = ("device", "columns", "drop_noise")
        return {"fit": {k: v for k, v in dataclasses.asdict(our_config(job)).items() if k not in left_out}}

    def run(self, job: PaperJob, context: Context) -> Results:
        """Fit, and measure every level; an interrupted fit goes on, and a finished one is reused."""
        judge, directory = Judge(job, context), context.run()
        config = dataclasses.replace(our_config(job), device=context.device)
        run = kept_fit(directory, damaged_cloud(job), config, progress=context.progress)
        stages = run.record["stages"]
        seconds = accumulate(map(stage_seconds, stages))
        parameters = accumulate(stage["parameters"] for stage in stages)
        outputs = [
            judge.field(
                name,
                run.field,
                run.similarity,
                level=level,
                parameters=count,
                train_seconds=spent,
                lipschitz=LIPSCHITZ,
                support=read_support(directory / FIELD_FILE, run.record, level),
            )
            for level, (name, spent, count) in enumerate(
                zip(level_names(len(stages)), seconds, parameters, strict=True)
            )
        ]
        details = {"cleaning": run.record["cleaning"], "stages": stages}
        return Results(tuple(outputs), tuple(run.record["deltas"]), details)


class FromRecipe(Method[PaperJob]):
    """A recipe, trained on the job's cloud, and the figures of each of its outputs."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.name, self.source, self.differs = recipe.name, recipe.source, recipe.differs

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """Size and schedule at the job's preset."""
        return {"recipe": repr(self.recipe.presets[job.preset])}

    def run(self, job: PaperJob, context: Context) -> Results:
        """Train, then measure every output."""
        judge, cloud = Judge(job, context), oriented_cloud(job)
        trained = self.recipe.train(cloud, job.preset, seed=job.seed, device=context.device, progress=context.progress)
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
        return Results(tuple(outputs), details={"steps": trained.steps})


class Poisson(Method[PaperJob]):
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

    def run(self, job: PaperJob, context: Context) -> Results:
        """Reconstruct, and measure."""
        judge, cloud = Judge(job, context), oriented_cloud(job, smooth_noise=self.smoothed)
        importlib.import_module("pymeshlab")  # so that loading it is not timed
        started = time.perf_counter()
        surface = screened_poisson(cloud, depth=protocol_of(job.preset).poisson_depth, trim=self.trim)
        seconds = time.perf_counter() - started
        mesh = Mesh(surface.vertices, surface.faces.astype(np.int32))
        return Results((judge.mesh(self.label, mesh, cloud.similarity, train_seconds=seconds),))
