"""Normals of unoriented clouds by planes (Hoppe et al., SIGGRAPH 1992) and signs, and the space outside a cloud."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree

from ..point_cloud import Float64, Int64

# An offset from the tangent plane within this many standard deviations counts as noise, not shape. Measured: 0 fails
# on clouds with noise (half of the signs of the Armadillo with 1 % noise are wrong), 3 on thin parts (Eiffel tower).
_NOISE_WIDTHS = 1.0
_POWER = 8  # of the agreement of neighbours: at an edge, or across a thin part, it is uncertain
_BLOCK = 1 << 16  # points handled at once, to bound memory

OUTER_REGION = 1  # number of the region that contains infinity, see `Exterior`


@dataclass(frozen=True)
class ExteriorOptions:
    """The grid around a cloud in the unit sphere; lengths in spacings of the points."""

    resolution: int = 128  # cells along an edge
    half: float = 1.15  # half edge of the grid, in radii of the sphere
    wall: float = 1.5  # largest distance from a point to a cell of the surface
    gate: float = 2.5  # half width of a gap that joins two regions; one uniform point in e^(π r²) has such a gap
    neighbors: int = 8  # from whose distances the spacing at a point follows
    fewest: int = 500  # cells of a region


EXTERIOR = ExteriorOptions()


def query(tree: KDTree, places: Float64, count: int, *, within: float = np.inf) -> tuple[Float64, Int64]:
    """Distances ``(M, k)`` from places ``(M, 3)`` to their k nearest points of a tree, ascending, and their indices.

    k is ``count``, or the number of points if that is less. Beyond ``within``, the distance is inf and the index N.
    """
    ranks: Any = np.arange(1, min(count, tree.n) + 1)  # unlike a number, they give two axes even for one neighbour
    distance, index = tree.query(places, k=ranks, distance_upper_bound=within, workers=-1)
    return np.asarray(distance), np.asarray(index, np.int64)


def nearest(points: Float64, count: int) -> Int64:
    """Indices ``(N, count)`` of each point's nearest points, itself first."""
    return query(KDTree(points), points, count)[1]


def blocks(rows: Int64, size: int) -> Iterator[Int64]:
    """Consecutive parts of ``rows``, of ``size`` at most, to bound memory."""
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


def estimate_normals(points: Float64, neighbors: Int64) -> tuple[Float64, Float64]:
    """Unit normals ``(N, 3)`` of any sign and deviations ``(N,)`` of planes through neighbourhoods ``(N, k)``."""
    normals, spread = np.empty_like(points), np.empty(len(points))
    for part in blocks(np.arange(len(points)), _BLOCK):
        normals[part], spread[part] = fit_planes(points[neighbors[part]])
    return normals, spread


def fit_planes(near: Float64) -> tuple[Float64, Float64]:
    """Unit normals ``(B, 3)`` of the planes through sets of points ``(B, k, 3)``, and standard deviations ``(B,)``."""
    near = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(near.transpose(0, 2, 1) @ near / near.shape[1])  # ascending
    return vectors[:, :, 0], np.sqrt(values[:, 0].clip(min=0))


def orient_normals(points: Float64, normals: Float64, spread: Float64, neighbors: Int64) -> tuple[Float64, int]:
    """``normals`` ``(N, 3)`` with consistent outward signs, and the number of connected pieces.

    Signs pass along the minimum spanning tree of edge weights 1 − |c|, with c of `_agreement`. It holds at sharp edges
    and in thin sheets (König and Gumhold, "Consistent propagation of normal orientations in point clouds", VMV 2009).
    Offsets within the noise ``spread`` ``(N,)`` count as zero. Pieces are turned by `outwardness`.
    """
    count, k = neighbors.shape
    rows, columns = np.repeat(np.arange(count), k - 1), neighbors[:, 1:].ravel()
    agreement = _agreement(points, normals, spread, rows, columns)
    # + 1e-6: a weight of zero would mean "no edge" to scipy
    weights = 1 - np.abs(agreement).clip(max=1) + 1e-6
    tree = minimum_spanning_tree(csr_array((weights, (rows, columns)), shape=(count, count)))
    pieces, piece = connected_components(tree, directed=False)
    parent = _parents(tree, pieces, piece)
    sign = np.where(_agreement(points, normals, spread, parent, np.arange(count)) < 0, -1.0, 1.0)
    sign[parent == np.arange(count)] = 1.0
    while True:  # pointer jumping: after m rounds `parent` is 2^m steps up and `sign` the product on the way
        grandparent = parent[parent]
        if bool((grandparent == parent).all()):
            break
        sign, parent = sign * sign[parent], grandparent
    oriented = normals * sign[:, None]
    order = np.argsort(piece, kind="stable")
    for members in np.split(order, np.cumsum(np.bincount(piece, minlength=pieces))[:-1]):
        if outwardness(points[members], oriented[members])[0] < 0:
            oriented[members] *= -1
    return oriented, int(pieces)


