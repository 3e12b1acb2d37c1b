"""Densification of sparse clouds, which keeps a residual level from oscillating between points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.clouds.cleaning.winding import DipoleField
from ...datasets.clouds.point_cloud import unit_rows
from ...neural_fields.backend.arrays import Float64, Int64, Mask
from .cloud import CLOUD, CloudDistance


@dataclass(frozen=True)
class DensificationOptions:
    """Numbers of `densified`; lengths in the units of each comment."""

    neighbors: int = 16  # that a patch is fitted to
    blended: int = 8  # patches at a place
    block: int = 1 << 15  # rows handled at once, to bound memory
    alike: float = 0.85  # cosine between normals of neighbours on one smooth surface
    mirrored: float = 0.08  # |½(n_i + n_j)·(p_j − p_i)| over the distance on an arc; 0.35 at a corner's mean normal
    agreed: float = 0.9  # cosine between normals of patches at one place
    company: int = 4  # least number of neighbours that agree with a patch
    wide: float = 0.1  # second over first eigenvalue of their spread: the points along an edge make no patch
    enough: float = 0.2  # least sum of weights across a patch
    ridge: float = 0.02  # ridge term of the fit, in the same units
    rim: float = 0.03  # height over the plane of a patch, over the distance, below which a point is in its rim
    row: int = 2  # least number of agreeing neighbours of a narrow face, which has `company` in its rim
    # Lengths in units of the distance to the fourth nearest point.
    spread: float = 0.05  # largest spread of patch values at a new point
    beyond: float = 0.03  # largest height over the plane of a disagreeing patch
    through: float = 0.1  # largest distance of two patches from a point of an edge
    one_sided: float = 0.7  # distance to the weighted mean of the points around; 1/√π = 0.56 on a half-plane's rim
    solid_angle: float = 0.2  # least part of the directions on either side: ½ on smooth surfaces, ¼ on a cube's edge
    closed: float = 0.95  # share of the cloud's points that meet `solid_angle`, below which it is an open sheet
    tested: int = 4000  # points of the cloud tested for that
    # Phase of the finest level between two points in radians, below which four points fix a wave and none is added.
    turn: float = np.pi / 2
    filling: float = 16.0  # places tried for each point, times k² − 1 at a phase of k `turn`


DENSIFICATION = DensificationOptions()


class Densified(NamedTuple):
    """A densified cloud."""

    normals: Float64  # (N, 3) of the cloud; those on an edge are replaced by one side's
    repaired: int  # how many of them
    points: Float64  # (M, 3) new points
    new_normals: Float64  # (M, 3)


def dense_distance(
    points: Tensor,
    normals: Tensor,
    *,
    omega: float,
    count: int,
    noise: float = 0.0,
    guessed: bool = False,
    seed: int = 0,
    beyond: DipoleField | None = None,
    options: DensificationOptions = DENSIFICATION,
) -> CloudDistance:
    """Distances to a cloud, densified where it is sparse for a network of frequency ``omega``.

    ``count`` limits the points of the cloud and the candidates between them together. See `CloudDistance` for
    ``noise``, ``guessed`` and ``beyond``.
    """
    about: dict[str, Any] = {"noise": noise, "guessed": guessed, "beyond": beyond}
    index = CloudDistance(points, normals, **about)
    wanted = options.filling * np.maximum(index.areas * (omega / options.turn) ** 2 - 1, 0)
    new = min(count - len(points), math.ceil(wanted.sum()))
    if new <= 0:
        return index
    found = densified(index.points, index.normals, new, share=wanted, seed=seed, options=options)
    new_points, new_normals = (torch.from_numpy(a.astype(np.float32)) for a in (found.points, found.new_normals))
    tested = index.points[:: 1 + len(points) // options.tested]
    if guessed and noise and _on_solid(index, tested, options).mean() > options.closed:
        kept = torch.from_numpy(_on_solid(index, new_points.numpy(), options))
        new_points, new_normals = new_points[kept], new_normals[kept]
    own_normals = torch.from_numpy(found.normals.astype(np.float32))
    dense = torch.cat((points.cpu(), new_points)), torch.cat((own_normals, new_normals))
    gaps = np.concatenate((index.gaps, index.nearest_gap(new_points.numpy())[1]))
    return CloudDistance(*dense, **about, given=len(points), gaps=gaps, repaired=found.repaired)


def _on_solid(index: CloudDistance, x: NDArray[np.float32], options: DensificationOptions) -> Mask:
    """Whether both sides of each of ``(M, 3)`` surface points have `solid_angle`, by winding numbers."""
    return np.abs(index.winding_number(x, soft=CLOUD.soft_guessed) - 0.5) < 0.5 - options.solid_angle


def densified(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    count: int,
    *,
    share: NDArray[np.floating] | None = None,
    seed: int = 0,
    options: DensificationOptions = DENSIFICATION,
) -> Densified:
    """Upsample a cloud: points of the surface between its own, by patches fitted to points and normals.

    A point p_i has the patch f_i(x) = ⟨n_i, d⟩ + ½ dᵀ S_i d with d = x − p_i. Its shape operator S_i is the
    least-squares fit of n_j − n_i ≈ S_i (p_j − p_i) over neighbours on an arc of circle with it, ½(n_i + n_j)·(p_j −
    p_i) ≈ 0. New points are zeros of the patches around them, blended as in moving least squares surfaces (Kolluri,
    SODA 2005). Only patches with agreeing normals are blended (Öztireli, Guennebaud and Gross, 2009), and places beyond
    an edge, with contradicting patches or without points on all sides stay empty: edges stay sharp.

    ``count`` candidates are drawn, in proportion to ``share`` ``(N,)`` beside each point (None: by area).
    """
    if len(points) <= options.neighbors:  # too few for a neighbourhood that is not the whole
        return Densified(normals.astype(np.float64), 0, np.empty((0, 3)), np.empty((0, 3)))
    patches = _Patches(points.astype(np.float64), normals.astype(np.float64), options)
    share = patches.reach**2 if share is None else share
    able = np.flatnonzero(patches.sound & (share > 0))
    fixed, repaired = _repaired(patches)
    found = [(np.empty((0, 3)), np.empty((0, 3)))]
    if len(able):
        random = np.random.default_rng(seed)
        chance = share[able].astype(np.float64)
        # Sorted, so that neighbours are near in memory.
        parents = np.sort(random.choice(able, count, p=chance / chance.sum()))
        for start in range(0, count, options.block):
            found.append(_placed(patches, parents[start : start + options.block], random))
    new = [np.concatenate(columns) for columns in zip(*found, strict=True)]
    return Densified(fixed, repaired, new[0], new[1])


class _Patches:
    """The patch of every point: its shape operator ``(N, 3, 3)``, reach, and soundness.

    ``reach`` ``(N,)`` is the distance to the sixth neighbour; a patch is ``sound`` if neighbours on all sides agree.
    """

    def __init__(self, points: Float64, normals: Float64, options: DensificationOptions) -> None:
        self.options = options
        self.points, self.normals = points, normals
        self.tree = KDTree(points, balanced_tree=False)
        self.shape, self.reach = np.zeros((len(points), 3, 3)), np.zeros(len(points))
        self.sound: Mask = np.zeros(len(points), bool)
        for start in range(0, len(points), self.options.block):
            self._fit(np.arange(start, min(start + self.options.block, len(points))))

    def _fit(self, rows: Int64) -> None:
        distance, found = self._nearest(self.points[rows], self.options.neighbors + 1)
        distance, found = distance[:, 1:], found[:, 1:]  # not the point itself
        own, theirs = self.normals[rows][:, None], self.normals[found]
        edge = self.points[found] - self.points[rows][:, None]
        mirrored = np.abs(0.5 * ((own + theirs) * edge).sum(axis=2)) < self.options.mirrored * distance
        scale = np.maximum(np.median(distance, axis=1), 1e-300)[:, None]
        weight = mirrored & ((own * theirs).sum(axis=2) > self.options.alike)
        near = np.exp(-((distance / scale) ** 2) / 2)
        across = (edge - (edge * own).sum(axis=2, keepdims=True) * own) / scale[..., None]
        turn = theirs - (theirs * own).sum(axis=2, keepdims=True) * own
        spread, mixed, sound = _fitted(weight, near, across, turn, self.options)
        # A face two spacings wide has one row of points of its own. The points of its edges have other normals, but
        # lie in its plane.
        rim = ~weight & (np.abs((edge * own).sum(axis=2)) < self.options.rim * distance)
        turn = np.where(weight[..., None], turn, 0.0)
        wider, mixed_too, sound_too = _fitted(weight | rim, near, across, turn, self.options)
        spread = np.where(sound[:, None, None], spread, wider)
        mixed = np.where(sound[:, None, None], mixed, mixed_too)
        self.sound[rows] = sound | (
            sound_too & (weight.sum(axis=1) >= self.options.row) & (rim.sum(axis=1) >= self.options.company)
        )
        solved = np.linalg.solve(spread + self.options.ridge * np.eye(3), mixed)
        self.shape[rows] = 0.5 * (solved + solved.transpose(0, 2, 1)) / scale[..., None]
        self.reach[rows] = distance[:, 5]

    def _nearest(self, x: Float64, count: int) -> tuple[Float64, Int64]:
        distance, found = self.tree.query(x, count, workers=-1)
        return np.asarray(distance, np.float64), np.asarray(found, np.int64)

    def at(self, x: Float64, count: int) -> tuple[Float64, Int64, Float64, Float64, Float64]:
        """The patches of the nearest points at ``(m, 3)`` places.

        Distances and rows of the points ``(m, k)``, vectors from them ``(m, k, 3)``, values ``(m, k)`` and unit normals
        ``(m, k, 3)`` of the patches.
        """
        distance, found = self._nearest(x, count)
        offset = x[:, None] - self.points[found]
        bent = np.einsum("mkab,mkb->mka", self.shape[found], offset)
        own = self.normals[found]
        value = ((own + 0.5 * bent) * offset).sum(axis=2)
        return distance, found, offset, value, unit_rows(own + bent)


def _fitted(
    chosen: Mask, near: Float64, across: Float64, turn: Float64, options: DensificationOptions
) -> tuple[Float64, Float64, Mask]:
    """The normal equations of the shapes, and which patches have ``chosen`` neighbours ``(n, k)`` on all sides.

    ``near`` ``(n, k)`` are weights; ``across`` and ``turn`` ``(n, k, 3)`` are positions in the plane and normal
    changes.
    """
    weighted = ((chosen * near)[..., None] * across).transpose(0, 2, 1)  # (n, 3, k)
    spread = weighted @ across
    values = np.linalg.eigvalsh(spread)  # the first is across the plane: 0
    sound = (values[:, 1] > np.maximum(options.wide * values[:, 2], options.enough)) & (
        chosen.sum(axis=1) >= options.company
    )
    return spread, weighted @ turn, sound


def _repaired(patches: _Patches) -> tuple[Float64, int]:
    """The normals, those of points on an edge replaced by one side's, and how many were.

    Such a point has no sound patch, but sound patches of two sides pass through it.
    """
    options, fixed, odd = patches.options, patches.normals.copy(), np.flatnonzero(~patches.sound)
    if not len(odd):
        return fixed, 0
    distance, found, _, value, normal = patches.at(patches.points[odd], options.neighbors)
    through = patches.sound[found] & (np.abs(value) < options.through * distance[:, 4:5])
    first = through.argmax(axis=1)  # the nearest
    side = normal[np.arange(len(odd)), first]
    other = through & ((normal * side[:, None]).sum(axis=2) < options.alike)
    torn = other.any(axis=1) & ((side * fixed[odd]).sum(axis=1) < options.alike**0.25)
    fixed[odd[torn]] = side[torn]
    return fixed, int(torn.sum())


def _placed(patches: _Patches, parents: Int64, random: np.random.Generator) -> tuple[Float64, Float64]:
    """New points and their normals, at most one beside each of ``parents``."""
    normal = patches.normals[parents]
    step = random.normal(size=(len(parents), 3))
    step = unit_rows(step - (step * normal).sum(axis=1, keepdims=True) * normal)
    step *= (0.8 * patches.reach[parents] * np.sqrt(random.random(len(parents))))[:, None]
    bent = np.einsum("mab,mb->ma", patches.shape[parents], step)
    x = patches.points[parents] + step - 0.5 * (bent * step).sum(axis=1, keepdims=True) * normal
    normal, good = unit_rows(normal + bent), np.ones(len(parents), bool)
    for _ in range(2):  # patches are flat across a spacing: the second move is a hundredth of the first
        moved, normal, good = _blended(patches, x, normal)
        x = x + moved
    return x[good], normal[good]


def _blended(patches: _Patches, x: Float64, normal: Float64) -> tuple[Float64, Float64, Mask]:
    """Moves of places ``(m, 3)`` onto the blend of patches, its normals, and which places are good."""
    options = patches.options
    distance, found, offset, value, theirs = patches.at(x, options.blended)
    scale, sound = distance[:, 3:4], patches.sound[found]
    cosine = (theirs * normal[:, None]).sum(axis=2)
    weight = (
        sound
        * np.exp(-((distance / scale) ** 2))
        * np.clip((cosine - options.agreed) / (1 - options.agreed), 0, 1) ** 2
    )
    total = weight.sum(axis=1, keepdims=True)
    weight /= np.maximum(total, 1e-300)
    mean = (weight * value).sum(axis=1, keepdims=True)
    blend = unit_rows((weight[..., None] * theirs).sum(axis=1))
    spread = np.sqrt((weight * (value - mean) ** 2).sum(axis=1, keepdims=True))
    # Two points of one surface are on the same side of each other's planes, on arcs and edges alike.
    above, below = -(offset * blend[:, None]).sum(axis=2), (offset * patches.normals[found]).sum(axis=2)
    beyond = sound & (cosine < options.agreed) & (above * below < 0)
    beyond &= np.minimum(np.abs(above), np.abs(below)) > options.beyond * scale
    middle = np.linalg.norm(np.einsum("mk,mkd->md", weight, offset), axis=1, keepdims=True)
    good = (total > options.enough) & (spread < options.spread * scale) & ~beyond.any(axis=1, keepdims=True)
    good = (good & (middle < options.one_sided * scale))[:, 0]
    return -mean * blend, blend, good
