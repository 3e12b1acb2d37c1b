"""Instant-NGP and BANF, each trained as its own paper trains it, on what the cloud gives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from mplicits.datasets import OrientedCloud
from mplicits.neural_fields import Field
from mplicits.neural_fields.fields.losses import data_loss, eikonal_loss
from mplicits.pipelines.fit.samples import DOMAIN
from mplicits.pipelines.training.trainer import Report, parameter_count, seeded
from torch import Tensor

from ..peers import BandLimited, BanfSDF, HashGridSDF
from .jobs import Preset
from .recipe import Output, Recipe, SignedPools, cosine, descend, differences, finished, mape_loss, stencil

# Rows per call where a field is evaluated on a whole pool.
CHUNK = 1 << 16


@dataclass(frozen=True)
class GridSettings:
    """Size of a `HashGridSDF` with two features per entry; its table holds 2 to the power of ``table``."""

    levels: int
    table: int
    coarsest: int
    finest: int
    width: int
    depth: int

    def field(self, *, seed: int, radius: float | None = None) -> HashGridSDF:
        """An untrained field over the cube in which distances are learnt, without a trace in torch's random state."""
        with seeded(seed):
            return HashGridSDF(
                levels=self.levels,
                table_size=1 << self.table,
                coarsest=self.coarsest,
                finest=self.finest,
                width=self.width,
                depth=self.depth,
                extent=DOMAIN,
                radius=radius,
            )


@dataclass(frozen=True)
class NgpSettings:
    """Size and schedule of `InstantNgpRecipe` at one preset; ``pool`` counts the points off the surface, made once."""

    grid: GridSettings
    steps: int
    batch: int
    rate: float
    pool: int
    spread: float  # scale of the logistic steps off the surface; the cloud's spacing, where that is more


# The authors' own sizes, with as many levels as the paper's test of a scene says, which end where the number of
# parameters is nearest to the paper's: 2,049,153 (2,040,864) and 9,125,105 (9,113,760).
NGP_COARSE = GridSettings(levels=3, table=19, coarsest=16, finest=382, width=64, depth=2)
NGP_FINE = GridSettings(levels=16, table=19, coarsest=16, finest=269, width=64, depth=2)
NGP_PRESETS: Mapping[tuple[str, Preset], NgpSettings] = {
    ("coarse", "smoke"): NgpSettings(GridSettings(2, 12, 8, 16, 16, 2), 400, 512, 1e-2, 4_000, 0.02),
    ("fine", "smoke"): NgpSettings(GridSettings(4, 12, 4, 32, 16, 2), 300, 512, 1e-2, 4_000, 0.02),
    ("coarse", "cpu"): NgpSettings(NGP_COARSE, 500, 8192, 3e-3, 400_000, 0.01),
    ("fine", "cpu"): NgpSettings(NGP_FINE, 300, 4096, 3e-3, 400_000, 0.01),
    ("coarse", "paper"): NgpSettings(NGP_COARSE, 30_000, 1 << 18, 1e-4, 4_000_000, 0.001),
    ("fine", "paper"): NgpSettings(NGP_FINE, 30_000, 1 << 18, 1e-4, 4_000_000, 0.001),
}


