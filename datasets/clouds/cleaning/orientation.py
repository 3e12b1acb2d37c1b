"""Normals of an unoriented cloud: directions by local planes, signs by propagation over a spanning tree.

Directions are those of Hoppe et al., "Surface reconstruction from unorganized points" (SIGGRAPH 1992, section 3.2),
and so is the spanning tree; signs pass along its edges by the reflection rule of König and Gumhold, "Consistent
propagation of normal orientations in point clouds" (VMV 2009), which also gets past sharp edges and thin sheets.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree

__all__ = [
    "estimate_normals",
    "fibonacci_directions",
    "fit_planes",
    "nearest",
    "openness",
    "orient_normals",
    "outwardness",
    "settle_signs",
]

Float64 = NDArray[np.float64]
Index = NDArray[np.int64]

# An offset from the tangent plane within this many standard deviations counts as noise, not shape. Measured: 0 fails
# on clouds with noise (signs of the Armadillo with 1 % noise no better than a coin), 3 on thin parts (Eiffel tower).
_NOISE_WIDTHS = 1.0
# Agreements of neighbours count with this power: at an edge, or across a thin part, they are in doubt.
_POWER = 8


def estimate_normals(points: Float64, neighbors: Index, *, block: int = 65536) -> tuple[Float64, Float64]:
    """Fit a plane to every point's neighbourhood.

    Args:
        points: ``(N, 3)``.
        neighbors: ``(N, k)`` indices of the nearest points, the point itself among them.
        block: rows handled at once, to bound memory.

    Returns:
        Unit normals ``(N, 3)`` of arbitrary sign, and the standard deviation ``(N,)`` from the plane.
    """
    normals, spread = np.empty_like(points), np.empty(len(points))
    for start in range(0, len(points), block):
        near = points[neighbors[start : start + block]]  # (B, k, 3)
        normals[start : start + block], spread[start : start + block] = fit_planes(near)
    return normals, spread


def fit_planes(near: Float64) -> tuple[Float64, Float64]:
    """Unit normals ``(B, 3)`` of the planes through sets of points ``(B, k, 3)``, and the deviations from them."""
    near = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(near.transpose(0, 2, 1) @ near / near.shape[1])  # ascending
    return vectors[:, :, 0], np.sqrt(values[:, 0].clip(min=0))


def orient_normals(points: Float64, normals: Float64, spread: Float64, neighbors: Index) -> tuple[Float64, int]:
    """Give ``normals`` ``(N, 3)`` consistent signs, outward.

    Signs pass along the minimum spanning tree of the neighbour graph with edge weights 1 - |c|, where
    c = ⟨n_i, n_j⟩ - 2⟨e, n_i⟩⟨e, n_j⟩/|e|² compares n_j with n_i reflected to j's side of the edge e. Offsets
    ⟨e, n⟩ within the noise ``spread`` ``(N,)`` count as zero, which leaves Hoppe's 1 - |⟨n_i, n_j⟩|. Then each
    connected piece is turned outward as a whole (see :func:`outwardness`).

    Returns:
        The oriented normals, and the number of connected pieces.
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
    return oriented * _piece_signs(points, oriented, pieces, piece)[piece][:, None], int(pieces)


