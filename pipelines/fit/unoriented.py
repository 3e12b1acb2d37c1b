"""Signs of normals: a network that is trained without them, and the normals turned along its gradient."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets import OrientedCloud
from ...datasets.clouds.cleaning.noise import denoise, noise_deviation
from ...datasets.clouds.cleaning.orientation import OUTER_REGION, Exterior, solve_signs
from ...datasets.clouds.cleaning.winding import WINDING
from ...datasets.clouds.point_cloud import spread
from ...neural_fields import Siren
from ...neural_fields.backend.arrays import Float32
from ...neural_fields.backend.devices import upload
from ..training.settings import FitConfig
from ..training.trainer import Group, Objective, Report, StopFlag, Trainer, warm_cosine
from .cloud import CloudDistance
from .level import new_level
from .samples import SAMPLING, spread_points, value_and_gradient


@dataclass(frozen=True)
class SignOptions:
    """Numbers of `give_signs` and `fits_better`."""

    steps: int = 300
    batch: int = 4096
    samples: int = 50_000
    rate: float = 2e-3
    points: float = 2.0  # weight of f = 0 at the points, in units of that of known distances
    assigned: float = 0.25  # of the steps, after which enclosed regions get their signs
    clear: float = 0.1  # mean slope of the field into a region, from which on it has a sign
    faint: float = 0.15  # mean slope at the points, below which signs stay: that of an open sheet
    contradicted: float = 0.01  # share of the places
    tested: int = 16_000  # points at which winding numbers are compared
    far: float = 0.05  # distance to the points, where a few wrong normals do not decide a winding number


SIGNING = SignOptions()

STAGE = "level 0: signs"
STAGES = tuple(f"{STAGE} ({number} of 2)" for number in (1, 2))  # one for each estimate of the outside


class Signs(NamedTuple):
    """What `give_signs` finds."""

    turned: NDArray[np.bool_]  # (N,) normals of the wrong sign
    slope: float  # mean of |⟨∇f, N⟩| at the points: about 1 for clear signs, near 0 for none
    source: str  # estimate of the outside that was used: "exterior" or "winding"

    def record(self) -> dict[str, Any]:
        """For ``run.json``."""
        turned = int(self.turned.sum())
        return {"turned_normals": turned, "slope": self.slope, "clear": self.clear, "witness": self.source}

    @property
    def clear(self) -> bool:
        """Whether there was an in- and an outside; of an open sheet there is none, and signs stay."""
        return self.slope >= SIGNING.faint


class Places(NamedTuple):
    """Places ``(M, 3)`` around a cloud, with two estimates of what is outside."""

    points: Tensor
    distance: Tensor  # (M,) to the nearest point of the cloud
    region: Tensor  # (M,) see `Exterior.regions`
    winding: Tensor  # (M,) 1 where winding numbers show the outside, −1 the inside, else 0

    @classmethod
    def around(cls, index: CloudDistance, *, seed: int) -> Places:
        """The places and their estimates, drawn as distances of level 0."""
        points = spread_points(index, SIGNING.samples, torch.Generator().manual_seed(seed))
        distance = torch.from_numpy(index.nearest(points.numpy())).float().clamp(min=1e-6)
        region = torch.from_numpy(Exterior(index.points.astype(np.float64)).regions(points.double().numpy()))
        depth = torch.from_numpy(index.winding_number(points.numpy())).float() - 0.5
        sure = (depth.abs() > SAMPLING.sure) & (distance > SIGNING.far)
        return cls(points, distance, region, torch.where(sure, -depth.sign(), 0.0))

    @property
    def contested(self) -> bool:
        """Whether the estimates contradict each other, or several enclosed regions are large."""
        inside = float(((self.region == OUTER_REGION) & (self.winding < 0)).float().mean())
        enclosed = torch.bincount(self.region)[OUTER_REGION + 1 :]
        return inside > SIGNING.contradicted or int((enclosed > SIGNING.contradicted * len(self.region)).sum()) > 1


def give_signs(
    points: Tensor,
    normals: Tensor,
    config: FitConfig,
    *,
    device: torch.device,
    places: Places | None = None,
    flag: StopFlag | None = None,
    report: Report | None = None,
    options: SignOptions = SIGNING,
) -> Signs | None:
    """Which normals ``(N, 3)`` point inward, by networks that are trained on the points without them; None if stopped.

    With unknown signs |f| = d, |∇f| = 1 and |cos(∇f, N)| = 1 have many minima. The terms here are convex in the values:
    f = 0 at the points, f = ±d at places clearly outside or inside, and |f| ≤ d elsewhere. A smooth field that
    falls from outside goes on falling through the first wall, so both sides of a thin part get opposite gradients.

    What is outside comes from winding numbers in one network, which tend to fill hollows, and from `Exterior` in the
    other, which holes mislead. The network with the steeper slope along the normals counts: about 1 across a wall, and
    0 where both sides got one sign. Where the slope is faint, signs come from neighbours.
    """
    places = places or Places.around(CloudDistance(points, normals), seed=config.seed)
    outside = (places.region == OUTER_REGION).float()
    found: list[tuple[Tensor, str]] = []
    estimates = (("winding", places.winding, None), ("exterior", outside, places.region))
    for stage, (source, sign, region) in zip(STAGES, estimates, strict=True):
        siren = new_level(config, 0, residual=False).to(device)
        generator = torch.Generator().manual_seed(config.seed)
        objective = _Unoriented(
            siren, points, places, sign, region, generator=generator, device=device, options=options
        )
        trainer = Trainer(objective, stage=stage, steps=options.steps)
        if not trainer.run(flag, report=report):
            return None
        gradient = value_and_gradient(siren, points.to(device))[1].cpu()
        found.append(((gradient * normals).sum(dim=1), source))
    slope, source = max(found, key=lambda one: float(one[0].abs().mean()))
    clear = float(slope.abs().mean())
    if clear < options.faint:
        return Signs(np.zeros(len(points), bool), clear, source)
    signs = solve_signs(points.double().numpy(), normals.double().numpy(), slope.double().numpy())
    return Signs(signs < 0, clear, source)


def fits_better(cloud: OrientedCloud, signs: Signs, options: SignOptions = SIGNING) -> bool:
    """Whether ``signs`` fit the cloud much better than its own.

    Winding numbers are ½ at points with right normals. They are evaluated at turned normals only, as a small patch
    hardly changes them elsewhere. Networks see thin bars as faint, and would spoil their signs.
    """
    turned = cloud.points[signs.turned]
    if not len(turned):
        return False
    turned = turned[spread(turned.astype(np.float64), options.tested)]
    after = np.where(signs.turned[:, None], -cloud.normals, cloud.normals)
    return _misfit(cloud.points, after, turned) < WINDING.much_less * _misfit(cloud.points, cloud.normals, turned)


def _misfit(points: Float32, normals: Float32, at: Float32) -> float:
    """Root mean square of the winding number minus ½ at some of the points."""
    index = CloudDistance(torch.from_numpy(points), torch.from_numpy(normals))
    return float(np.sqrt(np.square(index.winding_number(at) - 0.5).mean()))


def signed(cloud: OrientedCloud, signs: Signs, *, smooth: bool) -> OrientedCloud:
    """The cloud with normals turned by ``signs``; with ``smooth``, its noise is then smoothed along them.

    Smoothing along wrong signs would move the sides of a thin wall onto each other.
    """
    points, noise, deviation = cloud.points.astype(np.float64), cloud.noise, 0.0
    normals = np.where(signs.turned[:, None], -cloud.normals, cloud.normals).astype(np.float64)
    if smooth:
        noisy = points
        points, normals, noise = denoise(noisy, normals)
        deviation = noise_deviation(noisy, normals, thick=0.0) * cloud.similarity.scale if noise else 0.0
    report = dataclasses.replace(
        cloud.report,
        oriented_by="level" if signs.clear else cloud.report.oriented_by,
        smoothed_noise=noise * cloud.similarity.scale,
        noise_deviation=deviation if smooth else cloud.report.noise_deviation,
    )
    return dataclasses.replace(
        cloud, points=points.astype(np.float32), normals=normals.astype(np.float32), report=report
    )


class _Unoriented(Objective):
    """The loss of `give_signs`: ``sign`` ``(M,)`` of the distances at the places, 0 for unknown.

    With ``region`` ``(M,)``, those beyond `OUTER_REGION` get their signs from the field during training.
    """

    def __init__(
        self,
        siren: Siren,
        points: Tensor,
        places: Places,
        sign: Tensor,
        region: Tensor | None,
        *,
        generator: torch.Generator,
        device: torch.device,
        options: SignOptions = SIGNING,
    ) -> None:
        self.options = options
        super().__init__(siren, [Group(list(siren.parameters()), warm_cosine(self.options.rate))], generator)
        self.siren, self.points, self.places = siren, points.to(device), places.points.to(device)
        self.distance, self.sign = places.distance.to(device), sign.to(device)
        self.region = None if region is None else region.to(device)

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        if self.region is not None and done >= self.options.assigned:
            self._assign_signs(self.region)
            self.region = None
        at, by = (
            torch.randint(len(rows), (self.options.batch // 2,), generator=self.generator)
            for rows in (self.points, self.places)
        )
        at, by = upload(at, self.points.device), upload(by, self.points.device)
        value = self.siren.value(torch.cat((self.points[at], self.places[by])))
        surface, space = value.split(self.options.batch // 2)
        distance, sign = self.distance[by], self.sign[by]
        known = (space - sign * distance).square()
        terms = {
            "points": surface.square().mean(),
            "space": torch.where(sign == 0, (space.abs() - distance).clamp(min=0).square(), known).mean(),
        }
        return terms, self.options.points * terms["points"] + terms["space"]

    @torch.no_grad()
    def _assign_signs(self, region: Tensor) -> None:
        """Give each enclosed region the sign of the mean of f/d in it, weighted by 1/d²."""
        value = torch.cat([self.siren.value(part) for part in self.places.split(1 << 16)])
        weight = self.distance.square().reciprocal() * (region > OUTER_REGION)
        count = int(region.max()) + 1
        total = torch.zeros(count, device=weight.device).index_add_(0, region, weight)
        slope = torch.zeros_like(total).index_add_(0, region, weight * value / self.distance)
        slope /= total.clamp(min=1e-30)
        signs = torch.where(slope.abs() > self.options.clear, slope.sign(), 0.0)
        self.sign = torch.where(region > OUTER_REGION, signs[region], self.sign)
