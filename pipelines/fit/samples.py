"""What a level learns from (paper Sec. 3.2): samples of the domain for level 0, of the band for residual levels.

Samples are made once, with the value and gradient of the frozen levels, so that a step evaluates one network only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Field, InputError
from ...neural_fields.fields.losses import data_loss, eikonal_loss, normal_loss, pseudo_huber
from ..training.settings import FitConfig
from .cloud import CLOUD, CloudDistance

DOMAIN = 1.05  # half-edge of the cube in which level 0 learns distances: the mesher's box [-1, 1]³ and a margin


@dataclass(frozen=True)
class SampleOptions:
    """Numbers of `banded_sources`."""

    sure: float = 0.4  # least distance of a winding number from one half to give a side; its error is below 0.05
    sure_guessed: float = 0.3  # the same for estimated normals, which are wrong at thin parts
    # Weights of terms where normals were estimated, over those of the settings: such normals are wrong by tens of
    # degrees at thin parts and under noise, where no field of slope 1 fits the points either.
    guessed_normal: float = 0.1
    guessed_slope: float = 0.2
    left: float = 0.4  # part of the noise that smoothing leaves without normals: median on six shapes with 0.5 and 1 %
    clear: float = 4.0  # distance to all points, in spacings, from which on a place is not between them
    least: float = 0.5  # of δ: nearer than that to a clear place the surface is not; farther than the points it is not
    right: float = 0.1  # error of a clear place in units of the mean one, with which it is drawn if it has none
    fewest: int = 32  # off-surface samples, below which they get no share of the batch


SAMPLING = SampleOptions()


class Rows:
    """Columns of equal length about points: a base of dataclasses of tensors or None."""

    points: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def take(self, index: Tensor | slice) -> Self:
        """The rows at ``index``."""
        return self._each(lambda column: column[index])

    def to(self, device: torch.device) -> Self:
        """The same rows on another device."""
        return self._each(lambda column: column.to(device))

    def joined(self, other: Self) -> Self:
        """These rows and those of ``other``, which has the same columns."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return type(self)(*(None if one is None else torch.cat((one, two)) for one, two in pairs))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Self:
        return type(self)(*(None if column is None else change(column) for column in vars(self).values()))


@dataclass(frozen=True)
class Samples(Rows):
    """Points with their known distances ``(N,)`` and normals ``(N, 3)``, and the jet of the levels before."""

    points: Tensor
    distance: Tensor | None = None  # None: only |∇f| = 1 is known
    normal: Tensor | None = None  # the known unit gradient
    value: Tensor | None = None  # of the levels before; None at level 0
    gradient: Tensor | None = None
    area: Tensor | None = None  # weights for drawing; None for equal ones

    def known(self, *names: str) -> list[Tensor]:
        """Columns that have to be there."""
        columns = [getattr(self, name) for name in names]
        assert not any(column is None for column in columns), names
        return columns


class RobustScales(NamedTuple):
    """Robust scale of each term of Eq. 4, see `pseudo_huber`; infinity leaves a term squared."""

    data: float = math.inf  # of (f(x) − d)²
    normal: float = math.inf  # of 1 − cos(∇f, N)
    eikonal: float = math.inf  # of (|∇f| − 1)²


SQUARES = RobustScales()
LEAST = RobustScales(1e-12, 1e-6, 1e-6)  # least scales: float32 rounds f to about 1e-7 and cosines to 6e-8