def settle_signs(
    points: Float64, normals: Float64, evidence: Float64, *, neighbors: int = 12, weight: float = 0.2
) -> Float64:
    """Signs of ``normals`` ``(N, 3)`` that follow evidence where it is strong, and the neighbours where it is weak.

    They are those of the minimum of ``Σ_ij |c_ij|^8 (s_i − sgn(c_ij) s_j)² + λ Σ_i |e_i| (s_i − sgn(e_i))²`` over
    neighbours i and j, c being what `orient_normals` passes signs on by and e the evidence in units of its median: a
    random walk from point to point that ends where evidence is met (Grady, "Random walks for image segmentation",
    2006).

    Args:
        points: ``(N, 3)``.
        normals: ``(N, 3)`` unit normals.
        evidence: ``(N,)`` positive where the normal's sign looks right.
        neighbors: of each point.
        weight: λ.

    Returns:
        ``(N,)`` 1 or −1.
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
    """How far ``normals`` ``(N, 3)`` point out of the body that ``points`` ``(N, 3)`` bound.

    By the divergence theorem the area-weighted normals of a closed surface's part beyond any plane add up to
    the area of the cut, facing away from the body. For each of many directions d the fraction ``cap`` of the
    points that lies furthest along d is such a part; its score is Σ⟨n, d⟩ / Σ|⟨n, d⟩|, in [-1, 1].

    Returns:
        The mean score, and the fraction of directions with a negative one.
    """
    points, normals = points[:: 1 + len(points) // 100_000], normals[:: 1 + len(normals) // 100_000]
    taken = max(1, int(cap * len(points)))
    scores = np.empty(directions)
    for index, direction in enumerate(fibonacci_directions(directions)):
        beyond = np.argpartition(points @ direction, -taken)[-taken:]
        facing = normals[beyond] @ direction
        scores[index] = facing.sum() / max(np.abs(facing).sum(), 1e-300)
    return float(scores.mean()), float((scores < 0).mean())


def openness(points: Float64, normals: Float64, *, neighbors: int = 9) -> float:
    """``|Σ a n| / Σ a``: 0 for a closed surface, 1 for a flat sheet; a hole counts with its area.

    The area a of a point is that of the disc out to its last neighbour, up to a factor.

    Args:
        points: ``(N, 3)``; of more than 50,000 an even selection is used.
        normals: ``(N, 3)``, of unit length.
        neighbors: of each point, itself included.
    """
    points, normals = points[:: 1 + len(points) // 50_000], normals[:: 1 + len(normals) // 50_000]
    last = nearest(points, neighbors)[:, -1]
    area = ((points[last] - points) ** 2).sum(axis=1)
    return float(np.linalg.norm(area @ normals) / area.sum())


def fibonacci_directions(count: int) -> Float64:
    """``count`` unit vectors spread evenly over the sphere, ``(count, 3)``."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z**2)
    return np.stack((ring * np.cos(angle), ring * np.sin(angle), z), axis=1)


def _agreement(points: Float64, normals: Float64, spread: Float64, i: Index, j: Index) -> Float64:
    """⟨n_i, n_j⟩ − 2⟨e, n_i⟩⟨e, n_j⟩/|e|² of pairs of neighbours: 1 if their signs agree on any arc, −1 if not."""
    edge = points[j] - points[i]
    width = _NOISE_WIDTHS * np.maximum(spread[i], spread[j])
    squared = np.maximum((edge**2).sum(axis=1), 1e-300)
    at_i = _shrink((edge * normals[i]).sum(axis=1), width)
    at_j = _shrink((edge * normals[j]).sum(axis=1), width)
    return (normals[i] * normals[j]).sum(axis=1) - 2 * at_i * at_j / squared


def _shrink(offset: Float64, width: Float64) -> Float64:
    return np.sign(offset) * (np.abs(offset) - width).clip(min=0)


def _parents(tree: csr_array, pieces: int, piece: NDArray[np.int32]) -> Index:
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


def _piece_signs(points: Float64, normals: Float64, pieces: int, piece: NDArray[np.int32]) -> Float64:
    """+1 or -1 for each piece ``(pieces,)``."""
    signs = np.ones(pieces)
    order = np.argsort(piece, kind="stable")
    for index, members in enumerate(np.split(order, np.cumsum(np.bincount(piece, minlength=pieces))[:-1])):
        if outwardness(points[members], normals[members])[0] < 0:
            signs[index] = -1
    return signs


def nearest(points: Float64, count: int) -> Index:
    """Indices ``(N, count)`` of each point's nearest points, itself first."""
    _, index = KDTree(points).query(points, k=min(count, len(points)), workers=-1)
    return np.asarray(index, np.int64)
