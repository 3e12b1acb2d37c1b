"""Noise along the normals: measured and smoothed off; normals fitted again to planes, and those of a file checked.

Heights h_ij = ½(n_i + n_j)·(p_j − p_i) are 0 on planes and on any arc of a circle; their mean moves noisy points back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..point_cloud import Float64, Int64, centred, unit_rows
from .orientation import blocks, query


@dataclass(frozen=True)
class NoiseOptions:
    """Noise along normals; values from clouds with 0.1 to 1 % noise. Thickness is the height over the distance."""

    sample: int = 2000  # points at which the noise is measured
    block: int = 1 << 13  # points handled at once, to bound memory
    neighbors: int = 256  # most neighbours that move a point
    alike: float = 0.7  # smallest cosine between normals of one surface
    # Thickness of the eight nearest from which on it is noise, and noise only: 1/√5 = 0.45 far above the spacing.
    thick: float = 0.2
    thickest: float = 0.35
    thick_of_estimated: float = 0.1  # the same of estimated normals, which half as much noise tilts by 5°
    dense: int = 100_000  # points from which on a network averages over that noise itself
    # Height of the last four over the first four of sixteen neighbours, expected of noise by thickness.
    ratios: tuple[float, float, float, float, float] = (0.08, 0.155, 0.224, 0.28, 0.352)
    growths: tuple[float, float, float, float, float] = (1.02, 1.06, 1.12, 1.22, 1.48)
    grown: float = 1.2  # times the expected growth, above which it is shape
    thin: float = 0.35  # thickness of neighbourhoods that hold nearly all of the layer
    whole: float = 0.25  # the same for `noise_deviation`
    least_visible: float = 0.1  # smallest fraction of a ball's disc at a height, for the weights of heights
    # Largest height that moves a point, in noise levels: first round, later rounds.
    layer: float = 4.0
    layer_left: float = 3.0
    rounds: int = 2  # of smoothing


@dataclass(frozen=True)
class RefitOptions:
    """Normals fitted again. Cosines are between normals; distances in noise levels."""

    neighbors: int = 64
    few: int = 16  # neighbours of a plane where there is no noise
    alike: float = 0.3  # smallest cosine that counts
    rounds: int = 2
    reach: float = 9.0  # of a plane; noise tilts smaller ones by more than curvature does
    # Smallest cosines where there are edges: for the first planes, for smoothing, for later planes.
    alike_at_first: float = 0.6
    alike_moved: float = 0.9
    alike_after: float = 0.8
    edge_rounds: int = 3
    turn: float = 0.2  # radians: width of the filter over angles between normals
    filtered: int = 32  # neighbours of the filter
    passes: int = 3  # of the filter
    edged: float = 4.0  # 90 % quantile over median of angles to neighbours: 2.3 on smooth shapes, 5 with edges
    sample: int = 3000  # points at which angles and heights are measured
    sharper: float = 0.8  # largest ratio of heights after and before: 0.4 to 0.8 without noise, 0.9 with


@dataclass(frozen=True)
class JudgingOptions:
    """How the normals of a file are compared with those of planes through neighbours."""

    sample: int = 1000  # points that are compared first
    fewest: int = 64  # points of a cloud that has two halves with neighbourhoods
    near: tuple[int, int] = (1, 9)  # range of the neighbours that heights are taken over
    far: tuple[int, int] = (16, 33)  # the same with noise: closer neighbours share the noise of the plane
    alike: float = 0.5  # smallest cosine between normals of one surface
    ratio: float = 1.5  # of squared heights, from which on a normal is worse
    tilt: float = 0.05  # radians: smallest error of a worse normal
    share: float = 0.08  # least fraction of worse normals
    against: float = 1.5  # the same in fractions of better normals


NOISE = NoiseOptions()
REFIT = RefitOptions()
JUDGING = JudgingOptions()


class _Neighbors(NamedTuple):
    """Neighbours of some points: distances, cosines between normals, heights h_ij; ``(m, k)``, NaN where missing."""

    distance: Float64
    cosine: Float64
    height: Float64


def noise_level(points: Float64, normals: Float64, *, fitted: bool = False, thick: float = NOISE.thick) -> float:
    """The thickness of the layer of points ``(N, 3)`` along the normals, or 0 where the spacing is wider than that.

    It is the unit of lengths of smoothing, and less than the standard deviation (`noise_deviation`). Of normals that
    were ``fitted`` to these very neighbours, heights grow with the distance even without shape, which is ignored.
    """
    return _measured(points, normals, fitted=fitted, thick=thick)[0]


def noise_deviation(points: Float64, normals: Float64, *, thick: float = NOISE.thick) -> float:
    """The standard deviation of the noise along the normals, or 0 where the spacing is wider than that.

    In a ball of radius R, points at the height h are visible within ``R² − h²``: each counts with the inverse of this
    area (Horvitz and Thompson 1952). The median over neighbourhoods is that of a χ² distribution with k − 1 degrees of
    freedom, whose ratio to the mean is ``(1 − 2/(9 (k − 1)))³`` (Wilson and Hilferty 1931).
    """
    level, near = _measured(points, normals, thin=NOISE.whole, thick=thick)
    if not level or near is None:
        return 0.0
    alike = near.cosine > 0.5
    count = alike.sum(axis=1)
    radius = np.nanmax(near.distance, axis=1, keepdims=True)
    some = (count > 3) & (radius[:, 0] > 0)
    if not some.any():
        return 0.0
    height = np.where(alike, near.height, 0.0)[some]
    visible = np.maximum(1 - (height / radius[some]) ** 2, NOISE.least_visible)
    weight = alike[some] / visible
    total = weight.sum(axis=1, keepdims=True)
    mean = (weight * height).sum(axis=1, keepdims=True) / total
    freedom = count[some] - 1
    variance = (weight * (height - mean) ** 2).sum(axis=1) / total[:, 0] * count[some] / freedom
    return float(np.sqrt(np.median(variance / (1 - 2 / (9 * freedom)) ** 3)))


def _measured(
    points: Float64, normals: Float64, *, thin: float = NOISE.thin, fitted: bool = False, thick: float = NOISE.thick
) -> tuple[float, _Neighbors | None]:
    """The layer's thickness, in neighbourhoods ``1/thin`` times as wide, and those; 0 and None if it is no layer."""
    order = np.random.default_rng(0).permutation(len(points))
    layer = _Layer(points, normals, order)
    ratio = _thickness(layer.around(order[: NOISE.sample], 8))[0]
    if not ratio > thick:
        return 0.0, None
    grown = NOISE.grown * np.interp(ratio, NOISE.ratios, NOISE.growths)
    if ratio < NOISE.thickest and not fitted and _growth(layer.around(order[: NOISE.sample], 16)) > grown:
        return 0.0, None
    level, near = 0.0, None
    while len(order) > 32:  # with half as many points, neighbourhoods of 16 are wider at the same cost
        near = layer.around(order[: NOISE.sample], 16)
        ratio, height = _thickness(near)
        level = height / 2**0.5  # of a difference of two
        if ratio < thin:
            break
        order = order[: len(order) // 2]
        layer = _Layer(points, normals, order)
    return level, near


def smooth_along_normals(points: Float64, normals: Float64, level: float, *, alike: float = NOISE.alike) -> Float64:
    """Points ``(N, 3)`` moved along their normals by the weighted mean of h_ij over themselves and their neighbours.

    Weights fall to zero at three noise levels beside the point (or four spacings, if they are wider), and at the
    cosine ``alike`` between normals.
    """
    moved = points.copy()
    order = np.random.default_rng(0).permutation(len(points))
    spread = _Layer(points, normals, order).around(order[: NOISE.sample], 16).distance
    spacing = float(np.median(np.nanmax(spread, axis=1))) * np.sqrt(np.pi / spread.shape[1])
    reach = max(3 * level, 4 * spacing)
    # In a dense cloud the nearest points would all lie at a point's own height: of that, a subset is used.
    share = NOISE.neighbors / (np.pi * (reach / spacing) ** 2)
    subset = order[: max(NOISE.neighbors, int(share * len(points)))]
    for layer in (NOISE.layer * level, *(NOISE.rounds - 1) * (NOISE.layer_left * level,)):
        offset, others = np.empty(len(points)), _Layer(moved, normals, subset)
        for rows in blocks(np.arange(len(points)), NOISE.block):
            near = others.around(rows, NOISE.neighbors, within=float(np.hypot(reach, layer)))
            beside = (near.distance**2 - near.height**2) / reach**2
            likeness = (near.cosine - alike) / (1 - alike)
            counts = (beside < 1) & (np.abs(near.height) < layer) & (likeness > 0)
            weight = np.where(counts, (1 - beside) ** 2 * likeness, 0)
            offset[rows] = np.where(counts, weight * near.height, 0).sum(axis=1) / (1 + weight.sum(axis=1))
        moved += offset[:, None] * normals
    return moved


class _Layer:
    """A tree of the points ``among`` of a cloud; ``tree`` is that, if there is one already."""

    def __init__(self, points: Float64, normals: Float64, among: Int64, tree: KDTree | None = None) -> None:
        self.points, self.normals, self.among = points, normals, among
        self.tree = tree or KDTree(points[among])

    def around(self, rows: Int64, count: int, *, within: float = np.inf) -> _Neighbors:
        """The ``count`` nearest to the points ``rows``, but not those themselves."""
        distance, found = query(self.tree, self.points[rows], count + 1, within=within)
        there = (found < len(self.among)) & (self.among[np.minimum(found, len(self.among) - 1)] != rows[:, None])
        near = self.among[np.where(there, found, 0)]
        edge, own, theirs = self.points[near] - self.points[rows][:, None], self.normals[rows], self.normals[near]
        height = 0.5 * (np.einsum("mkd,md->mk", edge, own) + np.einsum("mkd,mkd->mk", edge, theirs))
        cosine = np.einsum("mkd,md->mk", theirs, own)
        return _Neighbors(*(np.where(there, values, np.nan) for values in (distance, cosine, height)))


def _thickness(near: _Neighbors) -> tuple[float, float]:
    """Medians of the root mean square height of neighbours with like normals: over the radius, and by itself."""
    alike = near.cosine > 0.5
    count = alike.sum(axis=1)
    height = np.sqrt(np.where(alike, near.height**2, 0).sum(axis=1) / np.maximum(count, 1))
    radius = np.nanmax(near.distance, axis=1)
    some = (count > 1) & (radius > 0)
    if not some.any():
        return 0.0, 0.0
    return float(np.median(height[some] / radius[some])), float(np.median(height[some]))


def _growth(near: _Neighbors) -> float:
    """Heights of the last four of sixteen neighbours over those of the first, where normals are alike; 0 of none."""
    height = np.where(near.cosine > 0.5, np.abs(near.height), np.nan)
    first, last = height[:, :4], height[:, 12:]
    if np.isnan(first).all() or np.isnan(last).all():
        return 0.0
    return float(np.nanmedian(last)) / max(float(np.nanmedian(first)), 1e-300)


def smoothed_level(points: Float64, normals: Float64) -> float:
    """`noise_level` with estimated normals, from which on `denoise` smooths."""
    return noise_level(points, normals, thick=NOISE.thick_of_estimated if len(points) < NOISE.dense else NOISE.thick)


def denoise(points: Float64, normals: Float64) -> tuple[Float64, Float64, float]:
    """Smoothed points ``(N, 3)``, normals ``(N, 3)`` fitted to them, and the noise level, of normals mostly outward.

    Planes and smoothing alternate. Weights by likeness of normals are bilateral (Jones et al., SIGGRAPH 2003); a cloud
    with edges gets further rounds with filtered normals. Without noise: the points, `sharper_normals`, and 0.
    """
    level = smoothed_level(points, normals)
    if not level:
        return points, sharper_normals(points, normals), 0.0
    reach = REFIT.reach * level
    for _ in range(REFIT.rounds):
        normals = refit_normals(smooth_along_normals(points, normals, level), normals, reach)
        level = smoothed_level(points, normals) or level
    moved = smooth_along_normals(points, normals, level)
    tree = KDTree(moved)
    fitted = refit_normals(moved, normals, reach, tree=tree)
    if not has_edges(moved, fitted, tree=tree):
        return moved, fitted, level
    fitted = refit_normals(moved, fitted, reach, alike=REFIT.alike_at_first, tree=tree)
    for _ in range(REFIT.edge_rounds):
        normals = filter_normals(moved, fitted, tree=tree)
        level = smoothed_level(points, normals) or level
        moved = smooth_along_normals(points, normals, level, alike=REFIT.alike_moved)
        tree = KDTree(moved)
        fitted = refit_normals(moved, normals, reach, alike=REFIT.alike_after, tree=tree)
    return moved, filter_normals(moved, fitted, tree=tree), level


def sharper_normals(points: Float64, normals: Float64) -> Float64:
    """Normals ``(N, 3)`` fitted to few like neighbours of points without noise, if heights are then less by a fifth."""
    tree, fitted = KDTree(points), normals
    for _ in range(REFIT.rounds):
        fitted = refit_normals(points, fitted, 0.0, neighbors=REFIT.few, tree=tree)
    before, after = (_disagreement(points, each, tree) for each in (normals, fitted))
    return fitted if after < REFIT.sharper * before else normals


def _disagreement(points: Float64, normals: Float64, tree: KDTree) -> float:
    """The mean of |h_ij| / |p_j − p_i| over the eight nearest neighbours of a sample."""
    some = np.random.default_rng(0).permutation(len(points))[: REFIT.sample]
    near = _Layer(points, normals, np.arange(len(points)), tree).around(some, 8)
    return float(np.nanmean(np.abs(near.height) / np.maximum(near.distance, 1e-300)))


def has_edges(points: Float64, normals: Float64, *, tree: KDTree | None = None) -> bool:
    """Whether normals turn by much at few places, as at the edges between faces, and not everywhere by some."""
    some = np.random.default_rng(0).permutation(len(points))[: REFIT.sample]
    cosine = _Layer(points, normals, np.arange(len(points)), tree).around(some, 8).cosine
    angle = np.nanmean(np.arccos(cosine.clip(-1, 1)), axis=1)
    usual, large = np.quantile(angle, (0.5, 0.9))
    return bool(large > REFIT.edged * usual)


def filter_normals(points: Float64, normals: Float64, *, tree: KDTree | None = None) -> Float64:
    """Unit means ``(N, 3)`` of normals with weights ``(1 − d²/r²)² exp(−(1 − c)/turn²)``.

    d is the distance, r that of the last of `filtered` neighbours, c the cosine between the normals (Zheng et al.,
    "Bilateral normal filtering for mesh denoising", TVCG 2011).
    """
    distance, near = query(tree or KDTree(points), points, REFIT.filtered)
    beside = (1 - (distance / (distance[:, -1:] * 1.001)) ** 2) ** 2
    for _ in range(REFIT.passes):
        mean = np.empty_like(normals)
        for part in blocks(np.arange(len(points)), NOISE.block):
            theirs = normals[near[part]]
            cosine = np.einsum("md,mkd->mk", normals[part], theirs)
            mean[part] = np.einsum("mk,mkd->md", beside[part] * np.exp((cosine - 1) / REFIT.turn**2), theirs)
        normals = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    return normals


def refit_normals(
    points: Float64,
    normals: Float64,
    reach: float,
    *,
    neighbors: int = REFIT.neighbors,
    alike: float = REFIT.alike,
    rows: Int64 | None = None,
    among: Int64 | None = None,
    tree: KDTree | None = None,
) -> Float64:
    """Normals ``(m, 3)`` of planes at ``rows`` through the points ``among``, both all by default; signs stay.

    Weights are ``(1 − d²/r²)² max(0, (c − alike)/(1 − alike))²``, with the distance d, the cosine c between normals, r
    the distance to the last of ``neighbors``, or ``reach`` if at least 16 are within.
    """
    places = np.arange(len(points)) if rows is None else rows
    others = np.arange(len(points)) if among is None else among
    count = min(neighbors, len(others))
    tree, fitted = tree or KDTree(points[others]), np.empty((len(places), 3))
    for part in blocks(np.arange(len(places)), NOISE.block):
        here = places[part]
        distance, found = query(tree, points[here], count)
        near = others[found]
        radius = np.clip(reach, distance[:, min(16, count - 1)], distance[:, -1] * 1.001)[:, None]
        cosine = np.einsum("md,mkd->mk", normals[here], normals[near])
        likeness = ((cosine - alike) / (1 - alike)).clip(min=0)
        weight = (1 - (distance / radius) ** 2).clip(min=0) ** 2 * likeness**2
        offset = points[near] - points[here][:, None]
        total = weight.sum(axis=1)[:, None]
        offset -= (np.einsum("mk,mkd->md", weight, offset) / np.maximum(total, 1e-300))[:, None]
        weighted = offset * weight[:, :, None]
        normal = np.linalg.eigh(weighted.transpose(0, 2, 1) @ offset)[1][:, :, 0]
        turned = np.einsum("md,md->m", normal, normals[here]) < 0
        normal = np.where(turned[:, None], -normal, normal)
        fitted[part] = np.where(total > 0, normal, normals[here])
    return fitted


def replace_bad_normals(points: Float64, normals: Float64) -> tuple[Float64, int]:
    """Normals of a file, and how many were replaced by planes: those that fit less well, or all if points are noisy."""
    around = centred(points)
    level = layer_level(around, normals)
    worse = worse_normals(around, normals, level)
    if not worse.any():
        return normals, 0
    guides = _neighborly(around, normals)
    if level:
        return denoise(around, guides)[1], len(normals)
    fitted = refit_normals(around, guides, 0.0, neighbors=REFIT.few)
    return np.where(worse[:, None], fitted, normals), int(worse.sum())


def layer_level(points: Float64, normals: Float64) -> float:
    """`noise_level`, or 0 if the noise is that of the normals and not of the points."""
    level = noise_level(points, normals)
    if not level:
        return 0.0
    return min(level, noise_level(points, refit_normals(points, normals, 0.0, neighbors=REFIT.few), fitted=True))


def _neighborly(points: Float64, normals: Float64) -> Float64:
    """Unit means of each normal and those of eight neighbours within a right angle: a single bad one is like none."""
    mean = normals.copy()
    for others in query(KDTree(points), points, 9)[1].T[1:]:
        same = (normals * normals[others]).sum(axis=1, keepdims=True) > 0
        mean += np.where(same, normals[others], 0)
    return unit_rows(mean)


def worse_normals(points: Float64, normals: Float64, level: float) -> NDArray[np.bool_]:
    """Which normals ``(N,)`` of a file fit the points less well than planes do; none if most fit better.

    Planes are fitted to one half of the points and compared in the other one, as they always win in their own. A normal
    n is worse than the plane's f_i if ``Σ_j (½(n + f_j)·(p_j − p_i))²`` is more than `ratio` times that of f_i, and
    exceeds it by that of a `tilt`. ``level`` is that of `layer_level`.
    """
    none = np.zeros(len(points), bool)
    if len(points) < JUDGING.fewest:
        return none
    random = np.random.default_rng(0)
    first = random.permutation(len(points)) < len(points) // 2
    verdict = _verdict(points, normals, level, first, random.permutation(len(points))[: JUDGING.sample])
    share = float((verdict > 0).mean())
    if share < max(JUDGING.share, JUDGING.against * float((verdict < 0).mean())):
        return none
    return _verdict(points, normals, level, first, np.arange(len(points))) > 0


def _verdict(points: Float64, normals: Float64, level: float, first: NDArray[np.bool_], rows: Int64) -> Int64:
    """1 where the given normal of ``rows`` ``(m,)`` is worse than the plane's, −1 where it is better, else 0."""
    low, high = JUDGING.far if level else JUDGING.near
    result = np.zeros(len(rows), np.int64)
    for half in (True, False):
        own, other = np.flatnonzero(first == half), np.flatnonzero(first != half)
        mine = np.flatnonzero(first[rows] == half)
        if not len(mine):
            continue
        near = own[query(KDTree(points[own]), points[rows[mine]], high)[1][:, low:]]
        members, place = np.unique(np.concatenate((rows[mine], near.ravel())), return_inverse=True)
        count = REFIT.neighbors if level else REFIT.few
        fitted = refit_normals(points, normals, REFIT.reach * level, neighbors=count, rows=members, among=other)
        one, others = place[: len(mine)], place[len(mine) :].reshape(near.shape)
        for part in blocks(np.arange(len(mine)), NOISE.block):
            at = rows[mine[part]]
            edge = points[near[part]] - points[at][:, None]
            result[mine[part]] = _compared(edge, normals[at], fitted[one[part]], fitted[others[part]])
    return result


def _compared(edge: Float64, given: Float64, plane: Float64, theirs: Float64) -> Int64:
    """See `_verdict`; of edges and planes ``theirs`` ``(m, k, 3)``, and two normals ``(m, 3)``."""
    alike = np.einsum("mkd,md->mk", theirs, plane) > JUDGING.alike
    along = np.einsum("mkd,mkd->mk", edge, theirs)

    def squares(normal: Float64) -> Float64:
        return np.where(alike, (0.5 * (np.einsum("mkd,md->mk", edge, normal) + along)) ** 2, 0).sum(axis=1)

    # A tilt δ changes a height by ½ δ times the edge along it, whose square is half of the edge's on average.
    tilted = 0.125 * JUDGING.tilt**2 * np.where(alike, (edge**2).sum(axis=2), 0).sum(axis=1)
    of_given, of_plane = squares(given), squares(plane)
    worse = of_given > np.maximum(JUDGING.ratio * of_plane, of_plane + tilted)
    better = of_plane > np.maximum(JUDGING.ratio * of_given, of_given + tilted)
    return (worse.astype(np.int64) - better) * (alike.sum(axis=1) >= 4)
