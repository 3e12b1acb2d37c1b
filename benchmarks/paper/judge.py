"""How all methods are judged: sizes of a preset, damage to the clouds, and a `Judge` that extracts and measures.

The paper's own (Sec. 4): unit sphere, 512³ marching cubes, 500 K samples on each surface, squared-L2 Chamfer distance
both ways. The smaller presets change sizes and times, nothing else.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from mplicits.datasets import OrientedCloud, PointCloud, add_noise, add_outliers, orbit, prepare_cloud, read_cloud
from mplicits.neural_fields import Field, InputError, Mesh, Similarity, sphere_trace
from mplicits.neural_fields.meshing.extract import NoSurfaceError, extract_mesh
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.render.picture import write_picture
from mplicits.pipelines.render.rasterise import picture_of
from mplicits.pipelines.surface.measure import evaluate_surfaces
from mplicits.pipelines.surface.surface import Support, drop_unsupported, read_reference
from mplicits.pipelines.training.settings import FitConfig, load_config

from ..harness.jobs import Context
from .jobs import PaperJob, Preset

# Bound on |∇f| for extracting fields whose slope is not trained to 1: blocks that it culls are safely empty.
STEEP = 2.0
# Steps on the coarsest level of an output and on each finer one (paper, Sec. 4).
FIRST_STEPS, MORE_STEPS = 20, 5


def reference_of(job: PaperJob) -> Mesh:
    """The surface that a job's results are measured against.

    Raises:
        InputError: it cannot be read, or has no faces.
    """
    return read_reference(job.reference or job.shape, fix="give --reference MESH")


class Judge:
    """Measures the surfaces of one job against its reference.

    Raises:
        InputError: see `reference_of`.
    """

    def __init__(self, job: PaperJob, context: Context) -> None:
        self.context = context
        self.seed = job.seed
        self.reference = reference_of(job)
        self.protocol = protocol_of(job.preset)

    def field(
        self,
        name: str,
        field: Field,
        similarity: Similarity,
        *,
        level: int = -1,
        parameters: int,
        train_seconds: float,
        lipschitz: float = STEEP,
        support: Support | None = None,
    ) -> dict[str, Any]:
        """Extract a level, time a picture of it, and measure the mesh.

        Args:
            name: of the output.
            field: in unit-sphere coordinates.
            similarity: the way back to input coordinates.
            level: whose zero set it is.
            parameters: trained numbers that it needs.
            train_seconds: until it was there.
            lipschitz: see `extract_mesh`.
            support: the points of a fit of ours; components that rest on none of them are dropped, and counted.
        """
        field = field.to(self.context.device)
        started = time.perf_counter()
        try:
            mesh = extract_mesh(field, resolution=self.protocol.resolution, level=level, lipschitz=lipschitz)
        except NoSurfaceError:
            mesh = None
        dropped = 0
        if mesh is not None and support is not None:
            mesh, dropped, _ = drop_unsupported(mesh, support.points, radius=support.radius)
        seconds = time.perf_counter() - started
        figures = self.mesh(
            name, mesh, similarity, parameters=parameters, train_seconds=train_seconds, mesh_seconds=seconds
        )
        rays = None if mesh is None else self._rays_per_second(field, level)
        return figures | {"dropped_components": dropped, "rays_per_second": rays}

    def mesh(
        self,
        name: str,
        mesh: Mesh | None,
        similarity: Similarity,
        *,
        parameters: int | None = None,
        train_seconds: float,
        mesh_seconds: float | None = None,
    ) -> dict[str, Any]:
        """Write, draw and measure a mesh in unit-sphere coordinates; None is a method that found no surface."""
        figures: dict[str, Any] = {
            "name": name,
            "parameters": parameters,
            "train_seconds": train_seconds,
            "mesh_seconds": mesh_seconds,
            "chamfer": None,
        }
        if mesh is None or not len(mesh.faces):
            return figures
        write_mesh(self.context.mesh(name), mesh, similarity)
        surface = replace(mesh, vertices=similarity.to_input(mesh.vertices))
        tile = self.protocol.tile
        camera = orbit(self.reference.vertices, width=tile, height=tile)
        write_picture(self.context.picture(name), picture_of(surface, camera))
        metrics = evaluate_surfaces(
            surface,
            self.reference,
            samples=self.protocol.samples,
            seed=self.seed,
            columns=self.protocol.columns,
        )
        return figures | {key: value for key, value in asdict(metrics).items() if key not in ("samples", "seed")}

    @torch.inference_mode()
    def _rays_per_second(self, field: Field, level: int) -> float:
        """Of the paper's fixed-step sphere tracing, without normals, of an image that the unit sphere fills."""
        size = self.protocol.image
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        origin, directions = orbit(corners, width=size, height=size).rays(device=self.context.device)
        # Levels without bands are alternatives: only the one that is wanted is traced.
        level = field.resolve_level(level)
        traced = [index for index in range(level) if field.deltas[index].isfinite()] + [level]
        budget = [MORE_STEPS if index in traced else 0 for index in range(level + 1)]
        budget[traced[0]] = FIRST_STEPS
        started = time.perf_counter()
        hits = sphere_trace(field, origin, directions, level=level, budget=budget)
        hits.mask.any().item()  # a GPU works on after the call returns
        return size * size / (time.perf_counter() - started)