class InstantNgpRecipe(Recipe[NgpSettings]):
    """One hash grid, trained on relative errors of distances.

    Args:
        size: which of the paper's two rows.
        presets: size and schedule for each size and preset.
    """

    source = (
        "Müller et al. 2022, Sec. 5.2, and published configuration: |f − d| / (|d| + 0.01); of each batch 4/8 on the "
        "surface, 3/8 logistic steps off it, 1/8 uniform; tables of 2^19 pairs, two hidden layers of 64; Adam with "
        "β = (0.9, 0.99), ε = 1e-15 and rate 1e-4, after a third of the steps times 0.33 every sixth of them"
    )
    differs = (
        "Plain PyTorch; no moving average of the weights, no decay. Distances are the cloud's, as for every method "
        "here, and steps off the surface no shorter than its spacing. The paper says how many parameters and levels, "
        "not which grids: coarse has 3 (16 to 382 cells, 2,049,153 parameters), fine 16 (16 to 269 cells, 9,125,105). "
        "The cpu preset has these sizes, a rate of 3e-3 and a few hundred steps of a few thousand points"
    )

    def __init__(
        self,
        size: Literal["coarse", "fine"],
        presets: Mapping[tuple[str, Preset], NgpSettings] = NGP_PRESETS,
    ) -> None:
        self.size = size
        self.presets = {preset: settings for (one, preset), settings in presets.items() if one == size}
        self.name = f"ingp-{size}"

    def learn(
        self, cloud: OrientedCloud, settings: NgpSettings, *, seed: int, device: str, progress: Report | None
    ) -> tuple[tuple[Output, ...], int]:
        """See `Recipe.learn`."""
        field = settings.grid.field(seed=seed).to(device)
        pools = SignedPools(
            cloud, settings.pool * 3 // 4, settings.pool // 4, settings.spread, seed=seed, device=device
        )

        def loss(step: int) -> Tensor:
            points, distance = pools.draw(settings.batch, (4, 3, 1))
            return mape_loss(field.value(points), distance).mean()

        title = f"iNGP {self.size}"
        descend(
            field.parameters(),
            loss,
            steps=settings.steps,
            rate=lambda done: settings.rate * 0.33 ** max(0, math.ceil(6 * done - 2)),
            stage=title,
            progress=progress,
            betas=(0.9, 0.99),
            eps=1e-15,
        )
        return (Output(title, finished(field), -1, parameter_count(field)),), settings.steps


@dataclass(frozen=True)
class BanfSettings:
    """Size and schedule of `BanfRecipe` at one preset, one entry per level in the first three."""

    resolutions: tuple[int, ...]
    grids: tuple[GridSettings, ...]
    steps: tuple[int, ...]
    batch: int
    rate: float
    pool: int
    spread: float  # as in `NgpSettings`
    eikonal: float
    laplacian: float


BANF_GRID = GridSettings(levels=16, table=19, coarsest=16, finest=2048, width=32, depth=3)
BANF_PRESETS: Mapping[Preset, BanfSettings] = {
    "smoke": BanfSettings(
        (8, 16),
        (GridSettings(2, 12, 4, 8, 16, 2), GridSettings(2, 12, 8, 16, 16, 2)),
        (100, 100),
        512,
        1e-2,
        5_000,
        0.02,
        1e-5,
        1e-10,
    ),
    "cpu": BanfSettings(
        (32, 64, 128),
        (GridSettings(4, 15, 4, 32, 32, 3), GridSettings(4, 16, 8, 64, 32, 3), GridSettings(4, 17, 16, 128, 32, 3)),
        (300, 150, 150),
        4096,
        1e-2,
        200_000,
        0.02,
        1e-5,
        1e-10,
    ),
    "paper": BanfSettings(
        (32, 64, 128, 256), (BANF_GRID,) * 4, (5_000, 10_000, 10_000, 10_000), 100_000, 1e-3, 500_000, 0.01, 1e-5, 1e-10
    ),
}
# Share of the first level's steps in which its rate rises to the full one.
WARM_UP = 0.1
# One in `SPARSE` points of a batch also gets derivatives, at seven values a point.
SPARSE = 8


