"""Noise along the normals: how much of it there is, and points moved back to where their neighbours agree.

Two points of any arc of a circle, with its normals n_i and n_j, satisfy (n_i + n_j)·(p_j − p_i) = 0, whatever the
curvature; so does the plane. What a cloud leaves of that product is noise, and what neighbours leave of it on average
is how far a point is off the surface: nothing has to be fitted to them, and curvature, to third order, moves nothing.
The two sides of a thin part have opposite normals, and do not see each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

__all__ = ["noise_deviation", "noise_level", "smooth_along_normals", "thick_of_estimated"]

Float64 = NDArray[np.float64]
Rows = NDArray[np.integer]


@dataclass(frozen=True)
class NoiseOptions:
    """Noise along normals. Heights are over the tangent plane; values from clouds with 0.1 to 1 % noise."""

    asked: int = 2000  # points that the noise is measured at
    block: int = 1 << 13  # points moved at once, to bound memory
    voters: int = 256  # most neighbours of a point that is moved
    alike: float = 0.7  # smallest cosine between normals of one surface
    # Heights over distances of the eight nearest that count as noise: 1/√5 = 0.45 where it is far wider than spacing.
    thick: float = 0.2
    thickest: float = 0.35
    thick_of_estimated: float = 0.1  # the same of estimated normals, which half as much noise tilts by 5°
    dense: int = 100_000  # points from which on a network averages over that noise itself
    # Noise is as high nearby as further away: last four over first four heights of sixteen neighbours, by thickness.
    ratios: tuple[float, float, float, float, float] = (0.08, 0.155, 0.224, 0.28, 0.352)
    growths: tuple[float, float, float, float, float] = (1.02, 1.06, 1.12, 1.22, 1.48)
    grown: float = 1.2  # times the expected growth, above which it is shape
    # Heights over radii of wider neighbourhoods, which hold nearly all of the layer: the most, and of the widest.
    thin: float = 0.35
    whole: float = 0.25
    least_seen: float = 0.1  # smallest weight of the area that a neighbourhood shows at a height
    # Half thickness of the layer that a point looks through, in noise levels; and in the rounds after the first.
    layer: float = 4.0
    layer_left: float = 3.0


NOISE = NoiseOptions()


class _Neighbors(NamedTuple):
    """The points nearest to some; each ``(m, k)``, and NaN where there is none.

    Attributes:
        distance: to them.
        cosine: between the normals.
        height: ½(n_i + n_j)·(p_j − p_i).
    """

    distance: Float64
    cosine: Float64
    height: Float64


def thick_of_estimated(count: int) -> float:
    """From which thickness on there is noise in a cloud of ``count`` points with estimated normals: ``thick`` below."""
    return NOISE.thick_of_estimated if count < NOISE.dense else NOISE.thick


def noise_level(
    points: Float64, normals: Float64, *, seed: int = 0, fitted: bool = False, thick: float = NOISE.thick
) -> float:
    """How thick the layer of points is along the normals, or 0 where the spacing is wider than that.

    It is what smoothing measures in, and less than the noise's standard deviation, the more so the wider its
    distribution: that is `noise_deviation`.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals.
        seed: of the points that are asked.
        fitted: whether the normals were fitted to a few of these very neighbours. Those are nearer to their plane than
            the next ones in any case, and what grows with the distance is not taken for shape.
        thick: heights of the eight nearest over their distance, from which on there is noise.
    """
    return _measured(points, normals, seed, fitted=fitted, thick=thick)[0]


def noise_deviation(points: Float64, normals: Float64, *, seed: int = 0, thick: float = NOISE.thick) -> float:
    """The standard deviation of the noise along the normals, or 0 where the spacing is wider than that.

    Whatever direction the noise has: what it does across the normals moves points within the surface, and is not
    seen. Of noise along the rays of a sensor, this is its part along the normals where half of the cloud has more.

    In each of many neighbourhoods the heights ½(n_i + n_j)·(p_j − p_i) have the variance of the noise about their mean,
    which holds the noise of the point in the middle. A ball of radius R around that shows those at a height h only
    within ``R² − h²`` beside it, so that each counts with the inverse of this area (Horvitz and Thompson 1952). The
    median over neighbourhoods is that of a χ² distribution with k − 1 degrees of freedom, whose ratio to the mean is
    ``(1 − 2/(9 (k − 1)))³`` (Wilson and Hilferty 1931).

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals.
        seed: of the points that are asked.
        thick: see `noise_level`.
    """
    level, near = _measured(points, normals, seed, thin=NOISE.whole, thick=thick)
    return _deviation(near) if level and near is not None else 0.0


def _measured(
    points: Float64,
    normals: Float64,
    seed: int,
    *,
    thin: float = NOISE.thin,
    fitted: bool = False,
    thick: float = NOISE.thick,
) -> tuple[float, _Neighbors | None]:
    """The layer's thickness, in neighbourhoods ``1/thin`` times as wide, and those; 0 and None if it is no layer."""
    order = np.random.default_rng(seed).permutation(len(points))
    layer = _Layer(points, normals, order)
    ratio = _thickness(layer.around(order[: NOISE.asked], 8))[0]
    if not ratio > thick:
        return 0.0, None
    grown = NOISE.grown * np.interp(ratio, NOISE.ratios, NOISE.growths)
    if ratio < NOISE.thickest and not fitted and _growth(layer.around(order[: NOISE.asked], 16)) > grown:
        return 0.0, None
    level, near = 0.0, None
    while len(order) > 32:  # fewer and fewer points show wider and wider neighbourhoods, at the same cost
        near = layer.around(order[: NOISE.asked], 16)
        ratio, height = _thickness(near)
        level = height / 2**0.5  # of a difference of two
        if ratio < thin:
            break
        order = order[: len(order) // 2]
        layer = _Layer(points, normals, order)
    return level, near


def smooth_along_normals(
    points: Float64, normals: Float64, level: float, *, rounds: int = 2, alike: float = NOISE.alike, seed: int = 0
) -> Float64:
    """Move points along their normals to where those neighbours agree whose normals are like their own.

    The move is the weighted mean of ½(n_i + n_j)·(p_j − p_i) over the point itself and its neighbours. Weights fall to
    zero at three standard deviations of the noise beside the point (or four spacings, if they are wider), and where
    normals are far from parallel.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals.
        level: the noise's standard deviation, see `noise_level`.
        rounds: how often.
        alike: smallest cosine between normals that count; the better they are, the more it can ask for.
        seed: of the neighbours that are asked, where more than `voters` are within reach.

    Returns:
        The points, moved, ``(N, 3)``.
    """
    moved = points.copy()
    order = np.random.default_rng(seed).permutation(len(points))
    spacing = _spacing(points, normals, order)
    reach = max(3 * level, 4 * spacing)
    # In a dense cloud the nearest points would all lie at a point's own height: of that, fewer are asked.
    share = NOISE.voters / (np.pi * (reach / spacing) ** 2)
    voters = order[: max(NOISE.voters, int(share * len(points)))]
    for layer in (NOISE.layer * level, *(rounds - 1) * (NOISE.layer_left * level,)):
        offset, others = np.empty(len(points)), _Layer(moved, normals, voters)
        for rows in np.array_split(np.arange(len(points)), -(-len(points) // NOISE.block)):
            near = others.around(rows, NOISE.voters, within=float(np.hypot(reach, layer)))
            beside = (near.distance**2 - near.height**2) / reach**2
            likeness = (near.cosine - alike) / (1 - alike)
            seen = (beside < 1) & (np.abs(near.height) < layer) & (likeness > 0)
            weight = np.where(seen, (1 - beside) ** 2 * likeness, 0)
            offset[rows] = np.where(seen, weight * near.height, 0).sum(axis=1) / (1 + weight.sum(axis=1))
        moved += offset[:, None] * normals
    return moved


class _Layer:
    """The points ``among`` of a cloud, as its points see them."""

    def __init__(self, points: Float64, normals: Float64, among: Rows) -> None:
        self.points, self.normals, self.among = points, normals, among
        self.tree = KDTree(points[among])

    def around(self, rows: Rows, count: int, *, within: float = np.inf) -> _Neighbors:
        """The ``count`` nearest to the points ``rows``, but not those themselves."""
        count = min(count, len(self.among) - 1)
        distance, found = self.tree.query(self.points[rows], k=count + 1, distance_upper_bound=within, workers=-1)
        there = (found < len(self.among)) & (self.among[np.minimum(found, len(self.among) - 1)] != rows[:, None])
        near = self.among[np.where(there, found, 0)]
        edge, own, theirs = self.points[near] - self.points[rows][:, None], self.normals[rows], self.normals[near]
        height = 0.5 * (np.einsum("mkd,md->mk", edge, own) + np.einsum("mkd,mkd->mk", edge, theirs))
        cosine = np.einsum("mkd,md->mk", theirs, own)
        return _Neighbors(*(np.where(there, values, np.nan) for values in (distance, cosine, height)))


def _thickness(near: _Neighbors) -> tuple[float, float]:
    """Root mean square of the heights of neighbours with like normals: the median over the radius, and the median."""
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


def _deviation(near: _Neighbors) -> float:
    """See `noise_deviation`."""
    alike = near.cosine > 0.5
    count = alike.sum(axis=1)
    radius = np.nanmax(near.distance, axis=1, keepdims=True)
    some = (count > 3) & (radius[:, 0] > 0)
    if not some.any():
        return 0.0
    height = np.where(alike, near.height, 0.0)[some]
    seen = np.maximum(1 - (height / radius[some]) ** 2, NOISE.least_seen)
    weight = alike[some] / seen
    total = weight.sum(axis=1, keepdims=True)
    mean = (weight * height).sum(axis=1, keepdims=True) / total
    freedom = count[some] - 1
    variance = (weight * (height - mean) ** 2).sum(axis=1) / total[:, 0] * count[some] / freedom
    return float(np.sqrt(np.median(variance / (1 - 2 / (9 * freedom)) ** 3)))


def _spacing(points: Float64, normals: Float64, order: Rows) -> float:
    """The side of the square that a point has to itself, of the points seen along the normals."""
    near = _Layer(points, normals, order).around(order[: NOISE.asked], 16)
    return float(np.median(np.nanmax(near.distance, axis=1))) * np.sqrt(np.pi / near.distance.shape[1])