@dataclass(frozen=True)
class Protocol:
    """Sizes of one preset.

    Attributes:
        resolution: cells along each side of the box that meshes are extracted from.
        samples: points on each of the two surfaces that are compared.
        poisson_depth: depth of screened Poisson's octree.
        columns: of the volumetric IoU, along the longest side.
        image: pixels along each side of the image that is traced for its time.
        tile: pixels along each side of a picture.
    """

    resolution: int
    samples: int
    poisson_depth: int
    columns: int
    image: int
    tile: int = 320

    def as_dict(self) -> dict[str, Any]:
        """What decides a figure; part of every job's key."""
        return {name: number for name, number in asdict(self).items() if name != "tile"}

    def summary(self) -> str:
        """One sentence for the page of results."""
        return (
            f"Meshes are extracted at {self.resolution}³, and {self.samples:,} points drawn on each of the two "
            f"surfaces; screened Poisson's octree is {self.poisson_depth} deep."
        )


def protocol_of(preset: Preset) -> Protocol:
    """The sizes of a preset."""
    return {
        "smoke": Protocol(resolution=32, samples=5_000, poisson_depth=5, columns=64, image=16, tile=96),
        # Thin parts need the paper's resolution: a blade of 0.6 cells' thickness at 256³ loses a quarter of its volume.
        "cpu": Protocol(resolution=512, samples=200_000, poisson_depth=10, columns=512, image=128),
        "paper": Protocol(resolution=512, samples=500_000, poisson_depth=10, columns=512, image=512),
    }[preset]


def fit_config(preset: Preset) -> FitConfig:
    """Our own settings: those of ``mplicits fit --preset fast`` for ``cpu`` and of ``--preset paper`` for ``paper``.

    Trained as the paper and its peers are: on all points of the cloud, and on no others.
    """
    alike = {"between": False, "hold_out": 0.0}
    if preset == "smoke":
        return FitConfig(
            widths=(32, 32, 32),
            depths=(2, 2, 2),
            omegas=(10.0, 15.0, 20.0),
            steps=(100, 40, 40),
            learning_rates=(4e-3, 1e-3, 5e-4),
            batch=1024,
            samples=10_000,
            **alike,
        )
    return load_config(FitConfig, {"cpu": "fast", "paper": "paper"}[preset], alike)


def damaged_cloud(job: PaperJob) -> PointCloud:
    """The cloud of a job's shape, damaged as the job asks: noise first, then flipped normals, then strays.

    Raises:
        InputError: the file cannot be read, or its points have no normals to move along or turn round.
    """
    cloud = read_cloud(job.shape)
    if cloud.normals is None and (job.noise or job.flipped):
        raise InputError(f"{job.shape}: has no normals for noise and flips; leave out those tables (--table)")
    if job.noise:
        cloud = add_noise(cloud, job.noise, seed=job.seed)
    if job.flipped:
        cloud = flip_normals(cloud, job.flipped, seed=job.seed)
    if job.outliers:
        cloud = add_outliers(cloud, job.outliers, seed=job.seed)
    return cloud


def flip_normals(cloud: PointCloud, fraction: float, *, seed: int = 0) -> PointCloud:
    """Turn the normals of ``round(fraction·N)`` points round, drawn without replacement.

    Raises:
        ValueError: the cloud has no normals, or ``fraction`` is not in [0, 1].
    """
    if cloud.normals is None:
        raise ValueError(f"cloud={cloud.source!r} has no normals to turn round")
    if not 0 <= fraction <= 1:
        raise ValueError(f"fraction={fraction}: expected a number in [0, 1]")
    chosen = np.random.default_rng(seed).permutation(len(cloud))[: round(fraction * len(cloud))]
    normals = cloud.normals.copy()
    normals[chosen] *= -1
    return replace(cloud, normals=normals)


def oriented_cloud(job: PaperJob, *, smooth_noise: bool = False) -> OrientedCloud:
    """What every method but ours learns from: the damaged cloud in the unit sphere, no point judged to be a stray.

    Ours reads the same damaged cloud, but what `fit` does to find strays is part of our method, not of the others'.

    Args:
        job: whose cloud.
        smooth_noise: whether noise is smoothed off as in ours, to see what that alone does for another method.

    Raises:
        InputError: see `damaged_cloud`.
    """
    return prepare_cloud(damaged_cloud(job), isolation=None, smooth_noise=smooth_noise)
