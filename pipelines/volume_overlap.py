"""Volumes of closed meshes, and of their intersection and union, by columns.

A column is a line along one axis. Sorted along it, the crossings of an oriented closed surface give the
winding number between them, so lengths inside are exact; only the choice of columns is a discretisation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .raster import cover
from .surface import Surface

__all__ = ["Overlap", "overlap"]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Where a column stands in its cell. Not the middle: models like to have their edges there.
OFFSET = (0.5 + 0.0372036, 0.5 - 0.0618034)


class Overlap(NamedTuple):
    """Volumes, averaged over the three axes, and the share of columns that had to be left out.

    Attributes:
        first: volume of the first mesh.
        second: volume of the second.
        intersection: volume inside both.
        union: volume inside either.
        broken: share of the columns that meet a surface but enter and leave it a different number of
            times; 0 for closed, consistently oriented meshes.
    """

    first: float
    second: float
    intersection: float
    union: float
    broken: float


def overlap(first: Surface, second: Surface, *, columns: int = 512) -> Overlap:
    """Measure two meshes; inside is where the winding number is not zero.

    Args:
        first: a mesh.
        second: another, in the same coordinates.
        columns: along the longest side of the box around both.

    Raises:
        ValueError: ``columns`` is not positive, or a surface has no faces.
    """
    if columns < 1:
        raise ValueError(f"columns={columns}: expected > 0")
    if not (len(first.faces) and len(second.faces)):
        raise ValueError("surfaces: both must have faces")
    first, second = first.merged, second.merged
    both = np.concatenate((first.vertices, second.vertices))
    low, high = both.min(axis=0), both.max(axis=0)
    step = float((high - low).max()) / columns
    volumes = np.zeros(4)
    met = broken = 0
    for axis in range(3):
        # A cyclic change of axes keeps the orientation of the triangles.
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        counts = np.maximum(np.ceil((high - low)[order[:2]] / step).astype(int), 1)
        shape = (int(counts[0]), int(counts[1]))
        crossings = [_crossings(mesh, order, low, step, shape) for mesh in (first, second)]
        lengths, met_here, broken_here = _inside_lengths(*crossings, size=shape[0] * shape[1])
        volumes += lengths * step**2 / 3
        met, broken = met + met_here, broken + broken_here
    return Overlap(*map(float, volumes), broken=broken / max(met, 1))


def _crossings(
    mesh: Surface, order: list[int], low: Float64, step: float, shape: tuple[int, int]
) -> tuple[Int64, Float64, NDArray[np.int8]]:
    """Column, height and sign of every crossing, each ``(K,)``."""
    placed = mesh.vertices[:, order]
    xy = (placed[:, :2] - low[order[:2]]) / step - OFFSET
    column, height, sign = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0, np.int8)]
    for found in cover(xy, mesh.faces, shape):
        column.append(found.column)
        height.append((found.weights * placed[mesh.faces[found.face], 2]).sum(axis=1))
        sign.append(found.sign)
    return np.concatenate(column), np.concatenate(height), np.concatenate(sign)


def _inside_lengths(
    first: tuple[Int64, Float64, NDArray[np.int8]],
    second: tuple[Int64, Float64, NDArray[np.int8]],
    *,
    size: int,
) -> tuple[Float64, int, int]:
    """Total lengths inside first, second, both, either; columns met; columns broken (and left out)."""
    sums = [np.bincount(c, weights=s, minlength=size) for c, _, s in (first, second)]
    met = np.bincount(np.concatenate((first[0], second[0])), minlength=size) > 0
    broken = (sums[0] != 0) | (sums[1] != 0)
    column = np.concatenate((first[0], second[0]))
    height = np.concatenate((first[1], second[1]))
    turns = np.zeros((len(column), 2), np.int64)  # winding of each mesh, changed by each crossing
    turns[: len(first[0]), 0] = first[2]
    turns[len(first[0]) :, 1] = second[2]
    kept = np.flatnonzero(~broken[column])
    kept = kept[np.lexsort((height[kept], column[kept]))]
    # Windings return to zero at the end of each column, so one running sum serves all of them.
    inside = np.cumsum(turns[kept], axis=0)[:-1] != 0
    gap = np.where(np.diff(column[kept]) == 0, np.diff(height[kept]), 0.0)
    a, b = inside[:, 0], inside[:, 1]
    lengths = np.array([gap[a].sum(), gap[b].sum(), gap[a & b].sum(), gap[a | b].sum()])
    return lengths, int(met.sum()), int(broken.sum())
