"""Normals of a cloud without any, directions and signs at once, from what a closed surface's winding number is.

The winding number of area-weighted outward normals μ is 1 inside, 0 outside, and ½ at the points themselves; its
gradient there points inward along the normals. Both conditions together single out the orientation of all points at
once, where propagation from point to point goes wrong for good at one thin or noisy place. In turns, μ takes a step of
steepest descent of ``Σ (w(p_i) − ½)²``, and each normal is turned along −∇w and keeps its length: Lin, Shi and Liu,
"Fast and globally consistent normal orientation based on the winding number normal consistency" (SIGGRAPH Asia 2024).
Dipoles are softened, at first by a third of the shape and then by less and less, on more and more of the points: wide
ones see the shape, narrow ones its thin parts. Ones narrower than the noise would follow it, and are not used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..point_cloud import centred, spread
from .dipoles import DipoleSums
from .noise import noise_level
from .orientation import fit_planes, openness

__all__ = [
    "WINDING",
    "WindingNormals",
    "disc_areas",
    "layer_thickness",
    "misfit",
    "orient_by_winding",
    "winding_normals",
]

Float64 = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class WindingOptions:
    """Normals by winding numbers, in a cloud of radius 1. The misfit is that of `misfit`."""

    widest: float = 0.3  # first softening of the dipoles
    narrowing: float = 1.5  # what each next softening is divided by
    # Points on the square of a softening; of the last, if noise stops there.
    count: float = 1.5
    count_last: float = 4.0
    fewest: int = 500  # points
    noise_widths: float = 1.4  # smallest softening, in standard deviations of the noise
    # Rounds at each softening: at least, at most, and at most with more than so many points.
    fewest_rounds: int = 4
    most_rounds: int = 16
    many: int = 4000
    most_rounds_of_many: int = 6
    still: float = 0.002  # share of the directions that still move when rounds end
    # Misfit of a cloud that fits: closed shapes 0.05 to 0.25, half a sphere 0.2, scans of one side 0.34, sheets 0.5.
    fits: float = 0.25
    hardly_fits: float = 0.33
    much_less: float = 0.75  # of the misfit before, that new signs must leave at most
    open: float = 0.2  # openness from which on a cloud has no inside
    # Of thin parts: narrowest softening in spacings, and most points.
    narrowest: float = 0.2
    limit_of_thin: int = 24_000
    scales: tuple[float, float] = (0.6, 1.0)  # range of the correction of disc areas for noise
    asked: int = 2000  # points that the thickness of the cloud is measured at
    sizes: tuple[int, int, int, int, int] = (16, 32, 64, 128, 256)  # of their neighbourhoods
    neighbors: int = 8  # that share a disc out to the last of them


WINDING = WindingOptions()


def orient_by_winding(points: Float64, normals: Float64, *, limit: int = 16_000) -> Float64 | None:
    """Turn normals to the side that winding numbers say is outside, where that is better than how they point now.

    Nothing is better for a clean closed surface whose normals fit already, nor for an open one, which has no inside.

    Args:
        points: ``(N, 3)``, finite.
        normals: ``(N, 3)`` unit normals, with the signs that propagation has given them.
        limit: see `winding_normals`.

    Returns:
        The normals ``(N, 3)``, some of them turned; None if they should stay as they are.
    """
    some = spread(points, limit)
    # Noise hides single wrong signs from the misfit, and propagation from one noisy normal to the next has many.
    noise = noise_level(centred(points), normals)

    def judged(signed: Float64, softening: float, least: float | None = None) -> float:
        return misfit(points[some], signed[some], softening=softening, least=least)

    before = judged(normals, 2 * noise)
    if before < WINDING.fits and not noise:
        return None
    found = winding_normals(points, limit=limit)
    oriented = _turned(points, normals, found)
    after = judged(oriented, 2 * noise)
    if after >= WINDING.fits:
        thin = narrower_normals(points, normals, found, limit=WINDING.limit_of_thin)
        signed = _turned(points, normals, thin)
        least = thin.softening
        now, since = (judged(n, 2 * thin.noise, least) for n in (signed, normals))
        if now < judged(oriented, 2 * thin.noise, least):
            oriented, before, after = signed, since, now
    if openness(points, oriented) > WINDING.open:
        return None
    return oriented if after < max(WINDING.fits, min(WINDING.hardly_fits, WINDING.much_less * before)) else None


def _turned(points: Float64, normals: Float64, found: WindingNormals) -> Float64:
    """The normals ``(N, 3)`` with the signs of those that were found nearest to each."""
    theirs = found.normals[KDTree(points[found.rows]).query(points, workers=-1)[1]]
    return np.where((normals * theirs).sum(axis=1, keepdims=True) < 0, -normals, normals)


class WindingNormals(NamedTuple):
    """What `winding_normals` finds.

    Attributes:
        rows: ``(n,)`` the points that stand for all, evenly spread.
        normals: ``(n, 3)`` their outward unit normals.
        softening: of the last dipoles, in the units of the cloud; normals are averages over about as much.
        noise: standard deviation of the noise along the normals, in the units of the cloud, or 0.
    """

    rows: Index
    normals: Float64
    softening: float
    noise: float


def winding_normals(points: Float64, *, limit: int = 16_000) -> WindingNormals:
    """Outward normals of points of a closed surface, or nearly so.

    Args:
        points: ``(N, 3)``, finite, at least two places among them.
        limit: how many points are asked, at most; time grows as its power of 1.5.
    """
    unit, radius = _in_unit_ball(points)
    area = float(disc_areas(unit[spread(unit, 4000)]).sum())
    thickness = layer_thickness(unit)
    limit = min(limit, len(unit))

    def widened(rows: Index, normals: Float64, softening: float, count: float) -> tuple[Index, Float64]:
        wanted = int(np.clip(count * area / softening**2, min(WINDING.fewest, limit), limit))
        asked = spread(unit, wanted)
        before = normals[KDTree(unit[rows]).query(unit[asked])[1]]
        most = WINDING.most_rounds if len(asked) <= WINDING.many else WINDING.most_rounds_of_many
        return asked, _consistent(unit[asked], before * area / len(asked), softening, most)

    softening = WINDING.widest
    rows, normals = widened(np.zeros(1, np.int64), np.zeros((1, 3)), softening, WINDING.count)
    noise = min(thickness, noise_level(unit[rows], normals))
    while limit * softening**2 > WINDING.count * area and softening / WINDING.narrowing > WINDING.noise_widths * noise:
        softening /= WINDING.narrowing
        rows, normals = widened(rows, normals, softening, WINDING.count)
        noise = min(thickness, noise_level(unit[rows], normals))
    if limit * softening**2 > WINDING.count * area:
        rows, normals = widened(rows, normals, softening, WINDING.count_last)
        noise = min(thickness, noise_level(unit[rows], normals))
    return WindingNormals(rows, normals, softening * radius, noise * radius)


def narrower_normals(points: Float64, normals: Float64, found: WindingNormals, *, limit: int) -> WindingNormals:
    """The normals of `winding_normals` worked out again, for parts that are as thin as the points lie close.

    The two sides of such a part cancel in dipoles that are wider than it is, and nothing says which is which. So these
    are narrowed to a fraction of a spacing; and where a wrong patch begins to turn, that is waited for. As long as the
    sides are mixed up, their distance looks like noise, and noise is what stops narrower dipoles: it is measured again
    when they are told apart, and if there still is some they stop there after all.

    Args:
        points: ``(N, 3)``, finite.
        normals: ``(N, 3)`` unit normals with any signs.
        found: what `winding_normals` made of the points.
        limit: how many points are asked, at most.
    """
    unit, radius = _in_unit_ball(points)
    rows = spread(unit, limit)
    areas = disc_areas(unit[rows])
    narrowest = WINDING.narrowest * float(np.sqrt(np.median(areas)))
    softenings = [found.softening / radius]
    steps = [found.normals[KDTree(unit[found.rows]).query(unit[rows])[1]]]
    while softenings[-1] > narrowest:
        softenings.append(softenings[-1] / WINDING.narrowing)
        steps.append(_consistent(unit[rows], steps[-1] * areas[:, None], softenings[-1], WINDING.most_rounds))
    last = WindingNormals(rows, steps[-1], softenings[-1] * radius, 0.0)
    noise = noise_level(unit, _turned(points, normals, last))
    if WINDING.noise_widths * noise <= softenings[-1]:
        return last
    allowed = max(1, sum(softening > WINDING.noise_widths * noise for softening in softenings)) - 1
    return WindingNormals(rows, steps[allowed], softenings[allowed] * radius, noise * radius)


def _in_unit_ball(points: Float64) -> tuple[Float64, float]:
    """The points round the middle of their box, over the largest distance from it; and that distance."""
    moved = points - (points.max(axis=0) + points.min(axis=0)) / 2
    radius = float(np.linalg.norm(moved, axis=1).max())
    return moved / radius, radius


def _consistent(points: Float64, dipoles: Float64, softening: float, most: int) -> Float64:
    """Unit normals ``(n, 3)``, from dipoles ``(n, 3)`` to begin with, which may be zero, in so many rounds at most."""
    sums = DipoleSums(points, softening)
    mu = torch.from_numpy(dipoles.astype(np.float32))
    normals = torch.nn.functional.normalize(mu)
    for done in range(1, 1 + most):
        step = sums.adjoint(0.5 - sums.winding(mu))
        change = sums.winding(step)
        mu = mu + step * ((step**2).sum() / (change**2).sum().clamp(min=1e-30))
        turned = torch.nn.functional.normalize(sums.descent(mu), eps=1e-30)
        mu = turned * mu.norm(dim=1, keepdim=True)
        moved = float(((turned * normals).sum(dim=1) < 0.5).float().mean())
        normals = turned
        if done >= WINDING.fewest_rounds and moved < WINDING.still:
            break
    return normals.double().numpy()


def misfit(points: Float64, normals: Float64, *, softening: float = 0.0, least: float | None = None) -> float:
    """How far the winding number at points ``(N, 3)`` with unit normals ``(N, 3)`` is from ½, in the root mean square.

    It is averaged over leaves of some 48 neighbours first, so that noise counts little: 0 for a closed surface with
    outward normals, ½ for an open flat one; every wrong sign adds to it.

    Args:
        points: ``(N, 3)``.
        normals: ``(N, 3)``.
        softening: of the dipoles: twice the noise's standard deviation.
        least: how wide they are in any case; None for 1.5 spacings, in which sides of thinner parts cancel.
    """
    unit, radius = _in_unit_ball(points)
    areas = disc_areas(unit)
    narrowest = 1.5 * float(np.sqrt(np.median(areas))) if least is None else least / radius
    sums = DipoleSums(unit, max(softening / radius, narrowest))
    mean = sums.leaf_means(sums.winding(torch.from_numpy((normals * areas[:, None]).astype(np.float32))))
    if (
        softening
    ):  # noise moves neighbours apart, so that their discs look larger than what they share, by as much for all
        mean *= (0.5 * mean.sum() / mean.square().sum().clamp(min=1e-12)).clamp(*WINDING.scales)
    return float((mean - 0.5).square().mean().sqrt())


def layer_thickness(points: Float64, *, flat: float = 0.25, seed: int = 0) -> float:
    """The standard deviation of points ``(N, 3)`` from the planes through their neighbourhoods.

    Neighbourhoods are the smallest, of `sizes` points, that look flat: whose thickness is below ``flat`` times their
    radius in the median. No sign is asked for, so what is thinner than the noise counts as noise.
    """
    asked = np.random.default_rng(seed).permutation(len(points))[: WINDING.asked]
    found = KDTree(points).query(points[asked], k=min(WINDING.sizes[-1], len(points)), workers=-1)
    distance, near = np.asarray(found[0]), np.asarray(found[1])
    thickness = 0.0
    for size in WINDING.sizes:
        _, spread = fit_planes(points[near[:, :size]])
        radius = distance[:, min(size, near.shape[1]) - 1]
        thickness = float(np.median(spread))
        if np.median(spread / np.maximum(radius, 1e-300)) < flat:
            break
    return thickness


def disc_areas(points: Float64, *, largest: float = 100.0) -> Float64:
    """The area ``(N,)`` that each point has to itself: that of the disc out to its neighbours, over their number.

    Those larger than ``largest`` times the median are of points on their own, which have no surface of that size.
    """
    count = min(WINDING.neighbors, len(points) - 1)
    reach = np.asarray(KDTree(points).query(points, k=count + 1, workers=-1)[0])[:, -1]
    areas = np.pi * reach**2 / count
    return np.minimum(areas, largest * np.median(areas))
