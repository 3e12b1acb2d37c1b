"""What a level learns from (paper Sec. 3.2, "Sampling"): the domain for level 0, the band before it for the others.

Samples are made once and drawn from at every step. Everything that a step would otherwise have to find out again is
stored with them: the distance and the normal that the cloud gives, and the value and the gradient of the frozen levels
before. A step then evaluates the residual being trained and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, InputError, Jet
from ...neural_fields.fields.losses import data_loss, eikonal_loss, normal_loss
from ..training.settings import FitConfig
from .cloud import CLOUD, CloudDistance

__all__ = [
    "SQUARES",
    "Remote",
    "Rows",
    "SampleOptions",
    "Samples",
    "Source",
    "Usual",
    "Weights",
    "band_samples",
    "banded_sources",
    "distance_samples",
    "first_sources",
    "free_lengths",
    "near_samples",
    "offset_samples",
    "remote_samples",
    "spread_points",
    "surface_samples",
    "usual_errors",
    "with_previous",
]

# Half-edge of the cube in which level 0 learns distances: the mesher's box is [-1, 1]³, and a little more.
DOMAIN = 1.05


@dataclass(frozen=True)
class SampleOptions:
    """Numbers of `banded_sources`."""

    # How far a winding number must be from one half to say in or out: it is off by less than 0.05 where it is asked.
    sure: float = 0.4
    # The same where normals were estimated from the points, which are wrong at thin parts: in the arches of a tower,
    # far from its bars, the number is 0.11 to 0.32. In the holes of scans of solid parts it is nearer to one half.
    sure_guessed: float = 0.3
    # Normals estimated from the points are wrong by tens of degrees where parts are as thin as a neighbourhood, or as
    # the noise, and there no field of slope 1 is near the points either. Weights of both terms, in units of the
    # settings'.
    guessed_normal: float = 0.1
    guessed_slope: float = 0.2
    # Of noise without normals, smoothing leaves this much: 0.3 to 0.7 of it in the root mean square on six shapes
    # with 0.5 and 1 %, 0.4 in the median. Distances are that good.
    left: float = 0.4
    # Spacings from all points, from which on a place is no longer between them: there a surface is about one away.
    clear: float = 4.0
    # So few places that the level before gets wrong far from the cloud are not worth a share of the batch.
    fewest: int = 32


SAMPLING = SampleOptions()


class Rows:
    """What is known about points, a row for each: a dataclass of tensors of equal length, some of which may be None."""

    points: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: Tensor) -> Self:
        """The rows at ``index``."""
        return self._each(lambda column: column[index])

    def to(self, device: torch.device) -> Self:
        """The same rows on another device."""
        return self._each(lambda column: column.to(device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Self:
        return type(self)(*(None if column is None else change(column) for column in vars(self).values()))


@dataclass(frozen=True)
class Samples(Rows):
    """Points with what is known about them.

    Attributes:
        points: ``(N, 3)``.
        distance: ``(N,)`` known signed distance, or None: only |∇f| = 1 is known.
        normal: ``(N, 3)`` known unit gradient, or None.
        value: ``(N,)`` what the levels before say here; None at level 0.
        gradient: ``(N, 3)`` their gradient; None at level 0.
    """

    points: Tensor
    distance: Tensor | None = None
    normal: Tensor | None = None
    value: Tensor | None = None
    gradient: Tensor | None = None
    area: Tensor | None = None


class Usual(NamedTuple):
    """What is usual of each term of Eq. 4: the scales of `pseudo_huber` around them; infinity leaves a term as it is.

    Attributes:
        data: of (f(x) − d)².
        normal: of 1 − cos(∇f, N).
        eikonal: of (|∇f| − 1)².
    """

    data: float = math.inf
    normal: float = math.inf
    eikonal: float = math.inf


SQUARES = Usual()  # all terms as they are
# The least of each: float32 rounds f to about 1e-7 and cosines to 6e-8; 1e-6 of these is that of 0.08°.
LEAST = Usual(1e-12, 1e-6, 1e-6)


@dataclass(frozen=True)
class Source:
    """Samples, how many of them go into each batch, and the weights of their terms.

    Attributes:
        name: in reports.
        samples: what batches are drawn from.
        batch: how many of them go into each.
        data: weight of (f(x) − d)².
        normal: weight of 1 − cos(∇f, N).
        eikonal: weight of (|∇f| − 1)².
        usual: what is above it counts less than squared.
    """

    name: str
    samples: Samples
    batch: int
    data: float
    normal: float
    eikonal: float
    usual: Usual = SQUARES


@dataclass(frozen=True)
class Weights:
    """Weights of the three terms of Eq. 4, as they stand; None is what the fit would take.

    Attributes:
        data: of (f(x) − d)²; the fit's own is `FitConfig.data_weight_after`.
        normal: of 1 − cos(∇f, N).
        eikonal: of (|∇f| − 1)².
    """

    data: float | None = None
    normal: float | None = None
    eikonal: float | None = None

    def resolved(self, config: FitConfig, errors: Tensor, cloud: CloudDistance) -> tuple[float, float, float]:
        """Data, normal and eikonal weight, where the levels before miss the surface samples by ``errors`` ``(n,)``."""
        noise = SAMPLING.left * cloud.noise if cloud.guessed else cloud.noise
        data = config.data_weight_after(float(errors.square().mean()), noise)
        given = (self.data, self.normal, self.eikonal)
        normal, slope = (SAMPLING.guessed_normal, SAMPLING.guessed_slope) if cloud.guessed else (1.0, 1.0)
        usual = (data, normal * config.normal_weight, slope * config.eikonal_weight)
        return tuple(u if g is None else g for g, u in zip(given, usual, strict=True))  # pyright: ignore[reportReturnType]


def first_sources(
    index: CloudDistance, config: FitConfig, *, generator: torch.Generator, device: torch.device
) -> list[Source]:
    """Level 0's: the cloud, and distances in the whole domain."""
    domain = distance_samples(index, config.samples, generator=generator).to(device)
    near, far = config.data_weight, config.data_weight * config.domain_weight
    half = config.batch // 2
    return [
        Source("surface", surface_samples(index).to(device), half, near, config.normal_weight, config.eikonal_weight),
        Source("domain", domain, half, far, 0.0, config.eikonal_weight),
    ]


