"""Normals of a closed cloud by winding numbers, 1 inside and 0 outside, and sums over pairs of dipoles for these.

A dipole μ at p, a normal times an area, has at x the winding number ``⟨p − x, μ⟩ K``, ``K = (r² + ε²)^(−3/2) / 4π``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ..point_cloud import Float64, Int64, centred, spread
from .noise import noise_level
from .orientation import fit_planes, openness, query


@dataclass(frozen=True)
class WindingOptions:
    """Normals by winding numbers, in a cloud of radius 1. The misfit is that of `misfit`."""

    widest: float = 0.3  # first softening of the dipoles
    narrowing: float = 1.5  # ratio of successive softenings
    count: float = 1.5  # points on the square of a softening
    count_last: float = 4.0  # the same of the last softening, if noise stops there
    fewest: int = 500  # points
    noise_widths: float = 1.4  # smallest softening, in standard deviations of the noise
    fewest_rounds: int = 4  # at each softening
    most_rounds: int = 16
    many: int = 4000  # points from which on the next limit of rounds holds
    most_rounds_of_many: int = 6
    still: float = 0.002  # fraction of the directions that still turn when rounds end
    fits: float = 0.25  # largest misfit: closed shapes 0.05 to 0.25, half a sphere 0.2
    hardly_fits: float = 0.33  # the same if it fell by `much_less`: scans of one side 0.34, sheets 0.5
    much_less: float = 0.75  # largest ratio of the misfits after and before
    open: float = 0.2  # openness from which on a cloud has no inside
    narrowest: float = 0.2  # softening for thin parts, in spacings
    limit: int = 16_000  # most points; time grows as its power of 1.5
    limit_of_thin: int = 24_000  # most points for thin parts
    scales: tuple[float, float] = (0.6, 1.0)  # range of the correction of disc areas for noise
    sample: int = 2000  # points at which the thickness of the cloud is measured
    sizes: tuple[int, int, int, int, int] = (16, 32, 64, 128, 256)  # of their neighbourhoods
    flat: float = 0.25  # thickness over radius of a flat neighbourhood
    neighbors: int = 8  # that share a disc out to the last of them
    largest: float = 100.0  # area of a disc, in medians


WINDING = WindingOptions()


def orient_by_winding(points: Float64, normals: Float64) -> Float64 | None:
    """Normals ``(N, 3)`` on the outer side by winding numbers, or None where that is no improvement.

    It is none for a clean closed surface whose normals fit already, nor for an open one, which has no inside.
    """
    some = spread(points, WINDING.limit)
    # The misfit of a noisy cloud hides single wrong signs, and propagation makes many there.
    noise = noise_level(centred(points), normals)

    def judged(signed: Float64, softening: float, least: float | None = None) -> float:
        return misfit(points[some], signed[some], softening=softening, least=least)

    before = judged(normals, 2 * noise)
    if before < WINDING.fits and not noise:
        return None
    found = winding_normals(points)
    oriented = _turned(points, normals, found)
    after = judged(oriented, 2 * noise)
    if after >= WINDING.fits:
        thin = narrower_normals(points, normals, found)
        signed = _turned(points, normals, thin)
        least = thin.softening
        now, since = (judged(n, 2 * thin.noise, least) for n in (signed, normals))
        if now < judged(oriented, 2 * thin.noise, least):
            oriented, before, after = signed, since, now
    if openness(points, oriented) > WINDING.open:
        return None
    return oriented if after < max(WINDING.fits, min(WINDING.hardly_fits, WINDING.much_less * before)) else None


def _turned(points: Float64, normals: Float64, found: WindingNormals) -> Float64:
    """The normals ``(N, 3)`` with the signs of the found ones nearest to each."""
    theirs = found.normals[query(KDTree(points[found.rows]), points, 1)[1][:, 0]]
    return np.where((normals * theirs).sum(axis=1, keepdims=True) < 0, -normals, normals)


class WindingNormals(NamedTuple):
    """Evenly spread points ``rows`` ``(n,)``, their outward normals ``(n, 3)``, and lengths in units of the cloud."""

    rows: Int64
    normals: Float64
    softening: float  # of the last dipoles
    noise: float  # standard deviation along the normals, or 0


def winding_normals(points: Float64) -> WindingNormals:
    """Outward normals of finite points ``(N, 3)``, at least two places, of a closed surface, or nearly so."""
    unit, radius = _in_unit_ball(points)
    area = float(disc_areas(unit[spread(unit, 4000)]).sum())
    thickness = layer_thickness(unit)
    limit = min(WINDING.limit, len(unit))

    def refined(last: WindingNormals, softening: float, count: float) -> WindingNormals:
        wanted = int(np.clip(count * area / softening**2, min(WINDING.fewest, limit), limit))
        rows = spread(unit, wanted)
        before = last.normals[query(KDTree(unit[last.rows]), unit[rows], 1)[1][:, 0]]
        most = WINDING.most_rounds if len(rows) <= WINDING.many else WINDING.most_rounds_of_many
        normals = _consistent(unit[rows], before * area / len(rows), softening, most)
        return WindingNormals(rows, normals, softening, min(thickness, noise_level(unit[rows], normals)))

    nothing = WindingNormals(np.zeros(1, np.int64), np.zeros((1, 3)), WINDING.widest, 0.0)
    found = refined(nothing, WINDING.widest, WINDING.count)
    while limit * found.softening**2 > WINDING.count * area:
        narrower = found.softening / WINDING.narrowing
        if narrower <= WINDING.noise_widths * found.noise:
            found = refined(found, found.softening, WINDING.count_last)
            break
        found = refined(found, narrower, WINDING.count)
    return WindingNormals(found.rows, found.normals, found.softening * radius, found.noise * radius)


def narrower_normals(points: Float64, normals: Float64, found: WindingNormals) -> WindingNormals:
    """`winding_normals` worked out again with narrower dipoles, for parts as thin as the spacing.

    The two sides of such a part cancel in wider dipoles. Until they are told apart, their distance looks like noise:
    the noise is measured again afterwards, and limits the softening then.
    """
    unit, radius = _in_unit_ball(points)
    rows = spread(unit, WINDING.limit_of_thin)
    areas = disc_areas(unit[rows])
    narrowest = WINDING.narrowest * float(np.sqrt(np.median(areas)))
    softenings = [found.softening / radius]
    steps = [found.normals[query(KDTree(unit[found.rows]), unit[rows], 1)[1][:, 0]]]
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
    """Unit normals ``(n, 3)`` after at most ``most`` rounds from dipoles ``(n, 3)``, which may be zero.

    In turns, μ takes a step of steepest descent of ``Σ (w(p_i) − ½)²`` and is turned along −∇w (Lin, Shi and Liu, "Fast
    and globally consistent normal orientation based on the winding number normal consistency", SIGGRAPH Asia 2024).
    """
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
    """The root mean square of winding number − ½ at points ``(N, 3)`` with unit normals ``(N, 3)``.

    Means over leaves are taken first, so that noise counts little: 0 for a closed surface with outward normals, ½ for
    an open flat one. ``softening``: twice the noise. ``least``: smallest softening, by default 1.5 spacings.
    """
    unit, radius = _in_unit_ball(points)
    areas = disc_areas(unit)
    narrowest = 1.5 * float(np.sqrt(np.median(areas))) if least is None else least / radius
    sums = DipoleSums(unit, max(softening / radius, narrowest))
    mean = sums.leaf_means(sums.winding(torch.from_numpy((normals * areas[:, None]).astype(np.float32))))
    if softening:  # noise moves neighbours apart, so that all discs are too large by about the same factor
        mean *= (0.5 * mean.sum() / mean.square().sum().clamp(min=1e-12)).clamp(*WINDING.scales)
    return float((mean - 0.5).square().mean().sqrt())


def layer_thickness(points: Float64) -> float:
    """The standard deviation of points ``(N, 3)`` from planes through the smallest flat neighbourhoods of `sizes`."""
    some = np.random.default_rng(0).permutation(len(points))[: WINDING.sample]
    distance, near = query(KDTree(points), points[some], WINDING.sizes[-1])
    thickness = 0.0
    for size in WINDING.sizes:
        _, spread = fit_planes(points[near[:, :size]])
        radius = distance[:, min(size, near.shape[1]) - 1]
        thickness = float(np.median(spread))
        if np.median(spread / np.maximum(radius, 1e-300)) < WINDING.flat:
            break
    return thickness


def disc_areas(points: Float64) -> Float64:
    """The area ``(N,)`` of each point: that of the disc out to its last neighbour, over their number.

    It is limited to a multiple of the median, as points on their own have no surface of that size.
    """
    count = min(WINDING.neighbors, len(points) - 1)
    reach = query(KDTree(points), points, count + 1)[0][:, -1]
    areas = np.pi * reach**2 / count
    return np.minimum(areas, WINDING.largest * np.median(areas))


@dataclass(frozen=True)
class DipoleOptions:
    """How sums over dipoles are split into leaves."""

    leaf: int = 48  # points of a leaf, about
    near: float = 1.4  # distance of the middles of near leaves, in sums of their radii; sums are then off by 2 %
    most_leaves: int = 2048  # of larger clouds, leaves are larger
    batch: int = 1 << 22  # pairs handled at once, to bound memory


DIPOLES = DipoleOptions()


class _Batch(NamedTuple):
    """Rows ``(b,)`` with about as many near leaves ``(b, c)``; ``there`` ``(b, c, 1, 1)`` is 0 for padding."""

    leaves: Tensor
    near: Tensor
    there: Tensor


class DipoleSums:
    """Float32 sums over the pairs of ``(N, 3)`` points within the unit sphere, with the softening ε > 0, a length.

    Points are summed one by one in near leaves of a k-d tree, and as a single dipole at the middle of a further one.
    That takes N^1.5 operations instead of N² (20,000 points: 3 % of the pairs).
    """

    def __init__(self, points: Float64, softening: float) -> None:
        order, real, leaves = _leaves(points)
        self._count, self._leaves = len(points), leaves
        self._order, self._real = torch.from_numpy(order), torch.from_numpy(real)
        self._x = torch.from_numpy(points[order].astype(np.float32))
        self._squares = (self._x**2).sum(dim=1)
        placed = self._by_leaf(self._x)
        self._middles = placed.mean(dim=1)
        radii = (placed - self._middles[:, None]).norm(dim=2).amax(dim=1)
        near = torch.cdist(self._middles, self._middles) < DIPOLES.near * (radii[:, None] + radii)
        self._near = near.fill_diagonal_(True)
        members = self._x.shape[0] // leaves
        self._batches = list(_batches(near, lambda count: count * members**2))
        self._epsilon2 = softening**2
        self._far = _kernel(self._far_squares())
        self._by_leaf(self._far).masked_fill_(self._near[:, None, :], 0)
        self._close = [_kernel(self._close_squares(batch)) for batch in self._batches]

    def winding(self, dipoles: Tensor) -> Tensor:
        """``Σ_j ⟨p_j − p_i, μ_j⟩ K_ij`` at every point ``(N,)``, of dipoles ``(N, 3)``."""
        mu = self._placed(dipoles)
        total = self._by_leaf(mu).sum(dim=1)
        sources = torch.cat([(self._x * mu).sum(dim=1, keepdim=True), mu], dim=1)
        far = torch.cat([(self._middles * total).sum(dim=1, keepdim=True), total], dim=1)
        sums = self._summed(sources, far)
        return self._back(sums[:, 0] - (self._x * sums[:, 1:]).sum(dim=1))

    def adjoint(self, values: Tensor) -> Tensor:
        """``Σ_i v_i (p_j − p_i) K_ij`` at every point ``(N, 3)``, of values ``(N,)``: the transposed of `winding`."""
        v = self._placed(values[:, None])
        sources = torch.cat([v, v * self._x], dim=1)
        sums = self._summed(sources, self._by_leaf(sources).sum(dim=1))
        return self._back(self._x * sums[:, :1] - sums[:, 1:])

    def descent(self, dipoles: Tensor) -> Tensor:
        """``−∇`` of the winding number at every point ``(N, 3)``: out of the body that the dipoles ``(N, 3)`` bound.

        ``Σ_j K_ij μ_j − 3 K_ij ⟨d, μ_j⟩ d / (|d|² + ε²)`` with ``d = p_j − p_i``.
        """
        mu = self._placed(dipoles)
        total = self._by_leaf(mu).sum(dim=1)
        flux = torch.addmm((self._middles * total).sum(dim=1), self._x, total.t(), alpha=-1)
        flux.mul_(self._far).div_(self._far_squares())
        ones = torch.ones(len(self._x), 1)
        moment = flux @ torch.cat([self._middles, ones[: self._leaves]], dim=1)
        result = (self._far @ total).sub_(moment[:, :3] - self._x * moment[:, 3:], alpha=3)
        leaves = self._by_leaf(result)
        points, sources = torch.cat([self._x, ones], dim=1), torch.cat([(self._x * mu).sum(1, keepdim=True), mu], dim=1)
        for batch, kernel in zip(self._batches, self._close, strict=True):
            x, near = self._by_leaf(self._x)[batch.leaves], self._gathered(batch, sources)
            flux = torch.baddbmm(near[:, None, :, 0], x, near[:, :, 1:].transpose(1, 2), alpha=-1)
            flux.mul_(kernel).div_(self._close_squares(batch))
            moment = torch.bmm(flux, self._gathered(batch, points))
            leaves[batch.leaves] += torch.bmm(kernel, near[:, :, 1:])
            leaves[batch.leaves] -= 3 * (moment[:, :, :3] - x * moment[:, :, 3:])
        return self._back(result)

    def leaf_means(self, values: Tensor) -> Tensor:
        """Means ``(leaves,)`` of values ``(N,)`` over the points of each leaf."""
        real = self._by_leaf(self._real[:, None].float()).sum(dim=1)[:, 0]
        return self._by_leaf(self._placed(values[:, None])).sum(dim=1)[:, 0] / real.clamp(min=1)

    def _summed(self, sources: Tensor, far: Tensor) -> Tensor:
        """``Σ_j K_ij s_j`` of placed sources ``(padded, c)``, and their sums ``(leaves, c)`` for those far away."""
        sums = self._far @ far
        leaves = self._by_leaf(sums)
        for batch, kernel in zip(self._batches, self._close, strict=True):
            leaves[batch.leaves] += torch.bmm(kernel, self._gathered(batch, sources))
        return sums

    def _far_squares(self) -> Tensor:
        offsets = (self._middles**2).sum(dim=1) + self._epsilon2
        return torch.addmm(offsets, self._x, self._middles.t(), alpha=-2).add_(self._squares[:, None])

    def _close_squares(self, batch: _Batch) -> Tensor:
        """``|p_j − p_i|² + ε²`` ``(b, leaf, c · leaf)``; rounding must leave it above zero for sources that fill up."""
        x, near = self._by_leaf(self._x)[batch.leaves], self._by_leaf(self._x)[batch.near].flatten(1, 2)
        offsets = (near**2).sum(dim=2)[:, None] + self._epsilon2
        squares = torch.baddbmm(offsets, x, near.transpose(1, 2), alpha=-2).add_((x**2).sum(dim=2)[:, :, None])
        return squares.clamp_(min=self._epsilon2)

    def _gathered(self, batch: _Batch, sources: Tensor) -> Tensor:
        return (self._by_leaf(sources)[batch.near] * batch.there).flatten(1, 2)

    def _by_leaf(self, rows: Tensor) -> Tensor:
        return rows.view(self._leaves, -1, rows.shape[-1])

    def _placed(self, rows: Tensor) -> Tensor:
        return torch.where(self._real[:, None], rows[self._order], 0)

    def _back(self, rows: Tensor) -> Tensor:
        result = torch.empty(self._count, *rows.shape[1:])
        result[self._order[self._real]] = rows[self._real]
        return result


class DipoleField:
    """The winding number of dipoles at any places: about 1 inside the surface of their points, and 0 outside.

    Dipoles ``(N, 3)``, outward normals times areas, at points ``(N, 3)`` within the unit sphere, with softenings ε > 0
    ``(N,)``. Near dipoles are summed one by one, so that the sides of a bar thinner than the leaves do not cancel.
    """

    def __init__(
        self, points: NDArray[np.floating], dipoles: NDArray[np.floating], softening: NDArray[np.floating]
    ) -> None:
        order, real, leaves = _leaves(points.astype(np.float64), max(DIPOLES.leaf, len(points) / DIPOLES.most_leaves))

        def by_leaf(rows: NDArray[np.floating]) -> Tensor:
            return torch.from_numpy(rows.astype(np.float32)).view(leaves, -1, rows.shape[1])

        self._x, self._mu = by_leaf(points[order]), by_leaf(np.where(real[:, None], dipoles[order], 0))
        self._epsilon2 = by_leaf(softening[order, None] ** 2)
        weight = self._mu.norm(dim=2, keepdim=True)  # the middle of a leaf's area, as in Barill et al. 2018
        self._middles = (self._x * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-30)
        self._radii = (self._x - self._middles[:, None]).norm(dim=2).amax(dim=1)
        self._total = self._mu.sum(dim=1)

    def winding(self, x: NDArray[np.floating]) -> Float64:
        """``Σ_j ⟨p_j − x, μ_j⟩ / 4π (|p_j − x|² + ε_j²)^(3/2)`` ``(M,)`` at places ``(M, 3)``."""
        if len(x) == 0:
            return np.empty(0)
        order, real, groups = _leaves(x.astype(np.float64))
        places = torch.from_numpy(x[order].astype(np.float32)).view(groups, -1, 3)
        middles = places.mean(dim=1)
        radii = (places - middles[:, None]).norm(dim=2).amax(dim=1)
        near = torch.cdist(middles, self._middles) < DIPOLES.near * (radii[:, None] + self._radii)
        sums = torch.empty(places.shape[:2])
        (size, leaves), members = (places.shape[1], len(self._middles)), self._x.shape[1]
        for batch in _batches(near, lambda count: size * max(leaves, count * members)):
            # About the middle of a group: of the squares of small offsets float32 keeps more digits.
            middle = middles[batch.leaves, None]
            offset = places[batch.leaves] - middle
            apart = (~near[batch.leaves, :, None]).float()
            total = _sums_of(offset, self._middles - middle, self._total * apart, torch.zeros(()))
            x_near, mu_near = (self._x[batch.near] - middle[:, None]).flatten(1, 2), self._mu[batch.near] * batch.there
            total += _sums_of(offset, x_near, mu_near.flatten(1, 2), self._epsilon2[batch.near].flatten(1, 3)[:, None])
            sums[batch.leaves] = total
        result = torch.empty(len(x))
        result[torch.from_numpy(order[real])] = sums.view(-1)[torch.from_numpy(real)]
        return result.double().numpy() / (4 * math.pi)


def _sums_of(places: Tensor, points: Tensor, dipoles: Tensor, epsilon2: Tensor) -> Tensor:
    """``Σ_j ⟨p_j − x, μ_j⟩ (|p_j − x|² + ε_j²)^(−3/2)`` ``(b, s)``: places ``(b, s, 3)``, dipoles ``(b, c, 3)``."""
    flux = torch.baddbmm((points * dipoles).sum(dim=2)[:, None], places, dipoles.transpose(1, 2), alpha=-1)
    squares = torch.baddbmm((points**2).sum(dim=2)[:, None] + epsilon2, places, points.transpose(1, 2), alpha=-2)
    inverse = squares.add_((places**2).sum(dim=2, keepdim=True)).clamp_(min=1e-12).rsqrt_()
    return flux.mul_(inverse).mul_(inverse).mul_(inverse).sum(dim=2)


def _batches(near: Tensor, pairs: Callable[[int], int]) -> Iterator[_Batch]:
    """Batches of rows of ``(n, leaves)`` with about as many near leaves; ``pairs`` of a count are those of a row."""
    counts, order = near.sum(dim=1).sort()
    start = 0
    while start < len(near):
        few = int(counts[start])
        alike = int((counts <= 1.15 * few + 1).sum()) - start
        end = start + max(1, min(alike, DIPOLES.batch // pairs(few)))
        rows = order[start:end]
        there, found = torch.topk(near[rows].to(torch.int8), int(counts[end - 1]), dim=1)
        yield _Batch(rows, found, (there > 0)[:, :, None, None].float())
        start = end


def _kernel(squares: Tensor) -> Tensor:
    """``s^(−3/2) / 4π``."""
    return squares.sqrt().mul_(squares).reciprocal_().mul_(1 / (4 * math.pi))


def _leaves(points: Float64, size: float = DIPOLES.leaf) -> tuple[Int64, NDArray[np.bool_], int]:
    """The order ``(padded,)`` of points in the leaves of a balanced k-d tree, a mask ``(padded,)``, number of leaves.

    Leaves have one size, from half of ``size`` to ``size``. Some points come twice; the mask is false then.
    """
    count = len(points)
    levels = max(0, math.ceil(math.log2(count / size)))
    members = -(-count // 2**levels)
    again = np.linspace(0, count - 1, members * 2**levels - count).astype(np.int64)
    index = np.concatenate((np.arange(count), again))
    place = np.arange(len(index))
    for level in range(levels):
        place = place.reshape(2**level, -1)
        inside = points[index[place]]
        widest = np.ptp(inside, axis=1).argmax(axis=1)
        along = np.take_along_axis(inside, widest[:, None, None], axis=2)[:, :, 0]
        place = np.take_along_axis(place, np.argsort(along, axis=1, kind="stable"), axis=1)
    place = place.ravel()
    return index[place], place < count, 2**levels