@dataclass(frozen=True)
class Source:
    """Samples, how many of them go into each batch, the weights of their terms, and robust scales."""

    name: str
    samples: Samples
    batch: int
    data: float  # weight of (f(x) − d)²
    normal: float  # weight of 1 − cos(∇f, N)
    eikonal: float  # weight of (|∇f| − 1)²
    scales: RobustScales = SQUARES
    least: float = math.inf  # size of f(x) from which on up to |d| it has no error

    def terms(self, value: Tensor, gradient: Tensor, batch: Samples) -> Iterator[tuple[str, float, Tensor]]:
        """Name, weight and losses ``(n,)`` of each term at some of the samples, for the jet of a field there."""
        scales = self.scales
        yield "eikonal", self.eikonal, pseudo_huber(eikonal_loss(gradient), scales.eikonal)
        if batch.distance is not None:
            known = batch.distance
            if self.least < math.inf:
                known = nearest_known(value.detach(), known, self.least)
            yield "data", self.data, pseudo_huber(data_loss(value, known), scales.data)
        if batch.normal is not None:
            yield "normal", self.normal, pseudo_huber(normal_loss(gradient, batch.normal), scales.normal)

    def begins(self) -> float:
        """The weighted sum of its terms with the levels before alone."""
        area = torch.ones_like(self.samples.points[:, 0]) if self.samples.area is None else self.samples.area
        value, gradient = self.samples.known("value", "gradient")
        terms = self.terms(value, gradient, self.samples)
        return float(sum(weight * (area * loss).sum() for _, weight, loss in terms) / area.sum())

    def held_back(self, others: Sequence[Source]) -> Source:
        """The source that begins with no more loss than the ``others``; its scale is a median where theirs are.

        Far places with errors as large as the band would else be all that a level learns from.
        """
        usual = math.inf
        if others[0].scales.data < usual:
            usual = max(float(data_loss(*self.samples.known("value", "distance")).median()), LEAST.data)
        source = replace(self, scales=self.scales._replace(data=usual))
        share = sum(other.begins() for other in others) / max(source.begins(), 1e-30)
        return replace(source, data=min(share, 1.0) * self.data)


def nearest_known(value: Tensor, distance: Tensor, least: float) -> Tensor:
    """The distance nearest to ``value`` that is possible: of the sign of ``distance``, from ``least`` to its size."""
    nearer = distance.clamp(-least, least)
    return value.clamp(torch.minimum(nearer, distance), torch.maximum(nearer, distance))


def level_weights(config: FitConfig, errors: Tensor, cloud: CloudDistance) -> tuple[float, float, float]:
    """Data, normal and eikonal weight of a level, for ``errors`` ``(n,)`` of those before at the surface samples."""
    noise = SAMPLING.left * cloud.noise if cloud.guessed else cloud.noise
    data = config.data_weight_after(float(errors.square().mean()), noise)
    normal, slope = (SAMPLING.guessed_normal, SAMPLING.guessed_slope) if cloud.guessed else (1.0, 1.0)
    return data, normal * config.normal_weight, slope * config.eikonal_weight


