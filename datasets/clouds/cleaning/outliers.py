"""Outliers and flipped normals of a cloud, found from each point's neighbours before anything is fitted.

A point is judged by two things. How isolated is it: the distance to its eighth neighbour against those of its
neighbours (as in Breunig et al., "LOF: identifying density-based local outliers", SIGMOD 2000) and against the
cloud's median. And whom does it agree with: a neighbour supports it if it lies near the neighbour's plane and their
normals mirror each other in the middle of the edge between them, as on any arc of a circle (the rule of König and
Gumhold, see :mod:`.orientation`): so the two sides of a thin blade support each other. Sparseness alone condemns
nothing, nor does an odd normal: thin and sharp parts have many.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ..point_cloud import centred
from .orientation import fit_planes

__all__ = ["Verdict", "agreement", "inspect_points", "unsupported"]

Float64 = NDArray[np.float64]
Rows = NDArray[np.integer]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class OutlierOptions:
    """Which points belong to no surface."""

    neighbors: int = 12
    reach: int = 8  # the neighbour whose distance tells how sparse a place is
    block: int = 1 << 16  # points handled at once, to bound memory
    # Distance of that neighbour over its neighbours' (1 in 1,000 of clean points), and over the median (1 in 30,000).
    sparser: float = 2.5
    sparse: float = 4.0
    # Of a neighbour that supports a point: sine of the edge's elevation over its plane (0.58 at the corners of a cube),
    # and cosine of the mirrored normals; the same of points so many times sparser than others.
    elevation: float = 0.6
    mirrored: float = 0.5
    lonely: float = 4.0
    lonely_elevation: float = 0.3
    lonely_mirrored: float = 0.9
    flat: float = 0.25  # deviation from a plane, over that distance, up to which planes are trusted
    # Share of the peers that must support a point as strictly, and how far they may be in units of its reach.
    company: float = 0.16
    beside: float = 2.0
    majority: float = 0.5  # share of neighbours that must support a sparse point


OUTLIERS = OutlierOptions()


class Verdict(NamedTuple):
    """What `inspect_points` finds; each ``(N,)``.

    Attributes:
        isolated: points far from all others.
        outliers: other points that belong to no surface.
        flipped: kept points whose normal is to be turned round.
    """

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
    """Find strays and flipped normals.

    Isolated is a point whose eighth neighbour is ``isolation`` times further away than the median point's, unless it
    has company: neighbours about as sparse that support it. Outliers are points that are sparse (`sparser`, `sparse`)
    and supported by fewer than half of their neighbours; points off the plane, or across the normals, that all their
    neighbours agree on; and small clusters apart whose members do not support each other. As strays may be each
    other's neighbours, those of the dropped are judged again. A normal is flipped if nearly all neighbours in the
    point's own plane, which those on the far side of a thin part are not, have the opposite one, and are themselves
    trusted by theirs: two sheets in one place, with opposite normals, have no such points.

    Args:
        points: ``(N, 3)``, finite.
        normals: ``(N, 3)`` unit normals, or None: planes through the neighbourhoods then stand in for them,
            neighbourhoods that are not flat support nothing, and nothing is flipped.
        isolation: the factor; None finds no isolated points.
        outliers: whether to look for the other outliers.
        flips: whether to look for flipped normals.
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


def unsupported(points: Float64, normals: Float64, rows: Rows) -> Mask:
    """Which of the points ``rows`` ``(m,)`` of a cloud ``(N, 3)`` neither most neighbours nor their peers support."""
    if len(points) <= 2 * OUTLIERS.neighbors or not len(rows):
        return np.zeros(len(rows), bool)
    cloud = _Cloud(points, normals)
    support = _by_blocks(rows, lambda part: _support(cloud, part, np.zeros(len(part), bool)))
    return (support < OUTLIERS.majority) & ~_has_company(cloud, rows)


def agreement(points: Float64, normals: Float64, rows: Rows) -> tuple[Float64, Float64]:
    """What the neighbours of the points ``rows`` ``(m,)`` of a cloud ``(N, 3)`` say of them.

    Returns:
        The share of their neighbours that support them ``(m,)``, and their neighbours' mean normals ``(m, 3)``, of
        length 1 where all agree. In a cloud too small for neighbourhoods every point agrees.
    """
    if len(points) <= 2 * OUTLIERS.neighbors:
        return np.ones(len(rows)), normals[rows]
    cloud = _Cloud(points, normals, rows)
    support = _by_blocks(rows, lambda part: _support(cloud, part, np.zeros(len(part), bool)))
    means = [normals[cloud.near[part]].mean(axis=1) for part in _blocks(rows)]
    return support, np.concatenate([np.empty((0, 3)), *means])


