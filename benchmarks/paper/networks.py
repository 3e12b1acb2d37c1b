"""SIREN, BACON and IDF, each trained as its own paper trains it, on what the cloud gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from mplicits.datasets import OrientedCloud
from mplicits.neural_fields import Siren
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.training.trainer import Report, parameter_count, seeded
from torch import Tensor, nn

from ..peers import BaconSDF, IdfSDF
from ..peers.idf import attenuation
from .jobs import Preset
from .recipe import Output, Recipe, cosine, descend, finished

# What a network begins as, and the rate at which it gets there: at 3e-3 nothing is left of a sphere at ω₀ = 30, and
# the training that follows finds no surface.
SPHERE_RADIUS, SPHERE_RATE = 0.4, 5e-4
# Half-edge of the cube that points off the surface are drawn from: the mesher's box and a little more.
CUBE = 1.05


@dataclass(frozen=True)
class SirenWeights:
    """Weights of the terms of `siren_loss`."""

    surface: float
    normal: float
    eikonal: float
    off_surface: float


# SIREN's published code: 3,000, 100, 50 and 100; IDF's: 200, 40, 5 and 50.
SIREN_WEIGHTS = SirenWeights(surface=3000.0, normal=100.0, eikonal=50.0, off_surface=100.0)
IDF_WEIGHTS = SirenWeights(surface=200.0, normal=40.0, eikonal=5.0, off_surface=50.0)


def siren_loss(
    value: Tensor, gradient: Tensor, normals: Tensor, weights: SirenWeights, *, alpha: float = 100.0
) -> Tensor:
    """The loss of Sitzmann et al. 2020 (Sec. 4.2) on a batch whose first rows are on the surface.

    ``w_s |f| + w_n (1 − cos(∇f, N))`` on the surface, ``w_o exp(−α |f|)`` off it and ``w_e ||∇f| − 1|`` everywhere,
    each one summed and divided by the size of the whole batch, as in the published code.

    Args:
        value: ``(N,)``.
        gradient: ``(N, 3)``.
        normals: ``(M, 3)`` of the first M rows.
        weights: of the terms.
        alpha: how far from the surface the third term still pushes.
    """
    on = len(normals)
    surface = value[:on].abs().sum()
    normal = (1 - nn.functional.cosine_similarity(gradient[:on], normals, dim=-1)).sum()
    off_surface = (-alpha * value[on:].abs()).exp().sum()
    eikonal = (gradient.norm(dim=-1) - 1).abs().sum()
    terms = (
        weights.surface * surface
        + weights.normal * normal
        + weights.off_surface * off_surface
        + weights.eikonal * eikonal
    )
    return terms / len(value)


class _CloudBatches:
    """Batches of cloud points with their normals and of points of the cube: SIREN's and IDF's sampling.

    Args:
        cloud: whose points are drawn.
        batch: points in all.
        share: of them, those in the cube.
        seed: of what is drawn.
        device: where the batches go.
    """

    def __init__(self, cloud: OrientedCloud, batch: int, share: float, *, seed: int, device: str) -> None:
        self.points, self.normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
        self.off, self.device = round(share * batch), device
        self.on = batch - self.off
        self.generator = torch.Generator().manual_seed(seed)

    def draw(self) -> tuple[Tensor, Tensor]:
        """Points ``(N, 3)``, the first M of them on the surface, and the normals ``(M, 3)`` there."""
        chosen = torch.randint(len(self.points), (self.on,), generator=self.generator)
        off = (2 * torch.rand(self.off, 3, generator=self.generator) - 1) * CUBE
        return torch.cat((self.points[chosen], off)).to(self.device), self.normals[chosen].to(self.device)


@dataclass(frozen=True)
class SirenSettings:
    """Size and schedule of `SirenRecipe` at one preset; ``batch`` counts points on the surface and off it."""

    width: int
    depth: int
    omega: float
    steps: int
    batch: int
    rate: float
    final: float  # last rate over the first; 1 keeps it
    share: float = 0.5  # of a batch off the surface
    sphere_steps: int = 0  # towards a sphere, before the training proper
    alpha: float = 100.0  # see `siren_loss`


SIREN_PRESETS: Mapping[Preset, SirenSettings] = {
    "smoke": SirenSettings(48, 2, 15.0, 150, 256, 3e-3, 0.01),
    "cpu": SirenSettings(128, 4, 30.0, 3000, 1024, 5e-4, 0.01, share=0.6, sphere_steps=200, alpha=50.0),
    "paper": SirenSettings(256, 4, 30.0, 100_000, 2800, 1e-4, 1.0),
}


class SirenRecipe(Recipe[SirenSettings]):
    """One SIREN for the whole domain, with SIREN's own loss.

    Args:
        presets: size and schedule of each preset.
    """

    name = "siren"
    source = (
        "Sitzmann et al. 2020, Sec. 4.2 and published code: (256, 4), ω₀ = 30; |f| and 1 − cos(∇f, N) on the points, "
        "exp(−100 |f|) off them, ||∇f| − 1| everywhere, weights 3000, 100, 100, 50; Adam, rate 1e-4, gradients "
        "clipped to norm 1; 1,400 points on the surface and 1,400 in the cube per step, 10,000 epochs"
    )
    differs = (
        "points off the surface reach 5 % further out than the cube, as the mesher does; paper: 100,000 steps; "
        "cpu: (128, 4), 3,000 steps of 1,024 points in all, 60 % of them off the surface, rate falling from 5e-4 to "
        "5e-6, after 200 steps towards a sphere in the whole cube, and with exp(−50 |f|), to keep blobs away"
    )

    def __init__(self, presets: Mapping[Preset, SirenSettings] = SIREN_PRESETS) -> None:
        self.presets = presets

    def learn(
        self, cloud: OrientedCloud, settings: SirenSettings, *, seed: int, device: str, progress: Report | None
    ) -> tuple[tuple[Output, ...], int]:
        """See `Recipe.learn`."""
        with seeded(seed):
            field = Siren(settings.width, settings.depth, omega=settings.omega)
            begin_as_sphere(field, settings.sphere_steps)
        field = field.to(device)
        batches = _CloudBatches(cloud, settings.batch, settings.share, seed=seed, device=device)

        def loss(step: int) -> Tensor:
            points, normals = batches.draw()
            jet = field.jet(points)
            return siren_loss(jet.value, jet.gradient, normals, SIREN_WEIGHTS, alpha=settings.alpha)

        descend(
            field.parameters(),
            loss,
            steps=settings.steps,
            rate=lambda done: settings.rate * cosine(1.0, settings.final, done),
            stage="SIREN",
            progress=progress,
            clip=1.0,
        )
        return (Output("SIREN", finished(field), -1, parameter_count(field)),), settings.steps


@dataclass(frozen=True)
class BaconSettings:
    """Size and schedule of `BaconRecipe` at one preset."""

    width: int
    bands: tuple[int, ...]
    outputs: tuple[int, ...]
    steps: int
    batch: int
    rates: tuple[float, float]  # first and last
    pool: int  # samples made once; batches are drawn from them
    coarse_weight: float = 0.01


BACON_PRESETS: Mapping[Preset, BaconSettings] = {
    "smoke": BaconSettings(32, (1, 1, 2, 2), (1, 3), 300, 512, (1e-2, 1e-3), 5_000, 0.1),
    "cpu": BaconSettings(128, (4, 4, 4, 6, 6, 12, 12, 24, 24), (2, 4, 6, 8), 1500, 1024, (1e-2, 1e-4), 300_000),
    "paper": BaconSettings(
        256, (8, 8, 8, 12, 12, 24, 24, 48, 48), (2, 4, 6, 8), 200_000, 10_000, (1e-2, 1e-4), 4_000_000
    ),
}
# Scales of the Laplacian noise around cloud points, in periods.
COARSE_NOISE, FINE_NOISE = 0.1, 0.001


class BaconRecipe(Recipe[BaconSettings]):
    """BACON: a sum of squared errors of every output, at samples near the surface and further off.

    Args:
        presets: size and schedule of each preset.
    """

    name = "bacon"
    source = (
        "Lindell et al. 2022, Sec. 4 and published code: 8 hidden layers of 256, outputs after the 2nd, 4th, 6th and "
        "8th, of which the 8th is reported, 192 harmonics; squared errors of all outputs at points of the surface with "
        "Laplacian noise of 0.1 (weight 0.01) and of 0.001 periods; AMSGrad, rate falling from 1e-2 to 1e-4, "
        "gradients clipped to norm 1; 200,000 steps of 10,000"
    )
    differs = (
        "distances to discs of the cloud, with winding numbers for far signs, where theirs are to the plane of the "
        "three nearest points' mean normal; noisy points made once, not at every step; of the published 530,953 "
        "numbers the 527,617 that the 8th output needs are counted; cpu: layers of 128, half the harmonics, 1,500 "
        "steps of 1,024"
    )

    def __init__(self, presets: Mapping[Preset, BaconSettings] = BACON_PRESETS) -> None:
        self.presets = presets

    def learn(
        self, cloud: OrientedCloud, settings: BaconSettings, *, seed: int, device: str, progress: Report | None
    ) -> tuple[tuple[Output, ...], int]:
        """See `Recipe.learn`."""
        with seeded(seed):
            field = BaconSDF(settings.width, bands=settings.bands, outputs=settings.outputs).to(device)
        generator = torch.Generator().manual_seed(seed)
        distances = CloudDistance(torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals))
        half = settings.batch // 2
        pools = [
            laplacian_samples(distances, settings.pool // 2, scale * field.period, field.period, generator)
            for scale in (FINE_NOISE, COARSE_NOISE)
        ]
        pools = [(points.to(device), distance.to(device)) for points, distance in pools]

        def loss(step: int) -> Tensor:
            chosen = [torch.randint(len(points), (half,), generator=generator).to(device) for points, _ in pools]
            points, distance = (
                torch.cat([pool[part][index] for pool, index in zip(pools, chosen, strict=True)]) for part in range(2)
            )
            squares = (torch.stack(field.level_values(points)) - distance).square().mean(dim=0)
            return squares[:half].sum() + settings.coarse_weight * squares[half:].sum()

        first, last = settings.rates
        descend(
            field.parameters(),
            loss,
            steps=settings.steps,
            rate=lambda done: first * (last / first) ** done,
            stage="BACON",
            progress=progress,
            clip=1.0,
            amsgrad=True,
        )
        return (Output("BACON", finished(field), -1, field.parameters_to(-1)),), settings.steps


def laplacian_samples(
    distances: CloudDistance, count: int, scale: float, period: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Cloud points moved by Laplacian noise, folded back into one period, and their signed distances."""
    chosen = torch.randint(len(distances.points), (count,), generator=generator)
    uniform = torch.rand(count, 3, generator=generator) - 0.5
    noise = -scale * uniform.sign() * torch.log1p(-2 * uniform.abs().clamp(max=0.5 - 1e-7))
    points = torch.from_numpy(distances.points)[chosen] + noise
    points = points - period * (points / period).round()
    return points, distances.signed(points)