def first_sources(
    index: CloudDistance, config: FitConfig, *, generator: torch.Generator, device: torch.device
) -> list[Source]:
    """Of level 0: the cloud, and distances in the whole domain."""
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
    name: str = "cloud",
    options: SampleOptions = SAMPLING,
) -> list[Source]:
    """Sources of a residual level: the cloud, and offset, band and off-surface samples around ``previous`` (Sec. 3.2).

    Where normals were estimated, `near_samples` replace the offsets, which rely on the sign of each normal. Without
    samples of a kind, an `InputError` calls the cloud ``name``.
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
    terms = level_weights(config, surface.known("value")[0], index)
    third = config.batch // 3
    scales = robust_scales(surface, kept["band"]) if config.robust_normals else SQUARES
    if previous.num_levels == 1:  # squares reach corners and thin parts that level 0 has missed
        scales = scales._replace(data=math.inf)
    sources = [Source(kind, samples, third, *terms, scales) for kind, samples in kept.items()]
    # A generator of its own, so that the search leaves the fit of a cloud without such samples unchanged.
    own = torch.Generator().manual_seed(generator.initial_seed() + 1)
    found = off_surface_samples(
        index, previous, kept["band"], delta, config.samples, generator=own, device=device, options=options
    )
    for kind, samples in found._asdict().items():
        if len(samples) >= options.fewest:
            source = Source(kind, samples, third // 4, terms[0], 0.0, 0.0)
            clear = kind == "clear"
            sources.append(replace(source, least=options.least * delta).held_back(sources) if clear else source)
    return sources


def robust_scales(surface: Samples, band: Samples) -> RobustScales:
    """Robust scale of each term: its median for the levels before, which is the error on smooth faces.

    Errors at sharp edges are about ten times those of faces. Squared, they would dominate the loss and leave waves on
    the faces.
    """
    losses = (
        data_loss(*surface.known("value", "distance")),
        normal_loss(*surface.known("gradient", "normal")),
        eikonal_loss(*band.known("gradient")),
    )
    return RobustScales(*(max(float(loss.quantile(0.5)), least) for loss, least in zip(losses, LEAST, strict=True)))


def surface_samples(index: CloudDistance) -> Samples:
    """The cloud itself, with distance 0 and its normals."""
    points = torch.from_numpy(index.points)
    return Samples(
        points,
        distance=torch.zeros(len(points)),
        normal=torch.from_numpy(index.normals),
        area=torch.from_numpy(index.weights),
    )


def distance_samples(cloud: CloudDistance, count: int, *, generator: torch.Generator) -> Samples:
    """``count`` points of `spread_points` with their signed distances to the cloud."""
    points = spread_points(cloud, count, generator)
    return Samples(points, distance=cloud.signed(points))


class OffSurface(NamedTuple):
    """Samples of a band far from every point of the cloud, see `off_surface_samples`; field names are source names."""

    clear: Samples  # of clear sign
    unseen: Samples  # of uncertain sign


@torch.no_grad()
def off_surface_samples(
    cloud: CloudDistance,
    field: Field,
    band: Samples,
    delta: float,
    count: int,
    *,
    generator: torch.Generator,
    device: torch.device,
    options: SampleOptions = SAMPLING,
) -> OffSurface:
    """Samples of the band around ``field`` that are far from every point of the cloud; often none.

    ``clear``: the winding number is clear. Their distance is at most that to the nearest point, up to ±2δ, and at least
    the share `least` of δ. Without them a level that cannot resolve a thin part closes a volume around it. They are
    drawn in proportion to the error of the level before, and to the share `right` of the mean error.

    ``unseen``: the winding number is uncertain, as in holes of scans, and no point is as near as the surface of the
    level before; they keep its value. ``count`` points are tried, spread as for level 0, of the samples ``band`` a
    quarter as many, and ``count`` more around unseen ones.
    """

    def found(samples: Samples, *, lost_only: bool = False) -> OffSurface:
        points, (value,) = samples.points.cpu().numpy(), samples.known("value")
        distance, gap = cloud.nearest_gap(points)
        lost = distance - value.abs().cpu().numpy() > np.maximum(delta, options.clear * gap)
        away = np.flatnonzero(lost if lost_only else distance > options.clear * gap + CLOUD.chance * cloud.noise)
        depth = cloud.winding_number(points[away]) - 0.5
        sure = np.abs(depth) > (options.sure_guessed if cloud.guessed else options.sure)
        unseen = samples.take(torch.from_numpy(away[~sure & lost[away]]).to(device))
        rows = torch.from_numpy(away[sure]).to(device)
        length = np.minimum(distance[away[sure]], 2 * delta)
        signed = torch.from_numpy(np.where(depth[sure] > 0, -length, length).astype(np.float32)).to(device)
        error = (value[rows] - nearest_known(value[rows], signed, options.least * delta)).abs()
        clear = replace(samples.take(rows), distance=signed, area=error + options.right * error.mean())
        return OffSurface(clear, replace(unseen, distance=unseen.value))

    def placed(points: Tensor) -> Samples:
        return with_previous(Samples(points), field, delta, device=device)

    first = found(placed(spread_points(cloud, count, generator)).joined(band.take(slice(count // 4))))
    if len(first.unseen) < options.fewest:
        return first
    seeds = first.unseen.points.cpu()[torch.randint(len(first.unseen), (count,), generator=generator)]
    beside = seeds + (2 * torch.rand(count, 3, generator=generator) - 1) * 2 * delta
    return first._replace(unseen=found(placed(beside.clamp(-DOMAIN, DOMAIN)), lost_only=True).unseen)


def spread_points(cloud: CloudDistance, count: int, generator: torch.Generator) -> Tensor:
    """Places ``(count, 3)``: half uniform in the domain, half near the cloud.

    The near half is Gaussian around cloud points, with deviations from twice the spacing to 0.1: all scales of level 0.
    """
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
    """How far ``(M,)`` cloud points can be moved along ±normal while they stay the closest: the paper's t_j ≤ δ.

    The first t of ``steps`` decreasing ones for which the distance from x_j ± t N_j to the cloud is t, up to the
    spacing; 0 without one. ``rows`` and ``inward`` ``(M,)`` name the points and the side.
    """
    lengths = np.zeros(len(rows), np.float32)
    sign = np.where(inward, -1.0, 1.0)[:, None]
    left = np.arange(len(rows))
    for t in np.linspace(delta, delta / steps, steps):
        moved = cloud.points[rows[left]] + sign[left] * t * cloud.normals[rows[left]]
        # On a curved or noisy sheet other points of it are a little nearer than t.
        clear = cloud.nearest(moved) >= 0.9 * t
        lengths[left[clear]] = t
        left = left[~clear]
    return torch.from_numpy(lengths)


def offset_samples(cloud: CloudDistance, delta: float, count: int, *, generator: torch.Generator) -> Samples:
    """Points x_j + t N_j with distance t and gradient N_j, t uniform in the free length on either side."""
    index = cloud.draw(count, generator)
    side = torch.randint(2, (count,), generator=generator)
    drawn, which = torch.unique(2 * index + side, return_inverse=True)
    lengths = free_lengths(cloud, delta, (drawn // 2).numpy(), (drawn % 2 == 1).numpy())
    t = lengths[which] * torch.rand(count, generator=generator) * (1 - 2.0 * side)
    normal = torch.from_numpy(cloud.normals)[index]
    return Samples(torch.from_numpy(cloud.points)[index] + t[:, None] * normal, distance=t, normal=normal)


def near_samples(cloud: CloudDistance, delta: float, count: int, *, generator: torch.Generator) -> Samples:
    """Cloud points with every coordinate moved by U(−δ, δ), and their signed distances.

    Winding numbers give the signs: they weigh all normals together. Gradients are unknown.
    """
    points = band_samples(cloud, delta / 2, count, generator=generator).points
    return Samples(points, distance=cloud.signed(points, soft=CLOUD.soft_guessed))


def band_samples(cloud: CloudDistance, delta: float, count: int, *, generator: torch.Generator) -> Samples:
    """Cloud points with every coordinate moved by U(−2δ, 2δ); `with_previous` rejects those outside the band."""
    index = cloud.draw(count, generator)
    shift = (2 * torch.rand(count, 3, generator=generator) - 1) * 2 * delta
    return Samples(torch.from_numpy(cloud.points)[index] + shift)


def with_previous(samples: Samples, field: Field, delta: float, *, device: torch.device) -> Samples:
    """Add value and gradient of the frozen levels, and drop samples outside ``|f| < delta`` or a coarser band."""
    moved = samples.to(device)
    value, gradient = value_and_gradient(field, moved.points)
    size = value.abs()
    kept = size < delta
    if field.num_levels > 1:  # values below every δ are inside all bands
        unsure = (kept & (size >= field.deltas.min())).nonzero()[:, 0]
        kept[unsure] = field.in_band(moved.points[unsure], level=field.num_levels - 1)
    return replace(moved, value=value, gradient=gradient).take(kept.nonzero()[:, 0])


def at_feet(samples: Samples, field: Field, *, device: torch.device) -> Samples:
    """Samples moved by −f ∇f / |∇f| onto the surface of the frozen levels, with value and gradient of where they were.

    A residual level changes the distance of a point to the surface by its value at the foot, however far the point is.
    """
    moved = samples.to(device)
    value, gradient = value_and_gradient(field, moved.points)
    feet = moved.points - value[:, None] * torch.nn.functional.normalize(gradient, dim=1)
    return replace(moved, points=feet, value=value, gradient=gradient)


@torch.no_grad()
def value_and_gradient(field: Field, points: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
    """Value ``(N,)`` and gradient ``(N, 3)`` at points ``(N, 3)``, in parts that bound memory."""
    value, gradient, _ = zip(*(field.jet(part, level=level) for part in points.split(1 << 16)), strict=True)
    return torch.cat(value), torch.cat(gradient)


@dataclass(frozen=True)
class BandOptions:
    """Numbers of `delta_of` and `with_wrong_sides`."""

    # Largest error over its 99th percentile: 1.0 for uniform noise, 1.6 for Gaussian, 2 to 3 for missed fine parts.
    stray: float = 4.0
    tail: float = 20.0  # largest error over its 90th percentile: a level may miss a thin part as a whole
    widest: float = 2.0  # largest factor by which places on the wrong side widen a band
    first: int = 4  # a quarter of the places is tried first: winding numbers are slow, and mostly none is wrong


BAND = BandOptions()


@dataclass(frozen=True)
class Band:
    """The band around a level: its half-width, the rule that gave it, and the number of input points outside."""

    delta: float
    rule: str
    outside: int

    @classmethod
    def of(cls, delta: float, rule: str, errors: Tensor) -> Band:
        """The band of half-width ``delta``, with the count of the ``errors`` ``(n,)`` of the points beyond it."""
        return cls(delta, rule, int((errors.abs() >= delta).sum()))

    def within(self, before: float | None, errors: Tensor) -> Band:
        """This band, or where it is wider than ``before``, one of that half-width: bands nest."""
        if before is None or self.delta <= before:
            return self
        return Band.of(before, "no wider than the band before", errors)


def band_of(errors: Tensor, *, epsilon: float, quantile: float | None) -> Band:
    """The band of `delta_of` around a level with ``errors`` ``(n,)`` at the input points, and its rule."""
    # A level that is exact at every point would leave no band.
    delta = max(delta_of(errors, epsilon=epsilon, quantile=quantile), 1e-6)
    strays = float(errors.abs().max()) * (1 + epsilon) > delta
    rule = "quantile" if quantile is not None else "maximum but for strays" if strays else "maximum"
    return Band.of(delta, rule, errors)


def delta_of(errors: Tensor, *, epsilon: float, quantile: float | None, options: BandOptions = BAND) -> float:
    """The half-width of a band, ``δ = (1 + ε) · Q_q(|f(x_j)|)``; the paper's Eq. 5 at ``quantile = 1``.

    A single stray point would widen the maximum of Eq. 5 to half the domain. With ``quantile=None`` the maximum is over
    the points within `stray` times the 99th and `tail` times the 90th percentile, which holds every point of a clean
    cloud.
    """
    ordered = errors.abs().flatten().sort().values
    if quantile is None:
        limit = min(
            q * ordered[math.ceil(share * len(ordered)) - 1]
            for q, share in ((options.stray, 0.99), (options.tail, 0.9))
        )
        return (1 + epsilon) * float(ordered[ordered <= limit][-1])
    return (1 + epsilon) * float(ordered[max(0, math.ceil(quantile * len(ordered)) - 1)])


@torch.no_grad()
def with_wrong_sides(
    band: Band,
    errors: Tensor,
    cloud: CloudDistance,
    field: Field,
    *,
    epsilon: float,
    count: int,
    seed: int,
    device: torch.device,
    options: BandOptions = BAND,
) -> Band:
    """This band, or a wider one that also holds the places which ``field`` puts on the wrong side.

    A coarse level may close a thin part by a sheet far from all points, with places behind it deeper than the band,
    where no finer level would be evaluated. Such places are further than δ on one side and, by a clear winding
    number, on the other. The new half-width is (1 + ε) max |f| over them, at most `widest` times the old one. ``count``
    places are tried, spread as for level 0, the rest only if there is one among the first part.
    """
    generator = torch.Generator().manual_seed(seed)
    wrong = _wrong_sides(band.delta, cloud, field, spread_points(cloud, count // options.first, generator), device)
    if not len(wrong):
        return band
    more = _wrong_sides(band.delta, cloud, field, spread_points(cloud, count, generator), device)
    widest = float(torch.cat((wrong, more)).abs().max())
    delta = min((1 + epsilon) * widest, options.widest * band.delta)
    return Band.of(delta, "places on the wrong side", errors)


def _wrong_sides(delta: float, cloud: CloudDistance, field: Field, places: Tensor, device: torch.device) -> Tensor:
    """Values ``(m,)`` of the field at those of the places ``(M, 3)`` that are deeper than δ on the wrong side."""
    value = torch.cat([field.value(part.to(device)).cpu() for part in places.split(1 << 16)])
    beyond = (value.abs() > delta).nonzero()[:, 0]
    points, value = places[beyond].numpy(), value[beyond]
    depth = cloud.winding_number(points) - 0.5
    wrong = (np.abs(depth) > SAMPLING.sure) & ((depth > 0) == (value.numpy() > 0))
    distance, gap = cloud.nearest_gap(points)
    wrong &= distance > SAMPLING.clear * gap
    return value[torch.from_numpy(wrong)]
