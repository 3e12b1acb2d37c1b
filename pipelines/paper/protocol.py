"""How all methods are trained and measured: sizes, damage to the clouds, and what may not differ between rows.

The paper's own (Sec. 4): unit sphere, 512³ marching cubes, 500 K samples on each surface, squared-L2 Chamfer distance
both ways. The smaller presets change sizes and times, nothing else.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...datasets import OrientedCloud, PointCloud, add_noise, add_outliers, prepare_cloud, read_cloud
from ...neural_fields import InputError
from ..bench.cells import Cell
from ..run.config import load_config
from ..run.settings import FitConfig

if TYPE_CHECKING:
    from ..bench.cells import Preset

__all__ = ["Protocol", "damaged_cloud", "fit_config", "flip_normals", "oriented_cloud", "protocol_of"]


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
        """What decides a figure; part of every cell's key."""
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
        "smoke": Protocol(resolution=32, samples=5_000, poisson_depth=5, columns=64, image=16),
        # Thin parts need the paper's resolution: a blade of 0.6 cells' thickness at 256³ loses a quarter of its volume.
        "cpu": Protocol(resolution=512, samples=200_000, poisson_depth=10, columns=512, image=128),
        "paper": Protocol(resolution=512, samples=500_000, poisson_depth=10, columns=512, image=512),
    }[preset]


def fit_config(preset: Preset) -> FitConfig:
    """Our own settings: those of ``mplicits fit --preset fast`` for ``cpu`` and of ``--preset paper`` for ``paper``."""
    if preset == "smoke":
        return FitConfig(
            widths=(32, 32, 32),
            depths=(2, 2, 2),
            omegas=(10.0, 15.0, 20.0),
            steps=(100, 40, 40),
            learning_rates=(4e-3, 1e-3, 5e-4),
            batch=1024,
            samples=10_000,
        )
    return load_config(FitConfig, {"cpu": "fast", "paper": "paper"}[preset])


def damaged_cloud(cell: Cell) -> PointCloud:
    """The cloud of a cell's shape, damaged as the cell asks: noise first, then flipped normals, then strays.

    Raises:
        InputError: the file cannot be read, or its points have no normals to move along or turn round.
    """
    cloud = read_cloud(cell.shape)
    if cloud.normals is None and (cell.noise or cell.flipped):
        raise InputError(f"{cell.shape}: has no normals for noise and flips; leave out those tables (--table)")
    if cell.noise:
        cloud = add_noise(cloud, cell.noise, seed=cell.seed)
    if cell.flipped:
        cloud = flip_normals(cloud, cell.flipped, seed=cell.seed)
    if cell.outliers:
        cloud = add_outliers(cloud, cell.outliers, seed=cell.seed)
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


def oriented_cloud(cell: Cell, *, smooth_noise: bool = False) -> OrientedCloud:
    """What every method but ours learns from: the damaged cloud in the unit sphere, no point judged to be a stray.

    Ours reads the same damaged cloud, but what `fit` does to find strays is part of our method, not of the others'.

    Args:
        cell: whose cloud.
        smooth_noise: whether noise is smoothed off as in ours, to see what that alone does for another method.

    Raises:
        InputError: see `damaged_cloud`.
    """
    return prepare_cloud(damaged_cloud(cell), isolation=None, smooth_noise=smooth_noise)
