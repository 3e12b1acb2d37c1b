"""Benchmark ``uneven``: fits of clouds whose density varies over one shape, beside screened Poisson on the same points.

The shapes without a file are exact: none of them was used to choose a number of `fit`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mplicits.datasets import PointCloud
from mplicits.neural_fields import Box, Capsule, Difference, Field, InputError, Mesh, Sphere, Torus, Union, extract_mesh
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.surface.surface import read_reference, sample_points
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..harness.benchmark import Part
from .fits import FitBench

Float64 = NDArray[np.float64]

NEIGHBORS = 24  # samples over which the bend of the surface is measured
CANDIDATES = 20  # samples of the surface for each point that is kept


def by_curvature(points: Float64, normals: Float64, random: np.random.Generator) -> Float64:
    """Wanted spacing ``(N,)``, up to a factor: large where normals turn little over a length."""
    distance, near = KDTree(points).query(points, NEIGHBORS, workers=-1)
    cosine = np.einsum("nd,nkd->nk", normals, normals[near]).clip(-1, 1)
    bend = (np.arccos(cosine).mean(axis=1) / distance[:, -1])[near].mean(axis=1)
    return 1 / np.maximum(bend, 1e-3 * bend.max())


def by_scanner(points: Float64, normals: Float64, random: np.random.Generator) -> Float64:
    """Wanted spacing ``(N,)``, up to a factor: the distance to a scanner near the surface."""
    size = np.ptp(points, axis=0).max()
    place = random.integers(len(points))
    return np.linalg.norm(points - points[place] - 0.1 * size * normals[place], axis=1)


def by_patches(points: Float64, normals: Float64, random: np.random.Generator) -> Float64:
    """Wanted spacing ``(N,)``, up to a factor: one for each of twelve patches, which end abruptly."""
    centers = points[random.integers(len(points), size=12)]
    return np.exp2(random.uniform(0, 3, 12))[KDTree(centers).query(points)[1]]


DENSITIES: dict[str, Callable[[Float64, Float64, np.random.Generator], Float64]] = {
    "curvature": by_curvature,
    "scanner": by_scanner,
    "patches": by_patches,
}


def uneven_cloud(mesh: Mesh, count: int, *, density: str, ratio: float, seed: int, source: str = "") -> PointCloud:
    """About ``count`` points of a mesh with the normals of its faces, whose density varies over it.

    Args:
        mesh: the surface.
        count: of the points.
        density: "curvature", "scanner" or "patches".
        ratio: largest over smallest density.
        seed: of the points.
        source: what messages call the cloud.
    """
    random = np.random.default_rng(seed)
    points, normals = sample_points(mesh, CANDIDATES * count, random)
    assert normals is not None
    spacing = DENSITIES[density](points, normals.astype(np.float64), random)
    spacing = (spacing / np.quantile(spacing, 0.05)).clip(1, ratio**0.5)
    # One point of each voxel, whose edge goes in steps of √2 with the spacing.
    step = np.round(2 * np.log2(spacing)).astype(np.int64)

    def kept(edge: float) -> NDArray[np.int64]:
        cells = np.floor(points / (edge * np.exp2(step / 2))[:, None]).astype(np.int64)
        return np.sort(np.unique(np.c_[cells, step], axis=0, return_index=True)[1])

    low, high = 1e-4 * np.ptp(points), np.ptp(points)
    for _ in range(16):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if len(kept(middle)) > count else (low, middle)
    rows = kept(high)
    return PointCloud(points[rows], normals[rows].astype(np.float32), None, source)


def exact_shapes() -> dict[str, tuple[Field, str]]:
    """Shapes in closed form inside the unit ball, and what the density of each follows."""
    slab = Box(half_size=(0.7, 0.12, 0.5), center=(0.0, -0.3, 0.0))
    balls = [
        Sphere(radius=r, center=(x, -0.18, z)) for x, z, r in ((-0.4, 0.2, 0.1), (0.1, -0.2, 0.16), (0.45, 0.25, 0.06))
    ]
    bar = [Capsule(start=(-0.5, y, -0.3), end=(0.5, -y, 0.3), radius=0.05) for y in (-0.5, 0.5)]
    block = Box(half_size=(0.5, 0.35, 0.25))
    hole = Capsule(start=(0.1, -0.6, 0.0), end=(0.1, 0.6, 0.0), radius=0.15)
    dents = [Sphere(radius=0.2, center=center) for center in ((0.6, 0.1, 0.0), (-0.2, 0.55, 0.2), (0.0, -0.2, 0.6))]
    plate = Box(half_size=(0.6, 0.015, 0.4))
    return {
        "bumps_on_a_slab": (Union(slab, *balls), "curvature"),
        "crossed_bars": (Union(*bar), "scanner"),
        "drilled_block": (Difference(block, hole), "curvature"),
        "dented_ball": (Difference(Sphere(radius=0.6), *dents), "patches"),
        "ring": (Torus(major=0.55, minor=0.15), "patches"),
        "thin_plate": (Union(plate, Sphere(radius=0.15)), "scanner"),
        "dumbbell": (
            Union(
                Sphere(radius=0.3, center=(-0.5, 0, 0)),
                Sphere(radius=0.2, center=(0.5, 0, 0)),
                Capsule(start=(-0.5, 0, 0), end=(0.5, 0, 0), radius=0.08),
                smooth=0.1,
            ),
            "curvature",
        ),
        "table": (
            Union(
                Box(half_size=(0.6, 0.04, 0.4), center=(0, 0.3, 0)),
                *(Capsule(start=(x, -0.4, z), end=(x, 0.3, z), radius=0.04) for x in (-0.5, 0.5) for z in (-0.3, 0.3)),
            ),
            "scanner",
        ),
    }


@dataclass(frozen=True, kw_only=True)
class UnevenBench(FitBench):
    """Fits of uneven clouds, measured as `FitBench` does.

    Attributes:
        shapes: mesh files; the exact shapes, written beside the results, where there are none.
        density: see `uneven_cloud`; None takes that of the exact shape, and the curvature of a file.
        ratio: largest over smallest density.
    """

    name = "uneven"
    source = "fits of clouds whose density varies over the shape"
    apart = (*FitBench.apart, "folder")
    folder: Path = Path("uneven")
    points: int | None = 30_000
    density: str | None = None
    ratio: float = 30.0

    def jobs(self) -> list[Part]:
        """One for each shape; exact ones are meshed first."""
        if self.shapes:
            return super().jobs()
        self.folder.mkdir(parents=True, exist_ok=True)
        files = []
        for name, (field, _) in exact_shapes().items():
            files.append(self.folder / f"{name}.ply")
            if not files[-1].exists():
                write_mesh(files[-1], extract_mesh(field, resolution=384))
        return [Part(self.name, file.stem, (file,)) for file in files]

    def cloud_of(self, path: Path) -> tuple[PointCloud, dict[str, Any]]:
        """See `FitBench.cloud_of`."""
        exact = exact_shapes().get(path.stem)
        density = self.density or (exact[1] if exact and not self.shapes else "curvature")
        if self.points is None:
            raise InputError("--points: expected a number")
        about = {"density": density, "ratio": self.ratio, "points": self.points}
        mesh, seed = read_reference(path), self.config.seed
        cloud = uneven_cloud(mesh, self.points, density=density, ratio=self.ratio, seed=seed, source=str(path))
        return cloud, about
