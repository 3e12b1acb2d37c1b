"""Outliers and wrong normals of a cloud, found by its level 0: a small network averages over single points."""

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
from ...neural_fields.backend.arrays import Float64, Int64, Mask
from .samples import value_and_gradient


@dataclass(frozen=True)
class ReviewOptions:
    """Numbers of `review_points`."""

    # Largest |f_0| in units of its robust scale; half of the errors of a clean cloud are below 0.67.
    far: float = 8.0
    mad: float = 1.4826  # a Gaussian's standard deviation over its median magnitude
    against: float = -0.7  # cosine between a normal and the gradient, below which the normal may be flipped
    opposed: float = -0.3  # cosine between a flipped normal and the mean of its neighbours'
    slope: float = -0.5  # ∇f along a normal of a patch, below which it may be flipped: flat fields are unsure
    neighbors: int = 12
    level: float = 0.3  # sine of the elevation of an edge between neighbours on one sheet
    contradicted: float = -0.3  # mean agreement across a patch's rim
    # Share of neighbours beyond the rim times the root of the number of points: 1.5 for a disc, more where two sheets
    # with rightly opposite normals are hardly a spacing apart.
    ragged: float = 3.0


REVIEW = ReviewOptions()


class Review(NamedTuple):
    """The outliers, and the kept points whose normals are to be turned, ``(N,)`` each."""

    dropped: Mask
    turned: Mask
    scale: float  # robust scale of |f_0| at the points

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
    """Find outliers and flipped normals of a cloud by the level 0 of its fit.

    An outlier is further from the zero level than `far` robust scales, has a normal unlike the gradient, and no support
    by neighbours: fine parts that the level misses support themselves. A flipped normal opposes the gradient and the
    mean normal of its neighbours, which the gradient follows. With ``patches``, where signs were guessed, patches of
    normals that oppose the gradient and the normals around them are turned too.
    """
    value, slope = (part.cpu() for part in value_and_gradient(coarse, points.to(device), level=0))
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
    """Which normals ``(N, 3)``, of those ``against`` ``(N,)`` the field, form patches that their neighbours contradict.

    Neighbours on one sheet agree by ``⟨n_i, n_j⟩ − 2 ⟨e, n_i⟩ ⟨e, n_j⟩ / |e|²`` with the edge e between them: 1 on any
    arc of a circle, −1 where one of them is turned.
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


def _joined(rows: Int64, near: Int64, linked: Mask, count: int) -> NDArray[np.intp]:
    """The patch ``(m,)`` of each of ``rows``: components of the graph of ``linked`` neighbours ``near`` ``(m, k)``."""
    start, end = np.repeat(rows, near.shape[1])[linked.ravel()], near[linked]
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    label = connected_components(graph.tocsr(), directed=False)[1][rows]
    return np.unique(label, return_inverse=True)[1].reshape(-1)