class _Cloud:
    """Points and their neighbours, those that are dropped left out.

    Attributes:
        points: ``(N, 3)``, around the origin: a tree over map coordinates would lose digits.
        normals: ``(N, 3)``, given or of planes.
        signed: whether the normals' signs mean anything.
        flat: ``(N,)`` whether a neighbourhood may support anything.
        near: ``(N, k)`` indices of the nearest points, without the point itself.
        reach: ``(N,)`` distance to the eighth of them.
        kept: ``(N,)``.
    """

    def __init__(self, points: Float64, normals: Float64 | None, rows: Rows | None = None) -> None:
        self.points = centred(points)
        self.signed = normals is not None
        self.normals = np.zeros_like(points) if normals is None else normals
        self.flat = np.ones(len(points), bool)
        self.near = np.empty((len(points), min(OUTLIERS.neighbors, len(points) - 1)), np.int32)
        self.reach = np.empty(len(points))
        self.kept = np.ones(len(points), bool)
        self._look(np.arange(len(points)) if rows is None else rows)

    def drop(self, dropped: Mask) -> Rows:
        """Leave points out → the kept points that lost neighbours, which have new ones now."""
        self.kept &= ~dropped
        if self.kept.sum() <= self.near.shape[1]:
            return np.empty(0, np.int64)
        rows = np.flatnonzero(self.kept)
        changed = rows[dropped[self.near[rows]].any(axis=1)]
        if len(changed):
            self._look(changed)
        return changed

    def _look(self, rows: Rows) -> None:
        among = np.flatnonzero(self.kept).astype(np.int32)
        tree = KDTree(self.points[among], compact_nodes=False, balanced_tree=False)
        for part in _blocks(rows):
            distance, found = tree.query(self.points[part], k=self.near.shape[1] + 1, workers=-1)
            self.near[part] = among[np.asarray(found)[:, 1:]]
            self.reach[part] = np.asarray(distance)[:, min(OUTLIERS.reach, self.near.shape[1])]
            if not self.signed:
                self.normals[part], spread = fit_planes(self.points[self.near[part]])
                self.flat[part] = spread < OUTLIERS.flat * self.reach[part]

    def edges(self, rows: Rows, near: Rows | None = None) -> tuple[Float64, Float64]:
        """Vectors to the neighbours or ``near`` ``(m, k, 3)``, and their lengths ``(m, k)``, which are never zero."""
        edge = self.points[self.near[rows] if near is None else near] - self.points[rows][:, None]
        return edge, np.maximum(np.linalg.norm(edge, axis=2), 1e-300)

    def thinning(self, rows: Rows) -> Float64:
        """How many times sparser it is around points ``(m,)`` than around their neighbours."""
        return self.reach[rows] / np.maximum(np.median(self.reach[self.near[rows, : OUTLIERS.reach]], axis=1), 1e-300)


def _isolated(cloud: _Cloud, factor: float) -> Mask:
    isolated = cloud.reach > factor * np.median(cloud.reach)
    rows = np.flatnonzero(isolated)
    support = _by_blocks(rows, lambda part: _support(cloud, part, np.ones(len(part), bool)))
    isolated[rows] = (support < OUTLIERS.majority) | (cloud.thinning(rows) > OUTLIERS.sparser)
    return isolated


def _outliers(cloud: _Cloud, *, rounds: int = 4) -> Mask:
    before, usual = cloud.kept.copy(), float(np.median(cloud.reach[cloud.kept]))
    support = np.ones(len(before))
    asked = np.flatnonzero(before)
    for _ in range(rounds):
        dropped = np.zeros(len(before), bool)
        for part in _blocks(asked):
            thinning, overall = cloud.thinning(part), cloud.reach[part] / usual
            sparse = (thinning > OUTLIERS.sparser) | (overall > OUTLIERS.sparse)
            lonely = (thinning > OUTLIERS.lonely) | (overall > OUTLIERS.lonely * OUTLIERS.sparse)
            support[part] = _support(cloud, part, lonely)
            dropped[part] = (support[part] < OUTLIERS.majority) & (sparse | _off(cloud, part))
        suspects = np.flatnonzero(dropped)
        dropped[suspects] = ~_has_company(cloud, suspects)
        if cloud.kept.sum() - dropped.sum() <= 2 * OUTLIERS.neighbors:
            break  # nothing here is sound enough to judge the rest by
        asked = cloud.drop(dropped)
        if len(asked) == 0:
            break
    cloud.drop(_stray_clusters(cloud, support))
    return before & ~cloud.kept


