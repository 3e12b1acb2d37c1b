"""Level 0 as a judge of its cloud: outliers and wrong normals, which the finer levels do not see.

A small network with a few hundred steps does not bend to single points, nor to a patch of normals that point the other
way than all around it: what it made of the whole says what is wrong with the parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.clouds.cleaning.outliers import agreement, unsupported
from ...neural_fields import Field

__all__ = ["Review", "ReviewOptions", "review_points"]

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]


@dataclass(frozen=True)
class ReviewOptions:
    """Numbers of `review_points`."""

    # Largest |f_0| in units of its robust scale: half of a sound cloud's errors are below 0.67, and what a coarse
    # level misses of fine parts is above 8; so is every stray that is worth finding.
    far: float = 8.0
    mad: float = 1.4826  # a Gaussian's standard deviation over its median magnitude
    against: float = -0.7  # cosine between a normal and the gradient of level 0, below which the normal may be flipped
    opposed: float = -0.3  # and the mean of its neighbours', along its own
    # Estimated normals are wrong in whole patches, whose members have each other for neighbours: a patch is turned if
    # the neighbours round it are of another mind. Where data contradict each other a field is flat: its slope says
    # how sure it is, and it must be this much against the normal.
    slope: float = -0.5
    neighbors: int = 12
    level: float = 0.3  # sine of the elevation of an edge between neighbours on the same sheet
    contradicted: float = -0.3  # mean agreement across a patch's rim
    # Largest share of a patch's neighbours that are beyond its rim, times the root of its number of points: 1.5 for a
    # disc, for a disc of n points has a rim of 2 √(πn) spacings, which edges of 1.3 spacings cross (those to 12
    # neighbours, in the mean). Where it is more, there are two sheets with opposite normals, rightly, that are hardly
    # a spacing apart.
    ragged: float = 3.0


REVIEW = ReviewOptions()


class Review(NamedTuple):
    """Which points of a cloud the next levels must not see as they are; each ``(N,)``.

    Attributes:
        dropped: outliers.
        turned: kept points whose normals are to be turned round.
        scale: the robust scale of |f_0| at the points.
    """

    dropped: Mask
    turned: Mask
    scale: float

    def record(self) -> dict[str, Any]:
        """Counts for ``run.json``."""
        return {
            "dropped_outliers": int(self.dropped.sum()),
            "turned_normals": int(self.turned.sum()),
            "scale": self.scale,
        }


@torch.no_grad()
def review_points(
    points: Tensor,
    normals: Tensor,
    coarse: Field,
    *,
    device: torch.device,
    outliers: bool,
    turn: bool,
    patches: bool = False,
    options: ReviewOptions = REVIEW,
) -> Review:
    """Judge a cloud by the level that was fitted to it.

    An outlier is a point that the level passes at more than `far` times the robust scale, that has another normal than
    the field there, and that neither half of its neighbours nor points about as sparse support: fine parts that the
    level misses support themselves. A flipped normal opposes the field's gradient and its neighbours' mean normal,
    which the gradient follows. A patch of flipped normals opposes the gradient, and the normals beside it.

    Args:
        points: ``(N, 3)``.
        normals: ``(N, 3)``.
        coarse: its level 0 judges.
        device: where the field is.
        outliers: whether to look for outliers.
        turn: whether to look for flipped normals, each on its own.
        patches: whether to look for patches of them too: the signs are guesses, not measured ones.
        options: numbers of the algorithm.
    """
    jets = [coarse.jet(part.to(device), level=0) for part in points.split(1 << 16)]
    value = torch.cat([jet.value for jet in jets]).cpu()
    slope = torch.cat([jet.gradient for jet in jets]).cpu()
    gradient = torch.nn.functional.normalize(slope, dim=1)
    cosine = (gradient * normals).sum(dim=1)
    scale = options.mad * float(value.abs().median())
    places, directions = points.double().numpy(), normals.double().numpy()
    dropped, turned = np.zeros((2, len(points)), bool)
    if outliers:
        far = ((value.abs() > options.far * scale) & (cosine < 0.5)).nonzero()[:, 0].numpy()
        dropped[far] = unsupported(places, directions, far)
    if turn:
        against = ((cosine < options.against) & torch.from_numpy(~dropped)).nonzero()[:, 0].numpy()
        _, means = agreement(places, directions, against)
        opposed = (means * directions[against]).sum(axis=1) < options.opposed
        followed = (means * gradient.double().numpy()[against]).sum(axis=1) > -options.opposed
        turned[against] = opposed & followed
    if patches:
        against = (slope * normals).sum(dim=1) < options.slope
        against &= (value.abs() < options.far * scale) & torch.from_numpy(~dropped & ~turned)
        turned |= _patches(places, np.where(turned[:, None], -directions, directions), against.numpy(), options=options)
    return Review(dropped, turned, scale)


def _patches(points: Float64, normals: Float64, against: Mask, options: ReviewOptions = REVIEW) -> Mask:
    """Which normals ``(N, 3)``, of those ``against`` ``(N,)`` the field, are patches that their neighbours contradict.

    Neighbours on the same sheet agree by ``⟨n_i, n_j⟩ − 2 ⟨e, n_i⟩ ⟨e, n_j⟩ / |e|²``, e being the edge between them:
    1 on any arc of a circle, −1 where one of them is turned.
    """
    rows, turned = np.flatnonzero(against), np.zeros(len(points), bool)
    if not len(rows) or len(points) <= options.neighbors:
        return turned
    near = np.asarray(KDTree(points).query(points[rows], k=options.neighbors + 1, workers=-1)[1])[:, 1:]
    edge = points[near] - points[rows][:, None]
    edge /= np.maximum(np.linalg.norm(edge, axis=2, keepdims=True), 1e-300)
    own, theirs = np.einsum("mkd,md->mk", edge, normals[rows]), np.einsum("mkd,mkd->mk", edge, normals[near])
    alike = np.einsum("mkd,md->mk", normals[near], normals[rows]) - 2 * own * theirs
    beside = (np.abs(own) < options.level) & (np.abs(theirs) < options.level)
    inside = against[near]
    patch = _joined(rows, near, beside & inside & (alike > 0), len(points))
    across = beside & ~inside
    count = np.bincount(patch)
    rim = np.bincount(patch, across.sum(axis=1))
    mean = np.bincount(patch, np.where(across, alike, 0).sum(axis=1)) / np.maximum(rim, 1)
    mixed = rim / np.maximum(np.bincount(patch, beside.sum(axis=1)), 1)
    wrong = (rim > 0) & (mean < options.contradicted) & (mixed * np.sqrt(count) < options.ragged)
    turned[rows] = wrong[patch]
    return turned


def _joined(rows: Rows, near: Rows, linked: Mask, count: int) -> NDArray[np.intp]:
    """The patch ``(m,)`` of each of ``rows``, which ``linked`` neighbours ``near`` ``(m, k)`` join."""
    start, end = np.repeat(rows, near.shape[1])[linked.ravel()], near[linked]
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    label = connected_components(graph.tocsr(), directed=False)[1][rows]
    return np.unique(label, return_inverse=True)[1].reshape(-1)
