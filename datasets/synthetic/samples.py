"""Exact points of the zero set of a smooth field: sampled evenly, projected, closest; and damage to such clouds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import Field, Similarity
from ..clouds.point_cloud import PointCloud, unit_rows

__all__ = [
    "add_isotropic_noise",
    "add_noise",
    "add_outliers",
    "distinct_starts",
    "feet_and_normals",
    "jet_at",
    "refine_closest",
    "sample_sphere",
    "sample_surface",
    "sample_torus",
]

Float64 = NDArray[np.float64]


def sample_surface(
    field: Field,
    count: int,
    *,
    seed: int = 0,
    shell: float = 0.01,
    extent: float = 1.0,
    steepness: float = 2.0,
    block: int = 131072,
) -> PointCloud:
    """Sample ``count`` points of a field's zero set, evenly by area, with exact normals.

    Points uniform in the shell |f| < ``shell``·|∇f| are projected on the surface. A shell of half-width h holds
    2h(1 + K h²/3) of volume per area, K being the Gaussian curvature (Steiner's formula), so the
    density is even to within K h²/3: 0.3 % where both radii of curvature are 0.1 and h is 0.01.

    Args:
        field: any field of three dimensions; its finest level is sampled.
        count: how many points.
        seed: of the random numbers.
        shell: half-width h, in the field's units.
        extent: points are looked for in the cube [-extent, extent]³.
        steepness: a bound of |∇f| near the surface; it lets empty space be skipped.
        block: candidates drawn at once.

    Raises:
        ValueError: there is no surface in the cube.

    Example:
        >>> from mplicits.neural_fields import Torus
        >>> sample_surface(Torus(), 1000, seed=1).points.shape
        (1000, 3)
    """
    random = np.random.default_rng(seed)
    corners, size = _occupied_cells(field, extent, shell, steepness)
    found: list[Float64] = []
    normals: list[Float64] = []
    total = barren = 0
    while total < count:
        if len(corners) == 0 or barren == 16:
            raise ValueError(f"field: no zero set in the cube of half-size {extent}")
        candidates = corners[random.integers(0, len(corners), block)] + size * random.uniform(0, 1, (block, 3))
        value, gradient = jet_at(field, candidates)
        candidates = candidates[np.abs(value) < shell * np.linalg.norm(gradient, axis=1)]
        points, directions, converged = feet_and_normals(field, candidates)
        # a first-order distance can be far off where the gradient is small
        converged &= np.linalg.norm(points - candidates, axis=1) < 3 * shell
        found.append(points[converged])
        normals.append(directions[converged])
        total += int(converged.sum())
        barren = 0 if bool(converged.any()) else barren + 1
    points, directions = np.concatenate(found)[:count], np.concatenate(normals)[:count]
    return PointCloud(points, directions.astype(np.float32), None, f"sample of {type(field).__name__}")


def feet_and_normals(
    field: Field, points: Float64, *, tolerance: float = 1e-9, steps: int = 20
) -> tuple[Float64, Float64, NDArray[np.bool_]]:
    """Move ``points`` ``(N, 3)`` on the zero set by Newton's method along the gradient, x ← x - f ∇f / |∇f|².

    `neural_fields.project_to_surface` does so for fields that are only nearly distances, with steps that it bounds
    where they are flat; exact clouds come from full steps in float64, and keep the normals of the last one.

    Returns:
        The points, unit normals there ``(N, 3)``, and whether |f| got below ``tolerance`` ``(N,)``.
    """
    points, normals = points.copy(), np.zeros_like(points)
    converged = np.zeros(len(points), bool)
    active = np.arange(len(points))
    for _ in range(steps):
        value, gradient = jet_at(field, points[active])
        length = np.linalg.norm(gradient, axis=1)
        normals[active] = gradient / np.maximum(length, 1e-300)[:, None]
        converged[active] = (np.abs(value) < tolerance) & (length > 1e-6)
        active, moving = active[~converged[active]], ~converged[active]
        if len(active) == 0:
            break
        points[active] -= (value / np.maximum(length, 1e-6))[moving, None] * normals[active]
    return points, normals, converged


def sample_sphere(count: int, *, radius: float = 0.5, seed: int = 0) -> PointCloud:
    """``count`` points exactly even on the sphere around the origin, with exact normals.

    Example:
        >>> bool(abs((sample_sphere(100).points ** 2).sum(axis=1) - 0.25).max() < 1e-12)
        True
    """
    normals = _directions(np.random.default_rng(seed), count)
    return PointCloud(radius * normals, normals.astype(np.float32), None, "sphere")


def sample_torus(count: int, *, major: float = 0.5, minor: float = 0.2, seed: int = 0) -> PointCloud:
    """``count`` points exactly even on the torus around the z axis, with exact normals.

    The angle around the tube has density ∝ major + minor·cos(angle); it is drawn by rejection.
    """
    random = np.random.default_rng(seed)
    angles = np.empty(0)
    while len(angles) < count:
        drawn = random.uniform(0, 2 * np.pi, 2 * count)
        accepted = random.uniform(0, major + minor, 2 * count) < major + minor * np.cos(drawn)
        angles = np.concatenate((angles, drawn[accepted]))
    tube, around = angles[:count], random.uniform(0, 2 * np.pi, count)
    radial = np.stack((np.cos(around), np.sin(around), np.zeros(count)), axis=1)
    normals = np.cos(tube)[:, None] * radial + np.sin(tube)[:, None] * np.array([0.0, 0.0, 1.0])
    return PointCloud(major * radial + minor * normals, normals.astype(np.float32), None, "torus")


def add_noise(cloud: PointCloud, amplitude: float, *, seed: int = 0) -> PointCloud:
    """Move points along their normals by U(-1, 1)·``amplitude``·(diagonal of the bounding box); normals stay.

    The paper's noise is ``amplitude=0.01``.

    Raises:
        ValueError: the cloud has no normals, or ``amplitude`` is negative.
    """
    if cloud.normals is None:
        raise ValueError(f"cloud={cloud.source!r} has no normals to move its points along; prepare it first")
    if not amplitude >= 0:
        raise ValueError(f"amplitude={amplitude}: expected a fraction of the diagonal, 0 or more")
    diagonal = float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    shift = np.random.default_rng(seed).uniform(-1, 1, (len(cloud), 1)) * amplitude * diagonal
    return replace(cloud, points=cloud.points + shift * unit_rows(cloud.normals))


def add_isotropic_noise(cloud: PointCloud, amplitude: float, *, seed: int = 0) -> PointCloud:
    """Move points by N(0, σ²) in each coordinate, σ = ``amplitude``·(diagonal of the bounding box)/√3; normals stay.

    Along any direction that is as strong as `add_noise` of the same ``amplitude`` is along the normals.

    Raises:
        ValueError: ``amplitude`` is negative.

    Example:
        >>> cloud = sample_sphere(10_000)  # a diagonal of √3
        >>> bool(abs((add_isotropic_noise(cloud, 0.01).points - cloud.points).std() - 0.01) < 5e-4)
        True
    """
    if not amplitude >= 0:
        raise ValueError(f"amplitude={amplitude}: expected a fraction of the diagonal, 0 or more")
    sigma = amplitude * float(np.linalg.norm(np.ptp(cloud.points, axis=0))) / 3**0.5
    shift = np.random.default_rng(seed).normal(0, sigma, cloud.points.shape)
    return replace(cloud, points=cloud.points + shift)


def add_outliers(cloud: PointCloud, fraction: float, *, seed: int = 0) -> PointCloud:
    """Append ``fraction``·N points uniform in the ball around the cloud, with random normals and colours.

    The paper's outliers are ``fraction=0.001`` and ``0.01``.

    Raises:
        ValueError: ``fraction`` is negative.
    """
    if not fraction >= 0:
        raise ValueError(f"fraction={fraction}: expected 0 or more")
    random = np.random.default_rng(seed)
    count = round(fraction * len(cloud))
    radius = random.uniform(0, 1, (count, 1)) ** (1 / 3)
    points = Similarity.to_unit_sphere(cloud.points).to_input(radius * _directions(random, count))
    normals = _directions(random, count).astype(np.float32)
    colors = random.uniform(0, 1, (count, 3)).astype(np.float32)
    return replace(
        cloud,
        points=np.concatenate((cloud.points, points)),
        normals=None if cloud.normals is None else np.concatenate((cloud.normals, normals)),
        colors=None if cloud.colors is None else np.concatenate((cloud.colors, colors)),
    )


def _directions(random: np.random.Generator, count: int) -> Float64:
    """Unit vectors ``(count, 3)``, uniform on the sphere."""
    vectors = random.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _occupied_cells(
    field: Field, extent: float, shell: float, steepness: float, *, cells: int = 48
) -> tuple[Float64, float]:
    """Lower corners ``(M, 3)`` of the cells of a regular grid that the shell may cross, and the cells' size."""
    size = 2 * extent / cells
    axis = -extent + size * np.arange(cells, dtype=np.float64)
    corners: Float64 = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    value, _ = jet_at(field, corners + size / 2)
    return corners[np.abs(value) < steepness * (np.sqrt(3) / 2 * size + shell)], size


def jet_at(field: Field, points: Float64) -> tuple[Float64, Float64]:
    """Values ``(N,)`` and gradients ``(N, 3)`` of a field at points ``(N, 3)``, worked out in float64."""
    with torch.no_grad():
        jet = field.jet(torch.from_numpy(points))
    return jet.value.double().numpy(), jet.gradient.double().numpy()


def refine_closest(
    field: Field, targets: Float64, starts: Float64, *, steps: int = 60, tolerance: float = 1e-10
) -> Float64:
    """Distance ``(M,)`` from each target to the surface point closest to it near its start.

    Minimises |x - q|²/2 over the surface by projected gradient descent: q moves by ``rate`` times the tangential
    part of x - q and back onto the surface. The rate is that of Barzilai and Borwein (IMA J. Numer. Anal., 1988),
    ⟨s, s⟩/⟨s, y⟩ with s the last move and y the change of the gradient over it, so that no curvature need be
    known. A move that does not shorten |x - q| is undone, and its rate cut to a quarter.

    Args:
        field: the surface is its zero set.
        targets: ``(M, 3)`` points x.
        starts: ``(M, 3)`` points near the surface, closer to the foot sought than to any other.
        steps: at most.
        tolerance: stop where a move gains less than about this, in the field's units.
    """
    foot, normal, _ = feet_and_normals(field, starts)
    best = np.linalg.norm(targets - foot, axis=1)
    tangential = _tangential(targets - foot, normal)
    rate = np.ones(len(targets))
    active = np.arange(len(targets))
    for _ in range(steps):
        gain = rate[active] * (tangential[active] ** 2).sum(axis=1) / np.maximum(best[active], 1e-9)
        active = active[gain > tolerance]
        if len(active) == 0:
            break
        moved, turned, landed = feet_and_normals(field, foot[active] + rate[active, None] * tangential[active])
        length = np.linalg.norm(targets[active] - moved, axis=1)
        better = landed & (length < best[active])
        rate[active[~better]] *= 0.25
        chosen, moved, turned = active[better], moved[better], turned[better]
        along = _tangential(targets[chosen] - moved, turned)
        move = moved - foot[chosen]
        change = (move * (tangential[chosen] - along)).sum(axis=1)
        curved = change > 0
        rate[chosen] = np.where(curved, (move**2).sum(axis=1) / np.where(curved, change, 1.0), 1.0).clip(1e-3, 100.0)
        foot[chosen], tangential[chosen], best[chosen] = moved, along, length[better]
    return best


def distinct_starts(
    points: Float64, normals: NDArray[np.floating], *, radius: float, cosine: float = 0.9
) -> NDArray[np.bool_]:
    """Which of each target's candidate starts ``(M, c, 3)`` are worth a descent of their own ``(M, c)``.

    One within ``radius`` of an earlier one that is kept, with its normal to within ``cosine``, leads to the same foot.
    """
    kept = np.ones(points.shape[:2], bool)
    for later in range(1, points.shape[1]):
        near = ((points[:, :later] - points[:, later, None]) ** 2).sum(axis=2) < radius**2
        alike = (normals[:, :later] * normals[:, later, None]).sum(axis=2) > cosine
        kept[:, later] = ~(near & alike & kept[:, :later]).any(axis=1)
    return kept


def _tangential(offset: Float64, normal: Float64) -> Float64:
    return offset - (offset * normal).sum(axis=1, keepdims=True) * normal
