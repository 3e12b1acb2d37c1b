"""Thinning clouds by voxels: of the points in a cube, one stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .point_cloud import PointCloud

__all__ = ["select", "spacing_of", "thin", "voxel_representatives"]

Float64 = NDArray[np.float64]


def select(cloud: PointCloud, index: NDArray[np.integer] | NDArray[np.bool_]) -> PointCloud:
    """The cloud with only these points: indices ``(M,)`` or a mask ``(N,)``."""
    return PointCloud(
        cloud.points[index],
        None if cloud.normals is None else cloud.normals[index],
        None if cloud.colors is None else cloud.colors[index],
        cloud.source,
        cloud.normals_source,
    )


def thin(cloud: PointCloud, max_points: int, *, steps: int = 12) -> PointCloud:
    """At most ``max_points`` points, evenly spread: those nearest the middle of the points of their voxel.

    Points stay where they are; the smallest voxel that leaves few enough is found by bisection.

    Args:
        cloud: its points must be finite.
        max_points: as many or fewer stay.
        steps: halvings of the voxel's exponent; 12 leave it a few percent too large at most.

    Raises:
        ValueError: ``max_points`` is not positive.
    """
    if max_points < 1:
        raise ValueError(f"max_points={max_points}: expected at least one")
    if len(cloud) <= max_points:
        return cloud
    extent = float(np.ptp(cloud.points, axis=0).max())
    # One voxel holds all at the top; at the bottom a million of them stand along a side.
    low, high = -20.0, 1.0
    for _ in range(steps):
        middle = (low + high) / 2
        if _voxel_count(cloud.points, extent * 2**middle) > max_points:
            low = middle
        else:
            high = middle
    return select(cloud, voxel_representatives(cloud.points, extent * 2**high))


def voxel_representatives(points: Float64, size: float) -> NDArray[np.int64]:
    """Indices, in order, of one point ``(N, 3)`` per voxel: the one nearest the mean of its points."""
    _, voxel = np.unique(_keys(points, size), return_inverse=True)
    count = np.bincount(voxel)
    mean = np.stack([np.bincount(voxel, weights=axis) / count for axis in points.T], axis=1)
    off = ((points - mean[voxel]) ** 2).sum(axis=1)
    order = np.lexsort((off, voxel))
    first = np.concatenate(([0], np.cumsum(count)[:-1]))
    return np.sort(order[first])


def spacing_of(points: Float64, *, share: float = 0.95, sample: int = 20_000) -> float:
    """Distance to the nearest neighbour that ``share`` of the points ``(N, 3)`` stay below; 0 for a lone point.

    Measured at an even selection of ``sample`` points, among all of them.
    """
    if len(points) < 2:
        return 0.0
    shifted = points - points.mean(axis=0)  # a tree over map coordinates would lose digits
    asked = shifted[:: 1 + len(points) // sample]
    return float(np.quantile(KDTree(shifted).query(asked, k=2)[0][:, 1], share))


def _voxel_count(points: Float64, size: float) -> int:
    return len(np.unique(_keys(points, size)))


def _keys(points: Float64, size: float) -> NDArray[np.int64]:
    """One whole number per point and voxel."""
    cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    sides = cells.max(axis=0) + 1
    return (cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]