def _has_company(cloud: _Cloud, rows: Rows) -> Mask:
    """Whether points ``(m,)`` have peers that support them: the nearest points where the cloud is about as sparse.

    A point at the border of a sparse part has the points of a dense edge for neighbours, whose normals turn within its
    own spacing. The reach of peers is at least half of its own, in steps of a factor of two.
    """
    support, count = np.zeros(len(rows)), cloud.near.shape[1]
    octave = np.floor(np.log2(np.maximum(cloud.reach[rows], 1e-300))).astype(np.int64)
    for step in np.unique(octave):
        mine, peers = np.flatnonzero(octave == step), np.flatnonzero(cloud.kept & (cloud.reach >= 2.0**step))
        if len(peers) <= count:
            continue
        distance, found = KDTree(cloud.points[peers]).query(cloud.points[rows[mine]], k=count + 1, workers=-1)
        distance, near = np.asarray(distance), peers[np.asarray(found)[:, 1:]]
        if not cloud.signed:
            cloud.normals[rows[mine]], spread = fit_planes(cloud.points[near])
            cloud.flat[rows[mine]] = spread < OUTLIERS.flat * distance[:, OUTLIERS.reach]
        beside = distance[:, 1:] < OUTLIERS.beside * cloud.reach[rows[mine], None]
        support[mine] = _support(cloud, rows[mine], np.ones(len(mine), bool), near, beside)
    # Without signs, chance agrees twice as often.
    return support >= OUTLIERS.company * (1 if cloud.signed else 2)


def _flipped(cloud: _Cloud, normals: Float64, *, rounds: int = 4) -> Mask:
    flipped = np.zeros(len(normals), bool)
    everyone = np.flatnonzero(cloud.kept)
    nobody = np.ones(len(normals), bool)
    for _ in range(rounds):
        turned = np.where(flipped[:, None], -normals, normals)
        share = np.full(len(normals), 0.5)
        share[everyone] = _by_blocks(everyone, lambda part: _vote(cloud, turned, part, nobody)[0])  # noqa: B023
        doubtful = np.flatnonzero(share <= 0.3)
        votes = [_vote(cloud, turned, part, share >= 0.7) for part in _blocks(doubtful)]
        wrong = [
            part[(alike <= 0.2) & (voters >= 3) & (voters >= 0.4 * asked)]
            for part, (alike, voters, asked) in zip(_blocks(doubtful), votes, strict=True)
        ]
        found = np.concatenate([np.empty(0, np.int64), *wrong])
        if len(found) == 0:
            break
        flipped[found] ^= True
    return flipped


def _vote(
    cloud: _Cloud, normals: Float64, rows: Rows, trusted: Mask
) -> tuple[Float64, NDArray[np.int64], NDArray[np.int64]]:
    """Of the neighbours in a point's plane: the share of the trusted that have a normal like its own, 0.5 for none.

    Returns:
        The share, how many are trusted, and how many there are, each ``(m,)``.
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


def _support(cloud: _Cloud, rows: Rows, lonely: Mask, near: Rows | None = None, beside: Mask | None = None) -> Float64:
    """The share of the neighbours, or ``near``, that support points ``(m,)``; of ``lonely`` ones more is asked.

    Only those of ``near`` ``(m, k)`` that are ``beside`` a point ``(m, k)`` can support it.
    """
    near = cloud.near[rows] if near is None else near
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


def _off(cloud: _Cloud, rows: Rows) -> Mask:
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


def _blocks(rows: Rows) -> Iterator[Rows]:
    for start in range(0, len(rows), OUTLIERS.block):
        yield rows[start : start + OUTLIERS.block]


def _by_blocks(rows: Rows, function: Callable[[Rows], Float64]) -> Float64:
    return np.concatenate([np.empty(0), *(function(part) for part in _blocks(rows))])
