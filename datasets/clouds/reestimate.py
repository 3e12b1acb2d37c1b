"""Normals worked out again from oriented ones, on points that are smoothed by and by.

Planes through a few neighbours of a noisy point say little; through many they round off edges and mix up the sides of
thin parts. Once normals have signs, the far side can be left out, and what lies round an edge can count less: each
neighbour weighs as much as its normal is like the point's own (bilateral weights, as in Jones, Durand and Desbrun,
"Non-iterative, feature-preserving mesh smoothing", SIGGRAPH 2003), and the plane through them is fitted anew. In turns
with smoothing along those normals, both get better: points of one layer give better planes, better normals a thinner
layer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .noise import noise_level, smooth_along_normals

__all__ = ["denoise", "refit_normals"]

Float64 = NDArray[np.float64]
Rows = NDArray[np.integer]

BLOCK = 1 << 13  # points fitted at once, to bound memory
NEIGHBORS = 64
ALIKE = 0.3  # smallest cosine between normals that count
ROUNDS = 2
REACH = 3.0  # of the neighbours that a plane is fitted to, in standard deviations of the noise


def denoise(points: Float64, normals: Float64, *, rounds: int = ROUNDS) -> tuple[Float64, Float64, float]:
    """Points and normals that agree with each other, of noisy ones with signs.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals of the noisy points, on the right side for the most part.
        rounds: how often normals are fitted and points are moved.

    Returns:
        The points, moved along the last normals ``(N, 3)``, unit normals ``(N, 3)``, and the noise's standard
        deviation; all as they were and 0 where there is none.
    """
    level = noise_level(points, normals)
    if not level:
        return points, normals, 0.0
    reach = REACH * level
    for _ in range(rounds):
        normals = refit_normals(smooth_along_normals(points, normals, level), normals, reach)
        level = noise_level(points, normals) or level
    moved = smooth_along_normals(points, normals, level)
    return moved, refit_normals(moved, normals, reach), level


def refit_normals(
    points: Float64,
    normals: Float64,
    reach: float,
    *,
    neighbors: int = NEIGHBORS,
    rows: Rows | None = None,
    among: Rows | None = None,
) -> Float64:
    """Normals of planes through neighbours with like normals.

    Weights are ``(1 − d²/r²)² max(0, (c − c₀)/(1 − c₀))²``, d being the distance, c the cosine between the normals, r
    the distance to the last of ``neighbors`` nearest points, but no more than ``reach`` unless fewer than 16 are
    within.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals, whose signs the new ones keep.
        reach: in the units of the points.
        neighbors: nearest points that are asked.
        rows: ``(m,)`` points whose normals are wanted; None for all.
        among: ``(n,)`` points that planes are fitted to; None for all. A point without a like one keeps its normal.

    Returns:
        ``(m, 3)`` unit normals.
    """
    asked = np.arange(len(points)) if rows is None else rows
    others = np.arange(len(points)) if among is None else among
    count = min(neighbors, len(others))
    tree, fitted = KDTree(points[others]), np.empty((len(asked), 3))
    for part in np.array_split(np.arange(len(asked)), -(-len(asked) // BLOCK)):
        here = asked[part]
        found = tree.query(points[here], k=count, workers=-1)
        distance, near = np.asarray(found[0]), others[np.asarray(found[1])]
        radius = np.clip(reach, distance[:, min(16, count - 1)], distance[:, -1] * 1.001)[:, None]
        cosine = np.einsum("md,mkd->mk", normals[here], normals[near])
        alike = ((cosine - ALIKE) / (1 - ALIKE)).clip(min=0)
        weight = (1 - (distance / radius) ** 2).clip(min=0) ** 2 * alike**2
        offset = points[near] - points[here][:, None]
        total = weight.sum(axis=1)[:, None]
        offset -= (np.einsum("mk,mkd->md", weight, offset) / np.maximum(total, 1e-300))[:, None]
        weighted = offset * weight[:, :, None]
        normal = np.linalg.eigh(weighted.transpose(0, 2, 1) @ offset)[1][:, :, 0]
        turned = np.einsum("md,md->m", normal, normals[here]) < 0
        normal = np.where(turned[:, None], -normal, normal)
        fitted[part] = np.where(total > 0, normal, normals[here])
    return fitted