class BanfRecipe(Recipe[BanfSettings]):
    """A cascade: every level learns what the frozen ones before it leave, asked at the vertices of its lattice only.

    Args:
        presets: size and schedule of each preset.
    """

    name = "banf"
    source = (
        "Shabanov et al. 2024, in the configuration that M-plicits states for its own re-implementation (suppl., "
        "Comparison with BANF): lattices of 32, 64, 128 and 256 with linear interpolation, each level fitted to what "
        "the frozen ones leave; (f − d)², eikonal and Laplacian terms by finite differences over a quarter of a cell; "
        "a pool of 500,000 points, 40 : 40 : 20 on, near and away from the surface; Instant-NGP's encoding and three "
        "hidden layers of 32; Adam, rate 1e-3, 5,000 and then 10,000 steps of 100,000 points; begins as a sphere"
    )
    differs = (
        "What is not stated was chosen here: weights of 1e-5 (eikonal) and 1e-10 (Laplacian), steps near the surface "
        "as in Instant-NGP's recipe, a cosine for the rate, a warm-up of a tenth of level 0, derivatives at one point "
        "in eight of a batch. The sphere is added to level 0's network, not trained into it. The cpu preset ends at "
        "128, with networks no finer than their lattices, a rate of 1e-2 and 600 steps of 4,096 points"
    )

    def __init__(self, presets: Mapping[Preset, BanfSettings] = BANF_PRESETS) -> None:
        self.presets = presets

    def learn(
        self, cloud: OrientedCloud, settings: BanfSettings, *, seed: int, device: str, progress: Report | None
    ) -> tuple[tuple[Output, ...], int]:
        """See `Recipe.learn`."""
        # More than are wanted: they are drawn with replacement.
        pools = SignedPools(
            cloud, settings.pool * 2 // 3, settings.pool // 3, settings.spread, seed=seed, device=device
        )
        points, distance = pools.draw(settings.pool, (2, 2, 1))
        networks: list[HashGridSDF] = []
        before: list[BandLimited] = []
        for level, (resolution, grid) in enumerate(zip(settings.resolutions, settings.grids, strict=True)):
            network = grid.field(seed=seed * 1009 + level, radius=None if level else 0.5).to(device)
            _silence(network)
            part = BandLimited(network, resolution, extent=DOMAIN)
            _train_level(part, before, points, distance, settings, level, pools.generator, progress)
            networks.append(network)
            before.append(part.requires_grad_(False))
        field = BanfSDF(networks, settings.resolutions, extent=DOMAIN).cpu()
        outputs = tuple(
            Output(f"BANF {resolution}", field, level, parameter_count(*networks[: level + 1]))
            for level, resolution in enumerate(settings.resolutions)
        )
        return outputs, sum(settings.steps)


def _train_level(
    part: BandLimited,
    before: Sequence[BandLimited],
    points: Tensor,
    distance: Tensor,
    settings: BanfSettings,
    level: int,
    generator: torch.Generator,
    progress: Report | None,
) -> None:
    """Fit one level to what the levels ``before`` leave of the ``distance`` ``(N,)`` at ``points`` ``(N, 3)``."""
    step = 2 * DOMAIN / (4 * part.resolution)  # a quarter of a cell
    left = distance - _sum(before, points)
    crosses = stencil(points[: len(points) // SPARSE], step)  # (M, 7, 3)
    at_crosses = _sum(before, crosses)

    def loss(_: int) -> Tensor:
        rows = torch.randint(len(points), (settings.batch,), generator=generator).to(points.device)
        few = torch.randint(len(crosses), (settings.batch // SPARSE,), generator=generator).to(points.device)
        # In one call, so that a vertex that both need is evaluated once.
        value = part.value(torch.cat((points[rows], crosses[few].reshape(-1, 3))))
        gradient, laplacian = differences(value[len(rows) :].reshape(-1, 7) + at_crosses[few], step)
        data = data_loss(value[: len(rows)], left[rows]).mean()
        smooth = settings.eikonal * eikonal_loss(gradient).mean() + settings.laplacian * laplacian.square().mean()
        return data + smooth

    def rate(done: float) -> float:
        rising = 1.0 if level else min(1.0, (done + 1e-3) / WARM_UP)
        return rising * cosine(settings.rate, 0.0, done)

    descend(
        part.parameters(),
        loss,
        steps=settings.steps[level],
        rate=rate,
        stage=f"BANF {part.resolution}",
        progress=progress,
        betas=(0.9, 0.99),
        eps=1e-15,
    )


@torch.no_grad()
def _sum(parts: Sequence[Field], x: Tensor) -> Tensor:
    """The sum of fields at ``(..., 3)`` points, in parts that fit into memory."""
    rows = x.reshape(-1, 3)
    total = torch.zeros_like(rows[:, 0])
    for part in parts:
        total += torch.cat([part.value(chunk) for chunk in rows.split(CHUNK)])
    return total.reshape(x.shape[:-1])


@torch.no_grad()
def _silence(network: HashGridSDF) -> None:
    """Let a network begin with next to nothing: a level as what is before it, the first as its sphere."""
    last = network.linear()[-1]
    last.weight.mul_(0.1)
    last.bias.zero_()
