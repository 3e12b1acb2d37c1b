"""Normals worked out again from oriented ones, on points that are smoothed by and by.

Planes through a few neighbours of a noisy point say little; through many they round off edges and mix up the sides of
thin parts. Once normals have signs, the far side can be left out, and what lies round an edge can count less: each
neighbour weighs as much as its normal is like the point's own (bilateral weights, as in Jones, Durand and Desbrun,
"Non-iterative, feature-preserving mesh smoothing", SIGGRAPH 2003), and the plane through them is fitted anew. In turns
with smoothing along those normals, both get better: points of one layer give better planes, better normals a thinner
layer.

Where faces meet at edges, normals are the same over a face and others beyond: there they are averaged among those that
are nearly their own (Zheng, Fu, Au and Tai, "Bilateral normal filtering for mesh denoising", TVCG 2011), and points
move among still more alike ones. Edges that the first rounds have rounded off come back. On shapes that bend everywhere
it would make facets, so the cloud must look as if it had edges.

Of clouds without noise only the normals are fitted again. The first planes go through all neighbours, round edges and
through both sides of bars; those of like normals leave the other sides out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .noise import noise_level, smooth_along_normals, thick_of_estimated

__all__ = ["denoise", "filter_normals", "has_edges", "refit_normals", "sharper_normals"]

Float64 = NDArray[np.float64]
Rows = NDArray[np.integer]


@dataclass(frozen=True)
class RefitOptions:
    """Normals fitted again. Cosines are between normals; distances in standard deviations of the noise."""

    block: int = 1 << 13  # points fitted at once, to bound memory
    neighbors: int = 64
    alike: float = 0.3  # smallest cosine that counts
    rounds: int = 2
    reach: float = 9.0  # of a plane; a shorter one is tilted more by noise than by bends
    # Smallest cosines where there are edges: for the first planes, for points that move each other, for planes after.
    alike_at_first: float = 0.6
    alike_moved: float = 0.9
    alike_after: float = 0.8
    edge_rounds: int = 3
    turn: float = 0.2  # radians: width of the filter over angles between normals
    filtered: int = 32  # neighbours that the filter averages
    passes: int = 3
    edged: float = 4.0  # 90 % quantile over median of angles to neighbours: 2.3 on smooth shapes, 5 with edges
    asked: int = 3000  # points that are asked for that
    sharper: float = 0.8  # disagreement of neighbours that must be left at most: 0.4 to 0.8 without noise, 0.9 with
    few: int = 16  # neighbours of the finest planes


REFIT = RefitOptions()


def denoise(points: Float64, normals: Float64, *, rounds: int = REFIT.rounds) -> tuple[Float64, Float64, float]:
    """Points and normals that agree with each other, of noisy ones with signs.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals of the noisy points, on the right side for the most part.
        rounds: how often normals are fitted and points are moved; `edge_rounds` times more where there are edges (see
            `has_edges`), with filtered normals.

    Returns:
        The points, moved along the last normals ``(N, 3)``, unit normals ``(N, 3)``, and the noise's standard
        deviation; where there is none, the points as they were, `sharper_normals`, and 0.
    """
    thick = thick_of_estimated(len(points))
    level = noise_level(points, normals, thick=thick)
    if not level:
        return points, sharper_normals(points, normals), 0.0
    reach = REFIT.reach * level
    for _ in range(rounds):
        normals = refit_normals(smooth_along_normals(points, normals, level), normals, reach)
        level = noise_level(points, normals, thick=thick) or level
    moved = smooth_along_normals(points, normals, level)
    tree = KDTree(moved)
    fitted = refit_normals(moved, normals, reach, tree=tree)
    if not has_edges(moved, fitted, tree=tree):
        return moved, fitted, level
    fitted = refit_normals(moved, fitted, reach, alike=REFIT.alike_at_first, tree=tree)
    for _ in range(REFIT.edge_rounds):
        normals = filter_normals(moved, fitted, tree=tree)
        level = noise_level(points, normals, thick=thick) or level
        moved = smooth_along_normals(points, normals, level, alike=REFIT.alike_moved)
        tree = KDTree(moved)
        fitted = refit_normals(moved, normals, reach, alike=REFIT.alike_after, tree=tree)
    return moved, filter_normals(moved, fitted, tree=tree), level


def sharper_normals(points: Float64, normals: Float64) -> Float64:
    """Normals fitted again to a few neighbours with like normals, or as they were, if that is no better.

    Two points of an arc of a circle, with its normals, satisfy ``(n_i + n_j)·(p_j − p_i) = 0``. What neighbours leave
    of that, in units of their distance and in the mean, must become less by a fifth.

    Args:
        points: ``(N, 3)``, around the origin, without noise or nearly so.
        normals: ``(N, 3)`` unit normals, on the right side for the most part.

    Returns:
        ``(N, 3)``.
    """
    tree, fitted = KDTree(points), normals
    for _ in range(REFIT.rounds):
        fitted = refit_normals(points, fitted, 0.0, neighbors=REFIT.few, tree=tree)
    before, after = (_disagreement(points, each, tree) for each in (normals, fitted))
    return fitted if after < REFIT.sharper * before else normals


def _disagreement(points: Float64, normals: Float64, tree: KDTree) -> float:
    """The mean of |½(n_i + n_j)·(p_j − p_i)| / |p_j − p_i| over the eight nearest neighbours of some points."""
    asked = np.random.default_rng(0).permutation(len(points))[: REFIT.asked]
    found = tree.query(points[asked], k=min(9, len(points)), workers=-1)
    distance, near = np.asarray(found[0])[:, 1:], np.asarray(found[1])[:, 1:]
    offset = points[near] - points[asked][:, None]
    product = np.einsum("mkd,mkd->mk", offset, normals[near] + normals[asked][:, None]) / 2
    return float((np.abs(product) / np.maximum(distance, 1e-300)).mean())


def has_edges(points: Float64, normals: Float64, *, seed: int = 0, tree: KDTree | None = None) -> bool:
    """Whether normals turn at few places by much, as at the edges between faces, and not everywhere by some.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals.
        seed: of the points that are asked.
        tree: of the points; None to build it.
    """
    asked = np.random.default_rng(seed).permutation(len(points))[: REFIT.asked]
    tree = tree or KDTree(points)
    near = np.asarray(tree.query(points[asked], k=min(9, len(points)), workers=-1)[1])[:, 1:]
    cosine = np.einsum("md,mkd->mk", normals[asked], normals[near])
    angle = np.arccos(cosine.clip(-1, 1)).mean(axis=1)
    usual, large = np.quantile(angle, (0.5, 0.9))
    return bool(large > REFIT.edged * usual)


def filter_normals(
    points: Float64,
    normals: Float64,
    *,
    turn: float = REFIT.turn,
    passes: int = REFIT.passes,
    tree: KDTree | None = None,
) -> Float64:
    """Unit means of normals over neighbours, those counting most that are near and nearly the same.

    Weights are ``(1 − d²/r²)² exp(−(1 − c)/turn²)``, d being the distance, r that of the last of `filtered` nearest
    points, c the cosine between the normals, for which ``1 − c ≈ angle²/2``.

    Args:
        points: ``(N, 3)``, around the origin.
        normals: ``(N, 3)`` unit normals.
        turn: in radians.
        passes: how often.
        tree: of the points; None to build it.

    Returns:
        ``(N, 3)``.
    """
    found = (tree or KDTree(points)).query(points, k=min(REFIT.filtered, len(points)), workers=-1)
    distance, near = np.asarray(found[0]), np.asarray(found[1])
    beside = (1 - (distance / (distance[:, -1:] * 1.001)) ** 2) ** 2
    for _ in range(passes):
        mean = np.empty_like(normals)
        for part in np.array_split(np.arange(len(points)), -(-len(points) // REFIT.block)):
            theirs = normals[near[part]]
            cosine = np.einsum("md,mkd->mk", normals[part], theirs)
            mean[part] = np.einsum("mk,mkd->md", beside[part] * np.exp((cosine - 1) / turn**2), theirs)
        normals = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    return normals


def refit_normals(
    points: Float64,
    normals: Float64,
    reach: float,
    *,
    neighbors: int = REFIT.neighbors,
    alike: float = REFIT.alike,
    rows: Rows | None = None,
    among: Rows | None = None,
    tree: KDTree | None = None,
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
        alike: c₀, smallest cosine between normals that count.
        rows: ``(m,)`` points whose normals are wanted; None for all.
        among: ``(n,)`` points that planes are fitted to; None for all. A point without a like one keeps its normal.
        tree: of the points that planes are fitted to; None to build it.

    Returns:
        ``(m, 3)`` unit normals.
    """
    asked = np.arange(len(points)) if rows is None else rows
    others = np.arange(len(points)) if among is None else among
    count = min(neighbors, len(others))
    tree, fitted = tree or KDTree(points[others]), np.empty((len(asked), 3))
    for part in np.array_split(np.arange(len(asked)), -(-len(asked) // REFIT.block)):
        here = asked[part]
        found = tree.query(points[here], k=count, workers=-1)
        distance, near = np.asarray(found[0]), others[np.asarray(found[1])]
        radius = np.clip(reach, distance[:, min(16, count - 1)], distance[:, -1] * 1.001)[:, None]
        cosine = np.einsum("md,mkd->mk", normals[here], normals[near])
        likeness = ((cosine - alike) / (1 - alike)).clip(min=0)
        weight = (1 - (distance / radius) ** 2).clip(min=0) ** 2 * likeness**2
        offset = points[near] - points[here][:, None]
        total = weight.sum(axis=1)[:, None]
        offset -= (np.einsum("mk,mkd->md", weight, offset) / np.maximum(total, 1e-300))[:, None]
        weighted = offset * weight[:, :, None]
        normal = np.linalg.eigh(weighted.transpose(0, 2, 1) @ offset)[1][:, :, 0]
        turned = np.einsum("md,md->m", normal, normals[here]) < 0
        normal = np.where(turned[:, None], -normal, normal)
        fitted[part] = np.where(total > 0, normal, normals[here])
    return fitted
