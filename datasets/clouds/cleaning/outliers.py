"""Outliers and flipped normals of a cloud, found from each point's neighbours before anything is fitted.

The distance to the eighth neighbour is compared as in Breunig et al., "LOF" (SIGMOD 2000).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ....neural_fields.backend.arrays import Mask
from ..point_cloud import Float64, Int64, centred
from .orientation import blocks, fit_planes, query


@dataclass(frozen=True)
class OutlierOptions:
    """Which points belong to no surface."""

    neighbors: int = 12
    reach: int = 8  # the neighbour whose distance, the reach, measures how sparse a place is
    block: int = 1 << 16  # points handled at once, to bound memory
    rounds: int = 4  # most rounds, as dropped points may have been each other's neighbours
    sparser: float = 2.5  # reach over that of the neighbours; 1 in 1,000 of clean points
    sparse: float = 4.0  # reach over the usual one; 1 in 30,000
    uneven: float = 1.6  # 85 % quantile of the reach over the median, above which it decides what is usual
    elevation: float = 0.6  # sine of the edge over a supporting neighbour's plane; 0.58 at the corners of a cube
    mirrored: float = 0.5  # cosine of the mirrored normals of a supporting neighbour
    lonely: float = 4.0  # times sparser, from which on the next two hold
    lonely_elevation: float = 0.3
    lonely_mirrored: float = 0.9
    flat: float = 0.25  # deviation from a plane, in reaches, up to which planes are used
    company: float = 0.16  # least fraction of peers that support a point
    beside: float = 2.0  # largest distance of those peers, in reaches
    majority: float = 0.5  # least fraction of neighbours that support a sparse point


OUTLIERS = OutlierOptions()


class Verdict(NamedTuple):
    """Masks ``(N,)``: points far from all others, other outliers, kept points whose normal is to be reversed."""

    isolated: Mask
    outliers: Mask
    flipped: Mask


def inspect_points(
    points: Float64,
    normals: Float64 | None,
    *,
    isolation: float | None = None,
    outliers: bool = True,
    flips: bool = True,
) -> Verdict:
    """Find isolated points, outliers and flipped normals of ``(N, 3)`` finite points.

    Isolated: the eighth neighbour is ``isolation`` times further away than the median point's, and too few neighbours
    that are as sparse support the point. Outliers: sparse points with little support, points off the plane or across
    the normals that their neighbours agree on, and small clusters without mutual support. Flipped: nearly all
    neighbours in the point's plane have the opposite normal, and are supported themselves. Without ``normals``, planes
    through the neighbourhoods replace them, and nothing is flipped.
    """
    count = len(points)
    isolated, stray, flipped = np.zeros((3, count), bool)
    if count < 4 or not (isolation is not None or outliers or flips):
        return Verdict(isolated, stray, flipped)
    cloud = _Cloud(points, normals)
    if isolation is not None:
        isolated = _isolated(cloud, isolation)
        cloud.drop(isolated)
    enough = cloud.kept.sum() > 2 * OUTLIERS.neighbors  # for neighbourhoods that are no whole cloud
    if flips and enough and normals is not None:
        flipped = _flipped(cloud, normals)
        cloud.normals = np.where(flipped[:, None], -normals, normals)
    if outliers and enough:
        stray = _outliers(cloud)
    return Verdict(isolated, stray, flipped & cloud.kept)


def unsupported(points: Float64, normals: Float64, rows: Int64) -> Mask:
    """Which points ``rows`` ``(m,)`` of a cloud ``(N, 3)`` neither most neighbours nor their peers support."""
    if len(points) <= 2 * OUTLIERS.neighbors or not len(rows):
        return np.zeros(len(rows), bool)
    cloud = _Cloud(points, normals)
    support = _by_blocks(rows, lambda part: _support(cloud, part))
    return (support < OUTLIERS.majority) & ~_has_company(cloud, rows)


def agreement(points: Float64, normals: Float64, rows: Int64) -> tuple[Float64, Float64]:
    """The fraction of neighbours that support the points ``rows`` ``(m,)``, and their mean normals ``(m, 3)``.

    1 and the points' own normals in a cloud too small for neighbourhoods.
    """
    if len(points) <= 2 * OUTLIERS.neighbors:
        return np.ones(len(rows)), normals[rows]
    cloud = _Cloud(points, normals, rows)
    support = _by_blocks(rows, lambda part: _support(cloud, part))
    means = [normals[cloud.near[part]].mean(axis=1) for part in blocks(rows, OUTLIERS.block)]
    return support, np.concatenate([np.empty((0, 3)), *means])


class _Cloud:
    """Points around the origin, normals, and neighbours ``near`` ``(N, k)`` among the points that are ``kept``.

    ``signed``: normals were given, not fitted. ``flat`` ``(N,)``: the neighbourhood may support points. ``reach``
    ``(N,)``: distance to the eighth neighbour.
    """

    def __init__(self, points: Float64, normals: Float64 | None, rows: Int64 | None = None) -> None:
        self.points = centred(points)
        self.signed = normals is not None
        self.normals = np.zeros_like(points) if normals is None else normals
        self.flat = np.ones(len(points), bool)
        self.near = np.empty((len(points), min(OUTLIERS.neighbors, len(points) - 1)), np.int32)
        self.reach = np.empty(len(points))
        self.kept = np.ones(len(points), bool)
        self._look(np.arange(len(points)) if rows is None else rows)

    def drop(self, dropped: Mask) -> Int64:
        """Leave points out; returns the kept points that have new neighbours therefore."""
        self.kept &= ~dropped
        if self.kept.sum() <= self.near.shape[1]:
            return np.empty(0, np.int64)
        rows = np.flatnonzero(self.kept)
        changed = rows[dropped[self.near[rows]].any(axis=1)]
        if len(changed):
            self._look(changed)
        return changed

    def _look(self, rows: Int64) -> None:
        among = np.flatnonzero(self.kept).astype(np.int32)
        tree = KDTree(self.points[among], compact_nodes=False, balanced_tree=False)
        for part in blocks(rows, OUTLIERS.block):
            distance, found = query(tree, self.points[part], self.near.shape[1] + 1)
            self.near[part] = among[found[:, 1:]]
            self.reach[part] = distance[:, min(OUTLIERS.reach, self.near.shape[1])]
            if not self.signed:
                self.normals[part], spread = fit_planes(self.points[self.near[part]])
                self.flat[part] = spread < OUTLIERS.flat * self.reach[part]

    def edges(self, rows: Int64, near: NDArray[np.integer] | None = None) -> tuple[Float64, Float64]:
        """Vectors to the neighbours, or ``near``, ``(m, k, 3)``, and their lengths ``(m, k)``, which are never zero."""
        edge = self.points[self.near[rows] if near is None else near] - self.points[rows][:, None]
        return edge, np.maximum(np.linalg.norm(edge, axis=2), 1e-300)

    def thinning(self, rows: Int64) -> Float64:
        """Reach of points ``(m,)`` over the median of their neighbours."""
        return self.reach[rows] / np.maximum(np.median(self.reach[self.near[rows, : OUTLIERS.reach]], axis=1), 1e-300)


def _isolated(cloud: _Cloud, factor: float) -> Mask:
    isolated = cloud.reach > factor * np.median(cloud.reach)
    rows = np.flatnonzero(isolated)
    support = _by_blocks(rows, lambda part: _support(cloud, part, np.ones(len(part), bool)))
    isolated[rows] = (support < OUTLIERS.majority) | (cloud.thinning(rows) > OUTLIERS.sparser)
    return isolated


def _outliers(cloud: _Cloud) -> Mask:
    before = cloud.kept.copy()
    usual, large = np.quantile(cloud.reach[before], (0.5, 0.85))
    usual = max(usual, large / OUTLIERS.uneven)
    support = np.ones(len(before))
    rows = np.flatnonzero(before)
    for _ in range(OUTLIERS.rounds):
        dropped = np.zeros(len(before), bool)
        for part in blocks(rows, OUTLIERS.block):
            thinning, overall = cloud.thinning(part), cloud.reach[part] / usual
            sparse = (thinning > OUTLIERS.sparser) | (overall > OUTLIERS.sparse)
            lonely = (thinning > OUTLIERS.lonely) | (overall > OUTLIERS.lonely * OUTLIERS.sparse)
            support[part] = _support(cloud, part, lonely)
            dropped[part] = (support[part] < OUTLIERS.majority) & (sparse | _off(cloud, part))
        suspects = np.flatnonzero(dropped)
        dropped[suspects] = ~_has_company(cloud, suspects)
        if cloud.kept.sum() - dropped.sum() <= 2 * OUTLIERS.neighbors:
            break  # too few points are left to compare the rest with
        rows = cloud.drop(dropped)
        if len(rows) == 0:
            break
    cloud.drop(_stray_clusters(cloud, support))
    return before & ~cloud.kept


def _has_company(cloud: _Cloud, rows: Int64) -> Mask:
    """Whether enough peers support points ``(m,)``: the nearest among those of at least half of their reach.

    At the border of a sparse part, the nearest of all points lie on a dense edge, whose normals turn within a spacing.
    """
    support, count = np.zeros(len(rows)), cloud.near.shape[1]
    octave = np.floor(np.log2(np.maximum(cloud.reach[rows], 1e-300))).astype(np.int64)
    for step in np.unique(octave):
        mine, peers = np.flatnonzero(octave == step), np.flatnonzero(cloud.kept & (cloud.reach >= 2.0**step))
        if len(peers) <= count:
            continue
        distance, found = query(KDTree(cloud.points[peers]), cloud.points[rows[mine]], count + 1)
        near = peers[found[:, 1:]]
        if not cloud.signed:
            cloud.normals[rows[mine]], spread = fit_planes(cloud.points[near])
            cloud.flat[rows[mine]] = spread < OUTLIERS.flat * distance[:, OUTLIERS.reach]
        beside = distance[:, 1:] < OUTLIERS.beside * cloud.reach[rows[mine], None]
        support[mine] = _support(cloud, rows[mine], np.ones(len(mine), bool), near, beside)
    # Without signs, chance agrees twice as often.
    return support >= OUTLIERS.company * (1 if cloud.signed else 2)


def _flipped(cloud: _Cloud, normals: Float64) -> Mask:
    flipped = np.zeros(len(normals), bool)
    rows, everyone = np.flatnonzero(cloud.kept), np.ones(len(normals), bool)
    for _ in range(OUTLIERS.rounds):
        turned = np.where(flipped[:, None], -normals, normals)
        share = np.full(len(normals), 0.5)
        share[rows] = _by_blocks(rows, lambda part: _vote(cloud, turned, part, everyone)[0])  # noqa: B023
        doubtful = np.flatnonzero(share <= 0.3)
        wrong = [np.empty(0, np.int64)]
        for part in blocks(doubtful, OUTLIERS.block):
            alike, voters, level = _vote(cloud, turned, part, share >= 0.7)
            wrong.append(part[(alike <= 0.2) & (voters >= 3) & (voters >= 0.4 * level)])
        found = np.concatenate(wrong)
        if len(found) == 0:
            break
        flipped[found] ^= True
    return flipped


def _vote(cloud: _Cloud, normals: Float64, rows: Int64, trusted: Mask) -> tuple[Float64, Int64, Int64]:
    """Votes of the neighbours in the planes of points ``(m,)``, each ``(m,)``.

    The fraction of the trusted ones with a like normal (0.5 of none), the number of trusted ones, and of all.
    """
    near = cloud.near[rows]
    edge, length = cloud.edges(rows)
    own, theirs = normals[rows], normals[near]
    cosine = np.einsum("md,mkd->mk", own, theirs)
    level = np.abs(np.einsum("mkd,md->mk", edge, own)) <= 0.3 * length
    level &= np.abs(np.einsum("mkd,mkd->mk", edge, theirs)) <= 0.3 * length
    level &= np.abs(cosine) > 0.5
    votes = level & trusted[near]
    voters = votes.sum(axis=1)
    alike = (votes & (cosine > 0)).sum(axis=1) / np.maximum(voters, 1)
    return np.where(voters > 0, alike, 0.5), voters, level.sum(axis=1)


def _support(
    cloud: _Cloud,
    rows: Int64,
    lonely: Mask | None = None,
    near: NDArray[np.integer] | None = None,
    beside: Mask | None = None,
) -> Float64:
    """The fraction of neighbours, or ``near`` ``(m, k)``, that support points ``(m,)``; stricter where ``lonely``.

    A neighbour supports a point near its plane whose normal mirrors its own across the middle of the edge, as on any
    arc of a circle. ``beside`` ``(m, k)`` masks those that may.
    """
    near = cloud.near[rows] if near is None else near
    lonely = np.zeros(len(rows), bool) if lonely is None else lonely
    edge, length = cloud.edges(rows, near)
    own, theirs = cloud.normals[rows], cloud.normals[near]
    rise = np.einsum("mkd,mkd->mk", edge, theirs) / length
    mirrored = np.einsum("mkd,md->mk", theirs, own) - 2 * np.einsum("mkd,md->mk", edge, own) / length * rise
    if not cloud.signed:
        mirrored = np.abs(mirrored)
    supports = np.abs(rise) <= np.where(lonely, OUTLIERS.lonely_elevation, OUTLIERS.elevation)[:, None]
    supports &= mirrored >= np.where(lonely, OUTLIERS.lonely_mirrored, OUTLIERS.mirrored)[:, None]
    if beside is not None:
        supports &= beside
    return supports.mean(axis=1) * cloud.flat[rows]


def _off(cloud: _Cloud, rows: Int64) -> Mask:
    """Whether three in four neighbours agree on a plane and a normal, and the point ``(m,)`` is off them."""
    edge, _ = cloud.edges(rows)
    theirs, reach = cloud.normals[cloud.near[rows]], cloud.reach[rows]
    if not cloud.signed:  # one sign for all, so that their mean means something
        theirs = theirs * np.sign(np.einsum("mkd,md->mk", theirs, theirs[:, 0]))[:, :, None]
    mean = theirs.mean(axis=1)
    alike = np.einsum("mkd,md->mk", theirs, mean) > 0.7 * np.linalg.norm(mean, axis=1)[:, None]
    count = np.maximum(alike.sum(axis=1), 1)
    mean = (theirs * alike[:, :, None]).sum(axis=1) / count[:, None]
    length = np.linalg.norm(mean, axis=1)
    axis = mean / np.maximum(length, 1e-300)[:, None]
    height = np.einsum("mkd,md->mk", edge, axis)
    level = (height * alike).sum(axis=1) / count
    thickness = np.sqrt(((height - level[:, None]) ** 2 * alike).sum(axis=1) / count)
    agreed = (alike.mean(axis=1) >= 0.75) & (length > 0.9) & (thickness < 0.2 * reach) & cloud.flat[rows]
    beside = np.abs(level) > np.maximum(5 * thickness, 0.3 * reach)
    # At the rim of a flat part, points may have another normal, and lie beside it: those of the edge.
    middle = edge.mean(axis=1)
    middle = middle - (middle * axis).sum(axis=1, keepdims=True) * axis
    surrounded = np.linalg.norm(middle, axis=1) < 0.35 * reach
    cosine = (axis * cloud.normals[rows]).sum(axis=1)
    if cloud.signed:  # the other side of a thin part has the opposite normal, rightly
        beside &= cosine > -0.8
    return agreed & surrounded & (beside | (np.abs(cosine) < 0.3))


def _stray_clusters(cloud: _Cloud, support: Float64) -> Mask:
    """Members of small groups, far from the rest for their spacing, that support each other too little."""
    rows, count = np.flatnonzero(cloud.kept), len(cloud.kept)
    start, end = np.repeat(rows, cloud.near.shape[1]), cloud.near[rows].ravel()
    gap = np.linalg.norm(cloud.points[start] - cloud.points[end], axis=1)
    linked = gap <= 2 * np.minimum(cloud.reach[start], cloud.reach[end])
    graph = coo_array((np.ones(int(linked.sum()), np.int8), (start[linked], end[linked])), shape=(count, count))
    group = connected_components(graph.tocsr(), directed=False)[1]
    size = np.bincount(group, weights=cloud.kept)
    mean = np.bincount(group, weights=support * cloud.kept) / np.maximum(size, 1)
    small = size < max(OUTLIERS.neighbors, 1e-3 * len(rows))
    return (small & (mean < OUTLIERS.majority))[group] & cloud.kept


def _by_blocks(rows: Int64, function: Callable[[Int64], Float64]) -> Float64:
    return np.concatenate([np.empty(0), *(function(part) for part in blocks(rows, OUTLIERS.block))])