@dataclass(frozen=True)
class IdfSettings:
    """Size and schedule of `IdfRecipe` at one preset; ``batch`` counts points on the surface and off it."""

    width: int
    depth: int
    omegas: tuple[float, float]
    sphere_steps: int
    steps: int
    batch: int
    rates: tuple[float, float]  # peaks, of the base and of the displacement
    betas: tuple[float, float]
    share: float = 0.5  # of a batch off the surface
    alpha: float = 100.0  # see `siren_loss`


IDF_PRESETS: Mapping[Preset, IdfSettings] = {
    "smoke": IdfSettings(48, 2, (8.0, 15.0), 20, 200, 256, (3e-3, 1e-3), (0.9, 0.99)),
    "cpu": IdfSettings(128, 4, (15.0, 60.0), 200, 1500, 1024, (5e-4, 1e-4), (0.9, 0.99), share=0.6, alpha=50.0),
    "paper": IdfSettings(256, 4, (15.0, 60.0), 25_000, 117_000, 8192, (1e-4, 1e-4), (0.1, 0.9)),
}
# Fractions of the schedule at which the base alone has been trained, and at which it is frozen.
BASE_ALONE, BASE_FROZEN = 0.2, 0.5


class IdfRecipe(Recipe[IdfSettings]):
    """IDF: first the base, then base and displacement, then the displacement of a frozen base.

    Args:
        presets: size and schedule of each preset.
    """

    name = "idf"
    source = (
        "Wang et al. 2022, Sec. 4.1 and published configuration: two SIRENs (256, 4), ω₀ = 15 and 60, α = ν = 0.05; "
        "the base begins as a sphere; SIREN's loss with weights 200, 40, 50, 5, on the base until 20 % of the "
        "schedule, handed over to the displaced field by a cosine until 50 %, the base's rate falling to 0 with it; "
        "Adam, rate 1e-4, the displacement's falling to a tenth; 120 epochs of 4 million points, 8,192 per step"
    )
    differs = (
        "two networks have 397,314 numbers; the 1,191,943 printed for them are three times that and one, as if "
        "Adam's two moments of each had been counted; points off the surface reach 5 % further out than the cube, as "
        "the mesher does; the sphere is fitted more shortly, and in the whole cube; cpu: (128, 4) twice, 1,500 steps "
        "of 1,024 points, 60 % of them off the surface, exp(−50 |f|), rate 5e-4 for the base, moments of Adam over 10 "
        "and 100 steps"
    )

    def __init__(self, presets: Mapping[Preset, IdfSettings] = IDF_PRESETS) -> None:
        self.presets = presets

    def learn(
        self, cloud: OrientedCloud, settings: IdfSettings, *, seed: int, device: str, progress: Report | None
    ) -> tuple[tuple[Output, ...], int]:
        """See `Recipe.learn`."""
        with seeded(seed):
            field = IdfSDF(settings.width, settings.depth, omegas=settings.omegas)
            begin_as_sphere(field.base, settings.sphere_steps)
        field = field.to(device)
        batches = _CloudBatches(cloud, settings.batch, settings.share, seed=seed, device=device)

        def loss(step: int) -> Tensor:
            done = step / settings.steps
            own = hand_over(done)
            field.base.requires_grad_(own > 0)
            points, normals = batches.draw()
            with torch.set_grad_enabled(own > 0):
                base = field.base.jet(points)
            total = points.new_zeros(())
            if own > 0:
                total = total + own * siren_loss(base.value, base.gradient, normals, IDF_WEIGHTS, alpha=settings.alpha)
            if own < 1:
                value, gradient = displaced(field, points, base.value.detach(), base.gradient.detach())
                total = total + (1 - own) * siren_loss(value, gradient, normals, IDF_WEIGHTS, alpha=settings.alpha)
            return total

        descend(
            field.base.parameters(),
            loss,
            steps=settings.steps,
            rate=lambda done: settings.rates[0] * hand_over(done),
            also=[(field.displacement.parameters(), lambda done: settings.rates[1] * _rate_of_displacement(done))],
            stage="IDF",
            progress=progress,
            betas=settings.betas,
        )
        return (Output("IDF", finished(field), -1, parameter_count(field)),), settings.steps


