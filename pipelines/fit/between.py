"""Points between the points of a cloud: what holds a level down where nothing was measured.

A network may do what it likes between its samples, and a residual one does: a smooth cloud comes out dimpled like an
orange. A cloud with normals says more than its points do. A point p_i and the normals of its neighbours make a patch,

    f_i(x) = ⟨n_i, d⟩ + ½ dᵀ S_i d,  d = x − p_i,

whose shape operator S_i fits n_j − n_i ≈ S_i (p_j − p_i) best, over the neighbours on an arc of circle with it:
½(n_i + n_j)·(p_j − p_i) ≈ 0 whatever the curvature. New points lie where the patches around them, blended as in moving
least squares surfaces (Kolluri, "Provably good moving least squares", SODA 2005), are zero. Only patches whose normals
agree are blended, as in robust ones (Öztireli, Guennebaud and Gross, "Feature preserving point set surfaces based on
non-linear kernel regression", 2009), and a place beyond an edge is left empty: edges stay sharp. So is one where
patches contradict each other: the wider the noise, the fewer points there are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from .cloud import CLOUD, CloudDistance

__all__ = ["BetweenOptions", "Densified", "dense_distance", "densified"]

Float64 = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BetweenOptions:
    """Numbers of `densified`; lengths in the units that each comment says."""

    neighbors: int = 16  # that a patch is fitted to
    blended: int = 8  # patches that a place is asked of
    block: int = 1 << 15  # rows handled at once, to bound memory
    # Cosine between the normals of a point and of a neighbour on the same smooth surface, and how far from an arc of
    # circle they may be: |½(n_i + n_j)·(p_j − p_i)| over the distance, 0.35 for a corner's mean normal and a side's.
    alike: float = 0.85
    mirrored: float = 0.08
    # Between the normals of patches at one place, which their curvature has turned towards each other.
    agreed: float = 0.9
    # Of a patch's neighbours: how many must agree with it, the second over the first eigenvalue of their spread, and
    # the sum of weights that must be across it. The points along an edge have each other's mean normals: a line is no
    # patch.
    company: int = 4
    wide: float = 0.1
    enough: float = 0.2
    ridge: float = 0.02  # of that fit, in the same units
    # Height of a point over the plane of a patch, over its distance, below which it is in its rim whatever its
    # normal: on a smooth surface normals that are not alike are at heights above a quarter. Such a patch must have so
    # many neighbours of its own in the row, and as many in the rim as another has company.
    rim: float = 0.03
    row: int = 2
    # All in units of the distance to the fourth nearest point: how much patches may differ at a new point, how far
    # one may be beyond another's plane, and how near two must pass to a point of an edge.
    spread: float = 0.05
    beyond: float = 0.03
    through: float = 0.1
    # In those units, how far a new point may be from the weighted mean of the points around it. On the rim of a
    # half-plane that is 1/√π = 0.56, and beyond it more.
    one_sided: float = 0.7
    # Least part of the sphere of directions that a solid, or the space around it, fills at a new point: half of it on
    # a smooth surface, a fourth on the edge of a cube, and next to nothing where guessed normals have led beyond an
    # edge.
    solid_angle: float = 0.2
    # That is asked only where so many of the cloud's own points meet it: an open sheet sees nothing of itself.
    closed: float = 0.95
    asked: int = 4000
    # Radians that the finest level's frequency may turn through between two points. Where four points lie on a wave
    # they hold it down, and nothing is filled in: patches are less exact than the points themselves. Where it turns
    # through k times as much, `filling` (k² − 1) places are tried for each point.
    turn: float = np.pi / 2
    filling: float = 16.0


BETWEEN = BetweenOptions()


class Densified(NamedTuple):
    """What a cloud says of its surface.

    Attributes:
        normals: ``(N, 3)`` of the cloud; those on an edge, which no side has, are one side's.
        repaired: how many of them.
        points: ``(M, 3)`` new points.
        new_normals: ``(M, 3)`` theirs.
    """

    normals: Float64
    repaired: int
    points: Float64
    new_normals: Float64


def dense_distance(
    points: Tensor,
    normals: Tensor,
    *,
    omega: float,
    count: int,
    noise: float = 0.0,
    guessed: bool = False,
    seed: int = 0,
    options: BetweenOptions = BETWEEN,
) -> CloudDistance:
    """Distances to a cloud, and where it is sparse for a network of frequency ``omega``, to what fills it in.

    Args:
        points: ``(N, 3)`` points in the unit sphere.
        normals: ``(N, 3)`` outward unit normals.
        omega: the highest frequency that will be fitted to it.
        count: points of the cloud and places tried between them, all together.
        noise: see `CloudDistance`.
        guessed: see `CloudDistance`.
        seed: of the places.
        options: numbers of the algorithm.
    """
    about = {"noise": noise, "guessed": guessed}
    index = CloudDistance(points, normals, **about)
    wanted = options.filling * np.maximum(index.areas * (omega / options.turn) ** 2 - 1, 0)
    new = min(count - len(points), math.ceil(wanted.sum()))
    if new <= 0:
        return index
    noisy = guessed and noise > 0
    found = densified(index.points, index.normals, new, share=wanted, guessed=noisy, seed=seed, options=options)
    new_points, new_normals = (torch.from_numpy(a.astype(np.float32)) for a in (found.points, found.new_normals))
    if noisy and _on_solid(index, index.points[:: 1 + len(points) // options.asked], options).mean() > options.closed:
        kept = torch.from_numpy(_on_solid(index, new_points.numpy(), options))
        new_points, new_normals = new_points[kept], new_normals[kept]
    own_normals = torch.from_numpy(found.normals.astype(np.float32))
    dense = torch.cat((points.cpu(), new_points)), torch.cat((own_normals, new_normals))
    return CloudDistance(*dense, **about, given=len(points), gaps=index.gaps, repaired=found.repaired)


def _on_solid(index: CloudDistance, x: NDArray[np.float32], options: BetweenOptions) -> Mask:
    """Whether both sides of each of ``(M, 3)`` points of a surface have `solid_angle`, by winding numbers."""
    return np.abs(index.winding_number(x, soft=CLOUD.soft_guessed) - 0.5) < 0.5 - options.solid_angle


def densified(
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    count: int,
    *,
    share: NDArray[np.floating] | None = None,
    guessed: bool = False,
    seed: int = 0,
    options: BetweenOptions = BETWEEN,
) -> Densified:
    """Find points of the surface between those of a cloud.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals.
        count: how many places are tried; most of them become points where the cloud is sound.
        share: ``(N,)`` in proportion to which they are tried beside each point; None for the area of each.
        guessed: whether the normals were estimated from noisy points: those beyond an edge may then not contradict
            what runs on beyond it, and new points must have points on all sides.
        seed: of the places.
        options: numbers of the algorithm.
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
        # In order: neighbours are near in memory.
        parents = np.sort(random.choice(able, count, p=chance / chance.sum()))
        for start in range(0, count, options.block):
            found.append(_placed(patches, parents[start : start + options.block], random, guessed=guessed))
    new = [np.concatenate(columns) for columns in zip(*found, strict=True)]
    return Densified(fixed, repaired, new[0], new[1])