def solve_signs(
    points: Float64, normals: Float64, evidence: Float64, *, neighbors: int = 12, weight: float = 0.2
) -> Float64:
    """Signs ±1 ``(N,)`` of normals from evidence ``(N,)``, positive for the present sign; neighbours decide weak cases.

    Minimises ``Σ_ij |c_ij|^8 (s_i − sgn(c_ij) s_j)² + λ Σ_i |e_i| (s_i − sgn(e_i))²``, with c of `_agreement`, λ =
    ``weight`` and e in units of its median (Grady, "Random walks for image segmentation", 2006).
    """
    count, size = len(points), min(neighbors + 1, len(points))
    near = nearest(points, size)
    spread = estimate_normals(points, near)[1]
    rows, columns = np.repeat(np.arange(count), size - 1), near[:, 1:].ravel()
    agreement = _agreement(points, normals, spread, rows, columns).clip(-1, 1)
    links = csr_array((np.sign(agreement) * agreement**_POWER, (rows, columns)), shape=(count, count))
    links = (links + links.T) / 2
    held = weight * np.clip(np.abs(evidence) / max(float(np.median(np.abs(evidence))), 1e-30), 0, 1) + 1e-9
    total = np.asarray(abs(links).sum(axis=1)).ravel() + held
    signs = cg((diags_array(total) - links).tocsr(), held * np.sign(evidence), rtol=1e-4, maxiter=500)[0]
    return np.where(signs < 0, -1.0, 1.0)


def outwardness(points: Float64, normals: Float64, *, directions: int = 64, cap: float = 0.1) -> tuple[float, float]:
    """Mean over directions d of Σ⟨n, d⟩ / Σ|⟨n, d⟩|, in [-1, 1], and the fraction of negative ones.

    Sums are over the fraction ``cap`` of the points furthest along d. By the divergence theorem the outward normals of
    such a part of a closed surface add up to a positive multiple of d.
    """
    points, normals = points[:: 1 + len(points) // 100_000], normals[:: 1 + len(normals) // 100_000]
    taken = max(1, int(cap * len(points)))
    scores = np.empty(directions)
    for index, direction in enumerate(fibonacci_directions(directions)):
        facing = normals[np.argpartition(points @ direction, -taken)[-taken:]] @ direction
        scores[index] = facing.sum() / max(np.abs(facing).sum(), 1e-300)
    return float(scores.mean()), float((scores < 0).mean())


def openness(points: Float64, normals: Float64) -> float:
    """``|Σ a n| / Σ a``: 0 for a closed surface, 1 for a flat sheet; a hole counts with its area.

    The area a of a point is that of the disc out to its eighth neighbour, up to a factor.
    """
    points, normals = points[:: 1 + len(points) // 50_000], normals[:: 1 + len(normals) // 50_000]
    last = nearest(points, 9)[:, -1]
    area = ((points[last] - points) ** 2).sum(axis=1)
    return float(np.linalg.norm(area @ normals) / area.sum())


def fibonacci_directions(count: int) -> Float64:
    """``count`` unit vectors spread evenly over the sphere, ``(count, 3)``."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z**2)
    return np.stack((ring * np.cos(angle), ring * np.sin(angle), z), axis=1)


def _agreement(points: Float64, normals: Float64, spread: Float64, i: Int64, j: Int64) -> Float64:
    """⟨n_i, n_j⟩ − 2⟨e, n_i⟩⟨e, n_j⟩/|e|² of pairs of neighbours: 1 if their signs agree on any arc, −1 if not."""
    edge = points[j] - points[i]
    width = _NOISE_WIDTHS * np.maximum(spread[i], spread[j])
    squared = np.maximum((edge**2).sum(axis=1), 1e-300)
    at_i = _shrink((edge * normals[i]).sum(axis=1), width)
    at_j = _shrink((edge * normals[j]).sum(axis=1), width)
    return (normals[i] * normals[j]).sum(axis=1) - 2 * at_i * at_j / squared


def _shrink(offset: Float64, width: Float64) -> Float64:
    return np.sign(offset) * (np.abs(offset) - width).clip(min=0)


def _parents(tree: csr_array, pieces: int, piece: NDArray[np.int32]) -> Int64:
    """Each point's parent ``(N,)`` in the forest ``tree``; a root is its own parent."""
    count = len(piece)
    roots = np.unique(piece, return_index=True)[1]
    links = tree.tocoo()
    # one further node above all roots, so that a single search reaches every piece
    rows = np.concatenate((links.row, np.full(pieces, count)))
    columns = np.concatenate((links.col, roots))
    joined = csr_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count + 1, count + 1))
    above = breadth_first_order(joined, count, directed=False)[1][:count].astype(np.int64)
    return np.where(above == count, np.arange(count), above)


