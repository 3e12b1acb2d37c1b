"""What of the space around a cloud is outside for sure: all that can be reached from far away without crossing it.

No normals are asked. Cells of a grid that are nearer to a point than its neighbours are apart belong to the surface;
the others fall into connected regions, of which one is the outside and each other is enclosed. It fails where a hole
of the scan is wider than the points are spaced: there the inside is reached too. Winding numbers close such holes, but
take a hollow behind a thin wall for filled: what both say is sure.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

__all__ = ["OUTSIDE", "Exterior"]

Float64 = NDArray[np.float64]
Labels = NDArray[np.int64]

OUTSIDE = 1  # the number of that region

RESOLUTION = 128
HALF = 1.15  # of the edge of the grid: the unit sphere, and room around it
WALL = 1.5  # spacings around a point that belong to the surface
# Regions that nothing wider than twice so many spacings joins are apart: of points that are drawn uniformly, one in
# e^(π r²) lies beside an empty disc of r spacings.
GATE = 2.5
NEIGHBORS = 8  # whose mean spacing is a point's
FEWEST = 500  # cells of a region; smaller ones lie between points that are unevenly spaced


class Exterior:
    """The regions that a cloud in the unit sphere divides space into.

    Args:
        points: ``(N, 3)``.
        resolution: cells along each edge of the grid.

    Attributes:
        count: how many regions there are, of `FEWEST` cells at least; `OUTSIDE`, and others that are enclosed.
    """

    def __init__(self, points: Float64, *, resolution: int = RESOLUTION) -> None:
        self.cell = 2 * HALF / resolution
        distance, near = KDTree(points).query(points, k=min(NEIGHBORS + 1, len(points)), workers=-1)
        reach = np.asarray(distance)[:, -1][np.asarray(near)].max(axis=1)  # beside a gap that is its neighbours'
        spacing = np.maximum(np.sqrt(np.pi / NEIGHBORS) * reach, self.cell / np.sqrt(3))
        where, widest = self._cells(points, resolution), np.zeros((resolution,) * 3)
        np.maximum.at(widest, tuple(where.T), spacing)
        apart, nearest = _distances(widest > 0)
        apart *= self.cell / widest[nearest]
        label: Any = ndimage.label(apart > GATE)
        label = np.asarray(label[0])
        beside, nearest = _distances(label > 0)
        grown = (apart > WALL) & (beside * self.cell <= (GATE - WALL) * widest.max())
        label = np.where(grown, label[nearest], label)
        size = np.bincount(label.ravel())
        size[[0, label[0, 0, 0]]] = 0
        kept = [int(label[0, 0, 0]), *np.argsort(-size)[: int((size >= FEWEST).sum())].tolist()]
        names = np.zeros(len(size), np.int64)
        names[kept] = OUTSIDE + np.arange(len(kept))
        self.count = len(kept)
        self._region = names[label]

    def regions(self, x: Float64) -> Labels:
        """The region of each of ``(M, 3)`` places: 0 near the cloud's points, `OUTSIDE`, or more."""
        return self._region[tuple(self._cells(x, len(self._region)).T)]

    def _cells(self, x: Float64, resolution: int) -> Labels:
        return np.floor((x + HALF) / self.cell).astype(np.int64).clip(0, resolution - 1)


def _distances(there: NDArray[np.bool_]) -> tuple[Float64, tuple[Labels, ...]]:
    """For each cell the distance, in cells, to the nearest that is ``there``, and the indices of that."""
    found: Any = ndimage.distance_transform_edt(~there, return_indices=True)
    return found[0], tuple(found[1])