def banded_sources(
    index: CloudDistance,
    previous: Field,
    delta: float,
    config: FitConfig,
    *,
    generator: torch.Generator,
    weights: Weights | None = None,
    name: str = "cloud",
    options: SampleOptions = SAMPLING,
) -> list[Source]:
    """A residual level's: the cloud, its offsets and dithered points, inside the band (Sec. 3.2); and remote places.

    Where normals are guesses, `near_samples` take the place of offsets, which believe the sign of each normal.

    Args:
        index: the cloud.
        previous: the frozen levels.
        delta: half-width of the band around the finest of them.
        config: weights, batch and number of samples.
        generator: draws the samples.
        weights: other weights than the fit's own.
        name: what messages call the cloud.
        options: numbers of the algorithm.

    Raises:
        InputError: one kind of samples is empty.
    """
    device = previous.like.device
    if index.guessed:
        beside = "near", near_samples(index, delta, config.samples // 4, generator=generator)
    else:
        beside = "offset", offset_samples(index, delta, config.samples, generator=generator)
    band = band_samples(index, delta, config.samples, generator=generator)
    kept = {
        kind: with_previous(samples, previous, delta, device=device)
        for kind, samples in (("surface", surface_samples(index)), beside, ("band", band))
    }
    for kind, samples in kept.items():
        if not len(samples):
            raise InputError(
                f"{name}: no {kind} samples within {delta:.2g} of the level before; train it longer "
                "(--steps) or widen the band (--epsilon)"
            )
    surface = kept["surface"]
    assert surface.value is not None
    terms = (weights or Weights()).resolved(config, surface.value, index)
    third = config.batch // 3
    usual = usual_errors(surface, kept["band"]) if config.robust_normals else SQUARES
    if previous.num_levels == 1:  # corners and thin parts that a coarse level has missed are far: squares reach them
        usual = usual._replace(data=math.inf)
    sources = [Source(kind, samples, third, *terms, usual) for kind, samples in kept.items()]
    # Of its own generator: a cloud without such places is fitted as if nobody had looked for them.
    own = torch.Generator().manual_seed(generator.initial_seed() + 1)
    remote = remote_samples(index, previous, delta, config.samples, generator=own, device=device, options=options)
    for kind, samples in remote._asdict().items():
        if len(samples) >= options.fewest:
            sources.append(Source(kind, samples, third // 4, terms[0], 0.0, 0.0))
    return sources


def usual_errors(surface: Samples, band: Samples) -> Usual:
    """The medians of the terms for the levels before: what is usual on smooth places, of which there are most.

    Nothing turns at once at a sharp edge. The angles that are left there are ten times those of the faces, and so are
    distances, and lengths of gradients beside it; their squares are a hundred times those, and a level would learn of
    nothing else, and leave waves on the faces.

    Args:
        surface: samples with distances and normals.
        band: samples whose lengths of gradients stand for all.
    """
    assert surface.value is not None
    assert surface.distance is not None
    assert surface.gradient is not None
    assert surface.normal is not None
    assert band.gradient is not None
    losses = (
        data_loss(surface.value, surface.distance),
        normal_loss(surface.gradient, surface.normal),
        eikonal_loss(band.gradient),
    )
    return Usual(*(max(float(loss.quantile(0.5)), least) for loss, least in zip(losses, LEAST, strict=True)))


def surface_samples(index: CloudDistance) -> Samples:
    """The cloud itself: distance 0, and its normals."""
    points = torch.from_numpy(index.points)
    return Samples(
        points,
        distance=torch.zeros(len(points)),
        normal=torch.from_numpy(index.normals),
        area=torch.from_numpy(index.weights),
    )


def distance_samples(cloud: CloudDistance, count: int, *, generator: torch.Generator) -> Samples:
    """Points with their signed distance to the cloud: half uniform in the domain, half near the surface.

    The near half is Gaussian around cloud points, with deviations from twice the point spacing to 0.1, so that
    the coarse level sees every scale that it can represent.
    """
    points = spread_points(cloud, count, generator)
    return Samples(points, distance=cloud.signed(points))


class Remote(NamedTuple):
    """Places of a band that are far from every point of the cloud; see `remote_samples`.

    Attributes:
        empty: those that are surely in- or outside, with the distance to the nearest point, up to ±2δ.
        unseen: the others, with the value that the levels before have there.
    """

    empty: Samples
    unseen: Samples


@torch.no_grad()
def remote_samples(
    cloud: CloudDistance,
    field: Field,
    delta: float,
    count: int,
    *,
    generator: torch.Generator,
    device: torch.device,
    options: SampleOptions = SAMPLING,
) -> Remote:
    """Points of the band around ``field`` that are far from every point of the cloud.

    What a coarse level makes of a thin part may be a sheet of surface beside it, through places where it is wrong by
    more than δ: they are empty, for the winding number says that they are surely in- or outside. They get the distance
    to the nearest point, up to ±2δ, which takes them out of the next level's band. Where the winding number is in
    doubt, in the holes of a scan, a surface may well be far from all points. Nothing has been seen of it, and a finer
    level has nothing to add to the coarse one's guess: it shall leave the value that is there.

    Args:
        cloud: the points.
        field: the frozen levels.
        delta: half-width of the band around the finest.
        count: how many points are tried, spread as for level 0; as many again around unseen ones, if there are some.
        generator: draws them.
        device: where the field is.
        options: numbers of the algorithm.

    Returns:
        Samples with distances, values and gradients, on ``device``; often none.
    """

    def found(tried: Tensor) -> Remote:
        samples = with_previous(Samples(tried), field, delta, device=device)
        points = samples.points.cpu().numpy()
        assert samples.value is not None
        distance, clear = cloud.beyond(points, options.clear)
        far = np.flatnonzero(distance - samples.value.abs().cpu().numpy() > np.maximum(delta, clear))
        depth = cloud.winding_number(points[far]) - 0.5
        sure = np.abs(depth) > (options.sure_guessed if cloud.guessed else options.sure)
        empty, unseen = (samples.take(torch.from_numpy(far[some]).to(device)) for some in (sure, ~sure))
        length = np.minimum(distance[far[sure]], 2 * delta)
        signed = np.where(depth[sure] > 0, -length, length).astype(np.float32)
        empty = replace(empty, distance=torch.from_numpy(signed).to(device))
        return Remote(empty, replace(unseen, distance=unseen.value))

    remote = found(spread_points(cloud, count, generator))
    if len(remote.unseen) < options.fewest:
        return remote
    seeds = remote.unseen.points.cpu()[torch.randint(len(remote.unseen), (count,), generator=generator)]
    beside = seeds + (2 * torch.rand(count, 3, generator=generator) - 1) * 2 * delta
    return Remote(remote.empty, found(beside.clamp(-DOMAIN, DOMAIN)).unseen)


def spread_points(cloud: CloudDistance, count: int, generator: torch.Generator) -> Tensor:
    """Places ``(count, 3)``, half uniform in the domain, half near the cloud; see `distance_samples`."""
    near_count = count // 2
    uniform = (2 * torch.rand(count - near_count, 3, generator=generator) - 1) * DOMAIN
    anchors = torch.from_numpy(cloud.points)[cloud.draw(near_count, generator)]
    least = min(2 * cloud.spacing, 0.1)
    deviation = least * (0.1 / least) ** torch.rand(near_count, 1, generator=generator)
    near = (anchors + deviation * torch.randn(near_count, 3, generator=generator)).clamp(-DOMAIN, DOMAIN)
    return torch.cat((uniform, near))


def free_lengths(
    cloud: CloudDistance, delta: float, rows: NDArray[np.integer], inward: NDArray[np.bool_], *, steps: int = 8
) -> Tensor:
    """How far cloud points can be moved along ±normal while they stay the closest: the paper's t_j ≤ δ.

    For each the first t of ``steps`` decreasing ones for which the distance from x_j ± t N_j to the cloud is t, up to
    the spacing of the cloud; 0 where none is.

    Args:
        cloud: the points.
        delta: the largest t.
        rows: ``(M,)`` which points.
        inward: ``(M,)`` whether against the normal.
        steps: how many t are tried.

    Returns:
        ``(M,)``.
    """
    lengths = np.zeros(len(rows), np.float32)
    sign = np.where(inward, -1.0, 1.0)[:, None]
    left = np.arange(len(rows))
    for t in np.linspace(delta, delta / steps, steps):
        moved = cloud.points[rows[left]] + sign[left] * t * cloud.normals[rows[left]]
        # A curved or noisy cloud has points a little nearer than t without another sheet being there.
        clear = cloud.nearest(moved) >= 0.9 * t
        lengths[left[clear]] = t
        left = left[~clear]
    return torch.from_numpy(lengths)


def offset_samples(cloud: CloudDistance, delta: float, count: int, *, generator: torch.Generator) -> Samples:
    """Points x_j + t N_j with distance t and gradient N_j, t uniform in the free length on either side.

    Lengths are found only for what is drawn: of a large cloud that is a small part.
    """
    index = cloud.draw(count, generator)
    side = torch.randint(2, (count,), generator=generator)
    drawn, which = torch.unique(2 * index + side, return_inverse=True)
    lengths = free_lengths(cloud, delta, (drawn // 2).numpy(), (drawn % 2 == 1).numpy())
    t = lengths[which] * torch.rand(count, generator=generator) * (1 - 2.0 * side)
    normal = torch.from_numpy(cloud.normals)[index]
    return Samples(torch.from_numpy(cloud.points)[index] + t[:, None] * normal, distance=t, normal=normal)


def near_samples(cloud: CloudDistance, delta: float, count: int, *, generator: torch.Generator) -> Samples:
    """Cloud points with every coordinate moved by U(−δ, δ), and their signed distances.

    Their signs are those of winding numbers, which weigh all normals against each other; nothing is known of gradients.
    """
    points = band_samples(cloud, delta / 2, count, generator=generator).points
    return Samples(points, distance=cloud.signed(points, soft=CLOUD.soft_guessed))


def band_samples(cloud: CloudDistance, delta: float, count: int, *, generator: torch.Generator) -> Samples:
    """Cloud points with every coordinate moved by U(−2δ, 2δ); `with_previous` rejects those outside the band."""
    index = cloud.draw(count, generator)
    shift = (2 * torch.rand(count, 3, generator=generator) - 1) * 2 * delta
    return Samples(torch.from_numpy(cloud.points)[index] + shift)


@torch.no_grad()
def with_previous(
    samples: Samples,
    field: Field,
    delta: float,
    *,
    device: torch.device,
) -> Samples:
    """Add the frozen levels' value and gradient, and reject the samples outside ``|f| < delta`` or a coarser band."""
    points = samples.points.to(device)
    jets = [field.jet(part) for part in points.split(1 << 16)]
    jet = Jet(*(torch.cat(parts) for parts in zip(*jets, strict=True)))
    size = jet.value.abs()
    kept = size < delta
    if field.num_levels > 1:  # outside a band the value is that of its level, so a smaller one is inside all of them
        unsure = (kept & (size >= field.deltas.min())).nonzero()[:, 0]
        kept[unsure] = field.in_band(points[unsure], level=field.num_levels - 1)
    moved = samples.to(device)
    full = Samples(points, moved.distance, moved.normal, jet.value, jet.gradient, moved.area)
    return full.take(kept.nonzero()[:, 0])
