"""Benchmark ``consistency``: what comparing photographs with each other is worth, on an exact scene."""

from __future__ import annotations

import dataclasses
import functools
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any
from unittest import mock

from mplicits.datasets.synthetic.scenes import SCENES, render_scene, scene_mesh
from mplicits.neural_fields import InputError, extract_mesh
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.reconstruct import objective
from mplicits.pipelines.reconstruct.consistency import Surface
from mplicits.pipelines.reconstruct.train import reconstruct
from mplicits.pipelines.reconstruct.views import count_views
from mplicits.pipelines.surface.measure import evaluate_surfaces
from mplicits.pipelines.surface.surface import in_region
from mplicits.pipelines.training.settings import ReconstructConfig
from torch import Tensor

from ..harness.benchmark import Benchmark, Part, plain
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from ..shapes.roughness import surface_roughness

THOUSANDTHS = 1e3
# Losses that a training of each choice of parts leaves out; that of none has no weight for the whole term.
PARTS: Mapping[str, Sequence[str]] = MappingProxyType(
    {"none": (), "correlation": ("flatness_loss",), "flatness": ("consistency_loss",), "both": ()}
)


@dataclass(frozen=True)
class ConsistencyRow:
    """A training and its surface; distances are in radii of the region, where a photograph sees the true surface.

    Attributes:
        parts: of the term, one of `PARTS`.
        seed: of the training.
        steps: of the training.
        seconds: of the processor, for the training and what comes after it.
        memory: the largest of the process so far, in MiB.
        psnr: of held-out views, in dB.
        accuracy: mean distance from the mesh to the true surface.
        completeness: the same the other way.
        floor: mean of both between two samplings of the true surface.
        flat_angle: median error of normals on flat places in degrees, see `roughness`.
        edge_angle: the same at sharp edges.
    """

    parts: str
    seed: int
    steps: int
    seconds: float
    memory: float
    psnr: float
    accuracy: float
    completeness: float
    floor: float
    flat_angle: float | None
    edge_angle: float | None


@dataclass(frozen=True, kw_only=True)
class ConsistencyBench(Benchmark[ConsistencyRow]):
    """The same training with and without each part of the term, in equal time if the settings have a time budget.

    Attributes:
        config: settings of all trainings, with the weight of the term.
        scene: a name of `SCENES`.
        views: number of pictures.
        size: their width and height in pixels.
        rays: of each pixel and direction.
        parts: names of `PARTS`, one for each training.
        seeds: of trainings, this many from that of the settings.
        resolution: of the meshes.
        eval_samples: points on each surface.
    """

    name = "consistency"
    source = "photographs compared with each other"
    row = ConsistencyRow
    apart = ("parts", "seeds", "config")
    config: ReconstructConfig
    scene: str = "corner"
    views: int = 49
    size: tuple[int, int] = (200, 150)
    rays: int = 2
    parts: Sequence[str] = tuple(PARTS)
    seeds: int = 1
    resolution: int = 256
    eval_samples: int = 300_000

    def jobs(self) -> list[Part]:
        """One for each choice of parts and each seed."""
        return [
            Part(self.name, f"{self.scene}, {parts}, seed {seed}", options=(("parts", parts), ("seed", seed)))
            for seed in range(self.config.seed, self.config.seed + self.seeds)
            for parts in self.parts
        ]

    def settings(self, job: Part) -> Mapping[str, Any]:
        """See `Benchmark.settings`."""
        return {**super().settings(job), "config": plain(self.config)}

    def measure(self, job: Part, context: Context) -> list[ConsistencyRow]:
        """See `Benchmark.measure`."""
        exact = SCENES[self.scene]()
        # Without its sparse points: they are exact, and lie on plain walls too, where COLMAP finds none.
        images = dataclasses.replace(
            render_scene(exact, self.views, self.size, samples=self.rays), points=None, observations=None
        )
        parts, seed = job.parameters["parts"], job.parameters["seed"]
        config = dataclasses.replace(self.config, texture_steps=0, device=self.device, seed=seed)
        started = time.process_time()
        weight = 0.0 if parts == "none" else config.consistency
        with only(parts):
            run = reconstruct(images, dataclasses.replace(config, consistency=weight), progress=context.progress)
        seconds = time.process_time() - started
        mesh = in_region(extract_mesh(run.field, resolution=self.resolution))
        if mesh is None:
            raise InputError(f"{job.name}: no surface in the region; train longer (--steps)")
        write_mesh(context.mesh("surface"), mesh, run.similarity)
        truth, seen = scene_mesh(exact, resolution=self.resolution), [(view.camera, view.mask) for view in images.views]
        counts = functools.partial(count_views, seen)
        visible = evaluate_surfaces(mesh, truth, samples=self.eval_samples, view_counts=counts).visible
        assert visible is not None
        rough = surface_roughness(mesh, truth, samples=self.eval_samples, seed=config.seed)
        accuracy, completeness = visible.distances.accuracy, visible.distances.completeness
        floor = visible.floors.overall
        if accuracy is None or completeness is None or floor is None:
            raise InputError(f"{job.name}: no photograph sees the surface; give more --views")
        return [
            ConsistencyRow(
                parts=parts,
                seed=seed,
                steps=run.record["steps"],
                seconds=seconds,
                memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                psnr=run.record["held_out"]["psnr"],
                accuracy=accuracy,
                completeness=completeness,
                floor=floor,
                flat_angle=rough.flat_angle,
                edge_angle=rough.edge_angle,
            )
        ]

    def tables(self, rows: Sequence[ConsistencyRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[ConsistencyRow]] = [
            (Column("steps", ",d"), lambda row: row.steps),
            (Column("accuracy", ".2f", "lowest"), lambda row: THOUSANDTHS * row.accuracy),
            (Column("completeness", ".2f", "lowest"), lambda row: THOUSANDTHS * row.completeness),
            (Column("mean", ".2f", "lowest"), lambda row: THOUSANDTHS * (row.accuracy + row.completeness) / 2),
            (Column("floor", ".2f"), lambda row: THOUSANDTHS * row.floor),
            (Column("flat °", ".2f", "lowest"), lambda row: row.flat_angle),
            (Column("edges °", ".1f", "lowest"), lambda row: row.edge_angle),
            (Column("PSNR", ".2f", "highest"), lambda row: row.psnr),
            (Column("s", ".0f"), lambda row: row.seconds),
            (Column("MiB", ".0f"), lambda row: row.memory),
        ]
        items = [(f"{row.parts}, seed {row.seed}", row) for row in rows]
        width, height = self.size
        title = f"{self.scene}, {self.views} views of {width} × {height} pixels: photographs compared with each other"
        note = "Distances are in thousandths of the region's radius, where a photograph sees the surface."
        return (tabulated(self.name, title, "term", figures, items, notes=[note]),)


@contextmanager
def only(parts: str) -> Iterator[None]:
    """Meanwhile scenes are trained with these `PARTS` of the term; the others take no time."""
    with ExitStack() as stack:
        for name in PARTS[parts]:
            stack.enter_context(mock.patch.object(objective, name, _nothing))
        yield


def _nothing(*given: Any, **_: Any) -> Tensor:
    return next(part for part in given if isinstance(part, Surface)).position.new_zeros(1)
