"""Noise along the normals: how much of it there is, and points moved back to where their neighbours agree.

Two points of any arc of a circle, with its normals n_i and n_j, satisfy (n_i + n_j)·(p_j − p_i) = 0, whatever the
curvature; so does the plane. What a cloud leaves of that product is noise, and what neighbours leave of it on average
is how far a point is off the surface: nothing has to be fitted to them, and curvature, to third order, moves nothing.
The two sides of a thin part have opposite normals, and do not see each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

__all__ = ["noise_deviation", "noise_level", "smooth_along_normals", "thick_of_estimated"]

Float64 = NDArray[np.float64]
Rows = NDArray[np.integer]

ASKED = 2000  # points that the noise is measured at
BLOCK = 1 << 13  # points moved at once, to bound memory
VOTERS = 256  # neighbours that are asked, at most
ALIKE = 0.7  # smallest cosine between normals of one surface
# Heights of the eight nearest over their distance: 1/√5 = 0.45 where noise is far wider than the spacing. Below the
# first it is narrower than a fourth of that, and levels average over it themselves; above the second there is no shape
# left that it could be. Between them may be edges, the other side of a blade, or normals estimated there.
THICK, THICKEST = 0.2, 0.35
# The same where normals were estimated from the points: of half that noise they are wrong by five degrees and more, and
# a network that is told of them does not average over that. Of so many points and more it sees several at once, and
# smoothing them takes minutes.
THICK_OF_ESTIMATED, DENSE = 0.1, 100_000
# Those are the higher the further away, while noise is as high nearby: heights of the last four of sixteen neighbours
# over those of the first four, medians, on a plane with noise of any direction, by that ratio. Six shapes with noise of
# 0.1 to 1 % and estimated normals have 0.9 to 1.14 times as much; the same without noise 1.35 times and more.
RATIOS, GROWTHS = (0.08, 0.155, 0.224, 0.28, 0.352), (1.02, 1.06, 1.12, 1.22, 1.48)
GROWN = 1.2
# The same of a neighbourhood so much wider than the noise that it holds nearly all of the layer; yet wider ones hold
# other parts of a fine structure.
THIN = 0.35
# The same of neighbourhoods, five standard deviations in radius and more, whose middle may be at the layer's rim.
WHOLE = 0.25
# Of the area that a neighbourhood shows at the height of its middle: less counts as this much.
LEAST_SEEN = 0.1
# Half the thickness of the layer that a point looks through, in units of `noise_level`; after a round less is left. A
# point at its rim must see past the middle: of a layer of three standard deviations one at two would be moved by half.
LAYER, LAYER_LEFT = 4.0, 3.0


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
    return THICK_OF_ESTIMATED if count < DENSE else THICK


def noise_level(
    points: Float64, normals: Float64, *, seed: int = 0, fitted: bool = False, thick: float = THICK
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


def noise_deviation(points: Float64, normals: Float64, *, seed: int = 0, thick: float = THICK) -> float:
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
    level, near = _measured(points, normals, seed, thin=WHOLE, thick=thick)
    return _deviation(near) if level and near is not None else 0.0


def _measured(
    points: Float64,
    normals: Float64,
    seed: int,
    *,
    thin: float = THIN,
    fitted: bool = False,
    thick: float = THICK,
) -> tuple[float, _Neighbors | None]:
    """The layer's thickness, in neighbourhoods ``1/thin`` times as wide, and those; 0 and None if it is no layer."""
    order = np.random.default_rng(seed).permutation(len(points))
    layer = _Layer(points, normals, order)
    ratio = _thickness(layer.around(order[:ASKED], 8))[0]
    if not ratio > thick:
        return 0.0, None
    grown = GROWN * np.interp(ratio, RATIOS, GROWTHS)
    if ratio < THICKEST and not fitted and _growth(layer.around(order[:ASKED], 16)) > grown:
        return 0.0, None
    level, near = 0.0, None
    while len(order) > 32:  # fewer and fewer points show wider and wider neighbourhoods, at the same cost
        near = layer.around(order[:ASKED], 16)
        ratio, height = _thickness(near)
        level = height / 2**0.5  # of a difference of two
        if ratio < thin:
            break
        order = order[: len(order) // 2]
        layer = _Layer(points, normals, order)
    return level, near


def smooth_along_normals(
    points: Float64, normals: Float64, level: float, *, rounds: int = 2, alike: float = ALIKE, seed: int = 0
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
        seed: of the neighbours that are asked, where more than `VOTERS` are within reach.

    Returns:
        The points, moved, ``(N, 3)``.
    """
    moved = points.copy()
    order = np.random.default_rng(seed).permutation(len(points))
    spacing = _spacing(points, normals, order)
    reach = max(3 * level, 4 * spacing)
    # In a dense cloud the nearest points would all lie at a point's own height: of that, fewer are asked.
    share = VOTERS / (np.pi * (reach / spacing) ** 2)
    voters = order[: max(VOTERS, int(share * len(points)))]
    for layer in (LAYER * level, *(rounds - 1) * (LAYER_LEFT * level,)):
        offset, others = np.empty(len(points)), _Layer(moved, normals, voters)
        for rows in np.array_split(np.arange(len(points)), -(-len(points) // BLOCK)):
            near = others.around(rows, VOTERS, within=float(np.hypot(reach, layer)))
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
    seen = np.maximum(1 - (height / radius[some]) ** 2, LEAST_SEEN)
    weight = alike[some] / seen
    total = weight.sum(axis=1, keepdims=True)
    mean = (weight * height).sum(axis=1, keepdims=True) / total
    freedom = count[some] - 1
    variance = (weight * (height - mean) ** 2).sum(axis=1) / total[:, 0] * count[some] / freedom
    return float(np.sqrt(np.median(variance / (1 - 2 / (9 * freedom)) ** 3)))


def _spacing(points: Float64, normals: Float64, order: Rows) -> float:
    """The side of the square that a point has to itself, of the points seen along the normals."""
    near = _Layer(points, normals, order).around(order[:ASKED], 16)
    return float(np.median(np.nanmax(near.distance, axis=1))) * np.sqrt(np.pi / near.distance.shape[1])