class _Patches:
    """The patch of every point.

    Attributes:
        points: ``(N, 3)``.
        normals: ``(N, 3)``.
        shape: ``(N, 3, 3)`` S_i.
        reach: ``(N,)`` distance to the sixth neighbour.
        sound: ``(N,)`` whether neighbours on all sides agree with it.
    """

    def __init__(self, points: Float64, normals: Float64, options: BetweenOptions) -> None:
        self.options = options
        self.points, self.normals = points, normals
        self.tree = KDTree(points, balanced_tree=False)
        self.shape, self.reach = np.zeros((len(points), 3, 3)), np.zeros(len(points))
        self.sound: Mask = np.zeros(len(points), bool)
        for start in range(0, len(points), self.options.block):
            self._fit(np.arange(start, min(start + self.options.block, len(points))))

    def _fit(self, rows: Rows) -> None:
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
        # A face as narrow as two spacings has one row of points of its own. Those of its edges have the normals of
        # other faces, but lie in its plane, where it is flat up to them.
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

    def _nearest(self, x: Float64, count: int) -> tuple[Float64, Rows]:
        distance, found = self.tree.query(x, count, workers=-1)
        return np.asarray(distance, np.float64), np.asarray(found, np.int64)

    def at(self, x: Float64, count: int) -> tuple[Float64, Rows, Float64, Float64, Float64]:
        """The patches of the nearest points at ``(m, 3)`` places.

        Returns:
            Distances and rows of the points ``(m, k)``, vectors from them ``(m, k, 3)``, and the patches' values
            ``(m, k)`` and unit normals ``(m, k, 3)``.
        """
        distance, found = self._nearest(x, count)
        offset = x[:, None] - self.points[found]
        bent = np.einsum("mkab,mkb->mka", self.shape[found], offset)
        own = self.normals[found]
        value = ((own + 0.5 * bent) * offset).sum(axis=2)
        return distance, found, offset, value, _unit(own + bent)


