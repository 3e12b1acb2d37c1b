"""Points of the zero set of a smooth field: uniform samples, projections; noise and outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import Field, Similarity
from ..clouds.point_cloud import Float64, PointCloud, unit_rows


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

    Points uniform in the shell |f| < ``shell``·|∇f| are projected on the surface. By Steiner's formula, a shell of
    half-width h holds 2h(1 + K h²/3) of volume per area, with the Gaussian curvature K. So the density is even to
    within K h²/3: 0.3 % for radii of curvature of 0.1 and h = 0.01.

    Args:
        field: of three dimensions; its finest level is sampled.
        count: number of points.
        seed: of the random numbers.
        shell: half-width h, in the field's units.
        extent: the surface is sampled in the cube [-extent, extent]³.
        steepness: a bound of |∇f| near the surface, by which empty space is skipped.
        block: candidates drawn at once.

    Raises:
        ValueError: there is no surface in the cube.
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
        # A first-order distance can be far off where the gradient is small.
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
    """Project ``points`` ``(N, 3)`` on the zero set by Newton's method along the gradient, x ← x - f ∇f / |∇f|².

    Returns the points, unit normals ``(N, 3)``, and whether |f| is below ``tolerance`` ``(N,)``. The steps are full and
    in float64; `neural_fields.project_to_surface` bounds its steps.
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
    """``count`` points uniform on the sphere around the origin, with exact normals."""
    normals = _directions(np.random.default_rng(seed), count)
    return PointCloud(radius * normals, normals.astype(np.float32), None, "sphere")


def sample_torus(count: int, *, major: float = 0.5, minor: float = 0.2, seed: int = 0) -> PointCloud:
    """``count`` points uniform on the torus around the z axis, with exact normals.

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


def add_noise(cloud: PointCloud, amplitude: float, *, isotropic: bool = False, seed: int = 0) -> PointCloud:
    """Move points along their normals by U(-1, 1)·``amplitude``·(diagonal of the bounding box); normals stay.

    The paper's noise is ``amplitude=0.01``. With ``isotropic``, each coordinate is moved by N(0, σ²) with σ =
    ``amplitude``·diagonal/√3, which is as strong along any direction.

    Raises:
        ValueError: the cloud has no normals to move its points along, or ``amplitude`` is negative.
    """
    if cloud.normals is None and not isotropic:
        raise ValueError(f"cloud={cloud.source!r} has no normals to move its points along; prepare it first")
    if not amplitude >= 0:
        raise ValueError(f"amplitude={amplitude}: expected a fraction of the diagonal, 0 or more")
    random, size = np.random.default_rng(seed), amplitude * float(np.linalg.norm(np.ptp(cloud.points, axis=0)))
    if cloud.normals is None or isotropic:
        return replace(cloud, points=cloud.points + random.normal(0, size / 3**0.5, cloud.points.shape))
    return replace(cloud, points=cloud.points + random.uniform(-size, size, (len(cloud), 1)) * unit_rows(cloud.normals))


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
    return unit_rows(random.normal(size=(count, 3)))


def _occupied_cells(
    field: Field, extent: float, shell: float, steepness: float, *, cells: int = 48
) -> tuple[Float64, float]:
    """Lower corners ``(M, 3)`` of the grid cells that the shell may cross, and the cells' size."""
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