class Exterior:
    """Connected regions of the space around a cloud ``(N, 3)`` in the unit sphere, on a grid; normals are not used.

    Cells within `wall` spacings of a point are the surface; `count` others are regions of `fewest` cells or more. A
    hole of the scan that is wider than the gate joins the inside to the outside.
    """

    def __init__(self, points: Float64) -> None:
        resolution = EXTERIOR.resolution
        self.cell = 2 * EXTERIOR.half / resolution
        distance, near = query(KDTree(points), points, EXTERIOR.neighbors + 1)
        reach = distance[:, -1][near].max(axis=1)  # a point beside a gap takes the spacing of its neighbours
        spacing = np.maximum(np.sqrt(np.pi / EXTERIOR.neighbors) * reach, self.cell / np.sqrt(3))
        where, widest = self._cells(points), np.zeros((resolution,) * 3)
        np.maximum.at(widest, tuple(where.T), spacing)
        apart, closest = _distances(widest > 0)
        apart *= self.cell / widest[closest]
        label: Any = ndimage.label(apart > EXTERIOR.gate)
        label = np.asarray(label[0])
        beside, closest = _distances(label > 0)
        grown = (apart > EXTERIOR.wall) & (beside * self.cell <= (EXTERIOR.gate - EXTERIOR.wall) * widest.max())
        label = np.where(grown, label[closest], label)
        size = np.bincount(label.ravel())
        size[[0, label[0, 0, 0]]] = 0
        kept = [int(label[0, 0, 0]), *np.argsort(-size)[: int((size >= EXTERIOR.fewest).sum())].tolist()]
        names = np.zeros(len(size), np.int64)
        names[kept] = OUTER_REGION + np.arange(len(kept))
        self.count = len(kept)
        self._region = names[label]

    def regions(self, x: Float64) -> Int64:
        """The region of each of ``(M, 3)`` places: 0 near the cloud's points, `OUTER_REGION`, or more if enclosed."""
        return self._region[tuple(self._cells(x).T)]

    def _cells(self, x: Float64) -> Int64:
        return np.floor((x + EXTERIOR.half) / self.cell).astype(np.int64).clip(0, EXTERIOR.resolution - 1)


def _distances(there: NDArray[np.bool_]) -> tuple[Float64, tuple[Int64, ...]]:
    """For each cell the distance, in cells, to the nearest that is ``there``, and the indices of that."""
    found: Any = ndimage.distance_transform_edt(~there, return_indices=True)
    return found[0], tuple(found[1])