def _fitted(
    chosen: Mask, near: Float64, across: Float64, turn: Float64, options: BetweenOptions
) -> tuple[Float64, Float64, Mask]:
    """What the shape of patches is solved from, and which have company on all sides.

    Args:
        chosen: ``(n, k)`` which neighbours are asked.
        near: ``(n, k)`` weights by distance.
        across: ``(n, k, 3)`` where they are in the plane.
        turn: ``(n, k, 3)`` how their normals are turned.
        options: numbers of the algorithm.
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

    On an edge is a point through which sound patches of two sides pass, and that is part of no sound one itself.
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


def _placed(patches: _Patches, parents: Rows, random: np.random.Generator, *, guessed: bool) -> tuple[Float64, Float64]:
    """New points and their normals, at most one beside each of ``parents``."""
    normal = patches.normals[parents]
    step = random.normal(size=(len(parents), 3))
    step = _unit(step - (step * normal).sum(axis=1, keepdims=True) * normal)
    step *= (0.8 * patches.reach[parents] * np.sqrt(random.random(len(parents))))[:, None]
    bent = np.einsum("mab,mb->ma", patches.shape[parents], step)
    x = patches.points[parents] + step - 0.5 * (bent * step).sum(axis=1, keepdims=True) * normal
    normal, good = _unit(normal + bent), np.ones(len(parents), bool)
    one_sided = patches.options.one_sided if guessed else np.inf
    for _ in range(2):  # patches are flat across a spacing: the second move is a hundredth of the first
        moved, normal, good = _blended(patches, x, normal, one_sided)
        x = x + moved
    return x[good], normal[good]


def _blended(patches: _Patches, x: Float64, normal: Float64, one_sided: float) -> tuple[Float64, Float64, Mask]:
    """What moves places ``(m, 3)`` onto the blend of patches with their normals; normals there; which are good."""
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
    blend = _unit((weight[..., None] * theirs).sum(axis=1))
    spread = np.sqrt((weight * (value - mean) ** 2).sum(axis=1, keepdims=True))
    # Two points of a surface are both behind or both before the plane of the other, on arcs as on edges.
    above, below = -(offset * blend[:, None]).sum(axis=2), (offset * patches.normals[found]).sum(axis=2)
    beyond = sound & (cosine < options.agreed) & (above * below < 0)
    beyond &= np.minimum(np.abs(above), np.abs(below)) > options.beyond * scale
    middle = np.linalg.norm(np.einsum("mk,mkd->md", weight, offset), axis=1, keepdims=True)
    good = (total > options.enough) & (spread < options.spread * scale) & ~beyond.any(axis=1, keepdims=True)
    good = (good & (middle < one_sided * scale))[:, 0]
    return -mean * blend, blend, good


def _unit(vectors: Float64) -> Float64:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)
