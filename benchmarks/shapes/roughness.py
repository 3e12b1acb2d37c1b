"""Orange peel as figures: how a mesh's normals and heights differ from its reference's at high frequency.

Mean distances hide dimples: the depth of a dimple is small, and the eye sees its slope. So the local means are taken
off the difference of the normals and off the height of the mesh over the reference. The remainders are sorted by place.
On flat places of the reference every wave is an error. Near its sharp edges a surface that was smoothed too much turns
too early.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from mplicits.neural_fields import Mesh, Similarity
from mplicits.pipelines.surface.surface import face_normals, sample_points
from numpy.typing import NDArray
from scipy.spatial import KDTree

Float64 = NDArray[np.float64]

# Samples looked at in a disc of the low-pass: the mean of as many adds a hundredth to what it is taken from.
IN_DISC = 48
# Samples of the mesh that may be the foot of one of the reference.
FEET = 4
# A figure needs as many samples: the 90 % of fewer is that of a handful.
FEWEST = 200


class Roughness(NamedTuple):
    """What a mesh has at high frequency that its reference has not; None where there is no such place.

    Attributes:
        flat_share: share of the reference's area that is flat.
        flat_angle: median angle in degrees between the normals on flat places, their low frequencies taken off.
        flat_angle_90: what nine tenths of those angles are below.
        edge_angle: the median near sharp edges.
        edge_angle_90: what nine tenths of those are below.
        ripple: median height of the waves on flat places, in units of the coordinates.
    """

    flat_share: float
    flat_angle: float | None
    flat_angle_90: float | None
    edge_angle: float | None
    edge_angle_90: float | None
    ripple: float | None


def roughness(
    points: Float64,
    normals: NDArray[np.floating],
    feet: Float64,
    feet_normals: NDArray[np.floating],
    reference: Mesh,
    *,
    reach: float = 0.03,
    radius: float = 0.05,
    flat: float = 5.0,
) -> Roughness:
    """Compare normals and heights at points of a reference with those of a mesh.

    With e = n' − n the difference of the unit normals at a point and h the height of the mesh's tangent plane over it,
    along n, the angle is 2 asin(|e − ē| / 2) and the height |h − h̄|. The bars are means over the reference's points
    within ``radius`` whose normals are less than 30° from its own. A wave much shorter than ``radius`` is not
    changed. One of wavelength λ = 4 radius keeps 0.28 of itself (1 − 2 J₁(k r) / (k r), k = 2π/λ), a longer one less.
    So shapes that are only a little too thick are not rough.

    Args:
        points: ``(N, 3)`` points uniform on the reference.
        normals: ``(N, 3)`` its unit normals there.
        feet: ``(N, 3)`` the nearest points of the mesh; see `feet_among`.
        feet_normals: ``(N, 3)`` its unit normals there, of either sign.
        reference: the mesh that the points are of; its sharp edges are those of `sharp_edge_points`.
        reach: a place is near an edge within this distance of it, and flat if the normals within it are.
        radius: of the low-pass.
        flat: degrees: the largest root mean square angle between the normal of a flat place and those in reach.
    """
    edges = sharp_edge_points(reference, spacing=reach / 4)
    area = float(face_normals(reference)[1].sum())
    wanted = max(FEWEST, int(IN_DISC * area / (math.pi * radius**2)))
    # Samples are in the order of the faces, so that a regular choice of them is spread evenly too.
    chosen = np.linspace(0, len(points) - 1, min(wanted, len(points))).astype(np.int64)
    points, normals = points[chosen], normals[chosen]
    feet, feet_normals = feet[chosen], feet_normals[chosen]
    feet_normals = feet_normals * np.where((feet_normals * normals).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    height = (feet_normals * (feet - points)).sum(axis=1) / np.maximum((feet_normals * normals).sum(axis=1), 0.5)
    both = np.concatenate((feet_normals - normals, height[:, None]), axis=1)

    # Twice as many as on a flat place: folds have more, and the furthest do not count.
    tree, count = KDTree(points, balanced_tree=False), min(2 * IN_DISC, len(points))
    found, index = (np.reshape(a, (len(points), -1)) for a in tree.query(points, count, 0, 2, radius, workers=-1))
    most = int(np.isfinite(found).sum(axis=1).max())
    found, index = found[:, :most], np.minimum(index[:, :most], len(points) - 1)
    cosine = np.einsum("nd,nkd->nk", normals, normals[index])
    alike = (np.isfinite(found) & (cosine > math.cos(math.radians(30)))).astype(np.float64)
    alike[:, 0] = 0  # the point itself
    others = np.maximum(alike.sum(axis=1, keepdims=True), 1)
    rest = both - np.einsum("nk,nkd->nd", alike, both[index]) / others
    angle = np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(rest[:, :3], axis=1) / 2, 1)))

    near = found < reach
    square = (np.arccos(np.clip(cosine, -1, 1)) ** 2 * near).sum(axis=1) / np.maximum(near.sum(axis=1) - 1, 1)
    is_flat = square < math.radians(flat) ** 2
    is_edge = np.zeros(len(points), bool)
    if len(edges):
        is_edge = np.asarray(KDTree(edges).query(points, workers=-1)[0]) < reach
        is_flat &= ~is_edge
    flats, edgy = angle[is_flat], angle[is_edge]
    return Roughness(
        float(is_flat.mean()),
        *_spread(flats),
        *_spread(edgy),
        ripple=float(np.median(np.abs(rest[is_flat, 3]))) if len(flats) >= FEWEST else None,
    )


def surface_roughness(mesh: Mesh, reference: Mesh, *, samples: int, seed: int) -> Roughness:
    """The roughness of a mesh at the samples of the reference that `evaluate_surfaces` draws.

    Args:
        mesh: the surface to judge.
        reference: the truth, a mesh in the same coordinates; its bounding sphere is the unit of length.
        samples: points drawn on each surface.
        seed: of the samples.
    """
    similarity = Similarity.to_unit_sphere(reference.used_vertices())
    mesh, reference = mesh.moved(similarity), reference.moved(similarity)
    of_mesh, of_reference = np.random.default_rng(seed).spawn(2)
    points, normals = sample_points(mesh, samples, of_mesh)
    target, target_normals = sample_points(reference, samples, of_reference)
    assert normals is not None
    assert target_normals is not None
    _, nearest = KDTree(points, balanced_tree=False).query(target, k=min(FEET, len(points)), workers=-1)
    feet = feet_among(target, points, normals, np.asarray(nearest).reshape(len(target), -1))
    return roughness(target, target_normals, points[feet], normals[feet], reference)


def _spread(angles: Float64) -> tuple[float | None, float | None]:
    """Median and 90 % of angles, if there are enough of them."""
    if len(angles) < FEWEST:
        return None, None
    return float(np.median(angles)), float(np.quantile(angles, 0.9))


def feet_among(
    points: Float64, others: Float64, normals: NDArray[np.floating], candidates: NDArray[np.integer]
) -> NDArray[np.int64]:
    """Of a few samples near each point, the one whose tangent plane passes nearest to it.

    Beside an edge the nearest sample of the very same surface is often one of the other face.

    Args:
        points: ``(N, 3)``.
        others: ``(M, 3)`` samples of the other surface.
        normals: ``(M, 3)`` its normals there.
        candidates: ``(N, k)`` rows of ``others``, the nearest first.

    Returns:
        ``(N,)`` rows of ``others``.
    """
    beside = ((points[:, None] - others[candidates]) * normals[candidates]).sum(axis=2)
    chosen: NDArray[np.int64] = candidates[np.arange(len(points)), np.abs(beside).argmin(axis=1)].astype(np.int64)
    return chosen


def sharp_edge_points(surface: Mesh, *, spacing: float, least: float = 30.0) -> Float64:
    """Points ``(E, 3)`` along the edges whose two faces meet at more than ``least`` degrees.

    Args:
        surface: a mesh; equal vertices are made one.
        spacing: between neighbouring points of an edge.
        least: angle between the normals of the two faces.
    """
    whole = surface.merged
    normals, areas = face_normals(whole)
    ends = np.sort(np.concatenate([whole.faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    owner = np.tile(np.arange(len(whole.faces)), 3)[np.tile(areas > 0, 3)]
    ends = ends[np.tile(areas > 0, 3)]
    order = np.lexsort(ends.T)
    ends, owner = ends[order], owner[order]
    # The two faces of an edge stand beside each other now.
    same = (ends[1:] == ends[:-1]).all(axis=1)
    cosine = (normals[owner[1:]] * normals[owner[:-1]]).sum(axis=1)
    sharp = ends[1:][same & (cosine < math.cos(math.radians(least)))]
    start, end = whole.vertices[sharp[:, 0]], whole.vertices[sharp[:, 1]]
    pieces = np.ceil(np.linalg.norm(end - start, axis=1) / spacing).astype(np.int64)
    edge = np.repeat(np.arange(len(sharp)), pieces + 1)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(pieces + 1) - (pieces + 1), pieces + 1)
    along = (step / np.maximum(pieces, 1)[edge])[:, None]
    return start[edge] + along * (end - start)[edge]