def displaced(field: IdfSDF, x: Tensor, base: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """Value and gradient of the displaced field as its paper trains it: normals and attenuation are constants.

    With w = ∇b(y) the gradient is taken to be ``w + ⟨n, w⟩ α χ (1 − tanh² d) ∇d``, without the two terms that
    `IdfSDF.jet` adds to it for the bending of the base and the slope of χ.
    """
    normal = nn.functional.normalize(slope, dim=-1)
    most = field.limit * attenuation(base, field.reach)[0]
    displacement = field.displacement.jet(x)
    tanh = displacement.value.tanh()
    there = field.base.jet(x + (most * tanh)[:, None] * normal)
    along = (normal * there.gradient).sum(dim=-1) * most * (1 - tanh**2)
    return there.value, there.gradient + along[:, None] * displacement.gradient


def hand_over(done: float) -> float:
    """Factor on the base's weights and rate: 1, from `BASE_ALONE` falling as a cosine to 0 at `BASE_FROZEN`."""
    return cosine(1.0, 0.0, min(max((done - BASE_ALONE) / (BASE_FROZEN - BASE_ALONE), 0.0), 1.0))


def _rate_of_displacement(done: float) -> float:
    """Factor on the rate: rising as the base's falls, then falling to a tenth."""
    if done < BASE_FROZEN:
        return 1 - hand_over(done)
    return cosine(1.0, 0.1, (done - BASE_FROZEN) / (1 - BASE_FROZEN))


def begin_as_sphere(network: Siren, steps: int, *, batch: int = 1024) -> None:
    """Train a SIREN in place to |x| − `SPHERE_RADIUS` on the whole cube; with 0 steps it is not changed.

    In the cube's corners too, unlike `fit_sphere`: what is negative there stays so as a blob, since SIREN's loss
    asks nothing of a sign off the surface. torch's random state is used.
    """

    def loss(step: int) -> Tensor:
        x = (2 * torch.rand(batch, 3) - 1) * CUBE
        distance = x.norm(dim=-1, keepdim=True)
        jet = network.jet(x)
        error = (jet.value - (distance[:, 0] - SPHERE_RADIUS)).square()
        return (100 * error + (jet.gradient - x / distance).square().sum(dim=-1)).mean()

    descend(
        network.parameters(),
        loss,
        steps=steps,
        rate=lambda done: SPHERE_RATE * cosine(1.0, 0.01, done),
        stage="sphere",
    )
