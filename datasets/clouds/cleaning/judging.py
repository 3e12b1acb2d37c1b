"""Normals that came with a cloud, judged by its points: are they better than planes through neighbours, or worse?

Positions may have noise that the normals kept out, as in the paper's tests, or normals may be another program's, from
few neighbours of noisy points. Neither has to be known: on any arc of a circle ½(n_i + n_j)·(p_j − p_i) = 0, so that of
two normals at a point the one that leaves less of that over its neighbours is the better one. Planes are fitted to one
half of the points and judged by the other: in the half that it was fitted to a plane would always win.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..point_cloud import unit_rows
from .noise import noise_level
from .reestimate import REFIT, refit_normals

__all__ = ["layer_level", "neighborly", "worse_normals"]

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class JudgingOptions:
    """How given normals are compared with those of planes through neighbours."""

    asked: int = 1000  # points that say whether the others are worth a look
    block: int = 1 << 13  # rows handled at once, to bound memory
    fewest: int = 64  # points of a cloud that has two halves with neighbourhoods
    # Neighbours that judge a point: the nearest; with noise those further away, as nearer ones share it.
    near: tuple[int, int] = (1, 9)
    far: tuple[int, int] = (16, 33)
    # Neighbours that planes are fitted to, without and with noise.
    fitted: int = 16
    fitted_noisy: int = 64
    alike: float = 0.5  # smallest cosine between normals of one surface
    ratio: float = 1.5  # of the squares that are left, from which on a normal is worse
    tilt: float = 0.05  # radians that a worse normal is off at least
    # Least share of worse normals, and that in shares of those whose planes are worse.
    share: float = 0.08
    against: float = 1.5


JUDGING = JudgingOptions()


def layer_level(points: Float64, normals: Float64) -> float:
    """`noise_level`, unless it is noise of the normals and not of the points: then 0.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals that came with them.
    """
    level = noise_level(points, normals)
    if not level:
        return 0.0
    return min(level, noise_level(points, refit_normals(points, normals, 0.0, neighbors=JUDGING.fitted), fitted=True))


def neighborly(points: Float64, normals: Float64) -> Float64:
    """Unit means of the normals ``(N, 3)`` of each point and those of its eight nearest that are on the same side.

    Planes through neighbours with like normals need one to begin with, and a single bad one has no like.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals, on the right side for the most part.
    """
    near = np.asarray(KDTree(points).query(points, k=min(9, len(points)), workers=-1)[1])
    mean = normals.copy()
    for others in near.T[1:]:
        same = (normals * normals[others]).sum(axis=1, keepdims=True) > 0
        mean += np.where(same, normals[others], 0)
    return unit_rows(mean)


def worse_normals(points: Float64, normals: Float64, level: float, *, seed: int = 0) -> Mask:
    """Which normals ``(N,)`` are worse than those of planes through neighbours; none if the file's are mostly better.

    Let f be normals of planes fitted to the half of the points that a point is not in (see `refit_normals`), and n its
    given one. It is worse if ``Σ_j (½(n + f_j)·(p_j − p))²`` over neighbours in its own half is more than `ratio` times
    what f leaves of it, and more than that by what a tilt of `tilt` would leave. In the same way it may be better. None
    is taken for worse unless `share` of all are, and `against` times as many as are better.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals, on the right side for the most part.
        level: of the points' noise, see `layer_level`.
        seed: of the halves.
    """
    none = np.zeros(len(points), bool)
    if len(points) < JUDGING.fewest:
        return none
    random = np.random.default_rng(seed)
    judge = _Judge(points, normals, level, random.permutation(len(points)) < len(points) // 2)
    verdict = judge.verdict(random.permutation(len(points))[: JUDGING.asked])
    share = float((verdict > 0).mean())
    if share < max(JUDGING.share, JUDGING.against * float((verdict < 0).mean())):
        return none
    return judge.verdict(np.arange(len(points))) > 0


class _Judge:
    """A cloud in two halves; planes of each point are fitted to the other one."""

    def __init__(self, points: Float64, normals: Float64, level: float, first: Mask) -> None:
        self.points, self.normals, self.level, self.first = points, normals, level, first

    def verdict(self, rows: Rows) -> Rows:
        """1 where the given normal is worse than the plane's, −1 where it is better, else 0; ``(m,)`` for ``rows``."""
        low, high = JUDGING.far if self.level else JUDGING.near
        result = np.zeros(len(rows), np.int64)
        for half in (True, False):
            own, other = np.flatnonzero(self.first == half), np.flatnonzero(self.first != half)
            mine = np.flatnonzero(self.first[rows] == half)
            if not len(mine):
                continue
            tree = KDTree(self.points[own])
            near = np.asarray(tree.query(self.points[rows[mine]], k=min(high, len(own)), workers=-1)[1])[:, low:]
            members, place = np.unique(np.concatenate((rows[mine], own[near].ravel())), return_inverse=True)
            fitted = refit_normals(
                self.points,
                self.normals,
                REFIT.reach * self.level,
                neighbors=JUDGING.fitted_noisy if self.level else JUDGING.fitted,
                rows=members,
                among=other,
            )
            index = place[: len(mine)], place[len(mine) :].reshape(near.shape)
            for block in np.array_split(np.arange(len(mine)), -(-len(mine) // JUDGING.block)):
                result[mine[block]] = self._compared(members, fitted, index[0][block], index[1][block])
        return result

    def _compared(self, members: Rows, fitted: Float64, one: Rows, others: Rows) -> Rows:
        edge = self.points[members[others]] - self.points[members[one]][:, None]
        theirs, given, plane = fitted[others], self.normals[members[one]], fitted[one]
        alike = np.einsum("mkd,md->mk", theirs, plane) > JUDGING.alike
        along = np.einsum("mkd,mkd->mk", edge, theirs)

        def left(normal: Float64) -> Float64:
            return np.where(alike, (0.5 * (np.einsum("mkd,md->mk", edge, normal) + along)) ** 2, 0).sum(axis=1)

        # A tilt δ is seen as ½ δ times the part of the edge along it, half of whose square is there on average.
        seen = 0.125 * JUDGING.tilt**2 * np.where(alike, (edge**2).sum(axis=2), 0).sum(axis=1)
        theirs_left, ours_left = left(given), left(plane)
        worse = theirs_left > np.maximum(JUDGING.ratio * ours_left, ours_left + seen)
        better = ours_left > np.maximum(JUDGING.ratio * theirs_left, theirs_left + seen)
        return (worse.astype(np.int64) - better) * (alike.sum(axis=1) >= 4)
