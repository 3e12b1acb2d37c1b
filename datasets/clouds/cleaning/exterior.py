"""What of the space around a cloud is outside for sure: all that can be reached from far away without crossing it.

No normals are asked. Cells of a grid that are nearer to a point than its neighbours are apart belong to the surface;
the others fall into connected regions, of which one is the outside and each other is enclosed. It fails where a hole
of the scan is wider than the points are spaced: there the inside is reached too. Winding numbers close such holes, but
take a hollow behind a thin wall for filled: what both say is sure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

__all__ = ["OUTER_REGION", "Exterior"]

Float64 = NDArray[np.float64]
Labels = NDArray[np.int64]

OUTER_REGION = 1  # the number of that region


@dataclass(frozen=True)
class ExteriorOptions:
    """The grid around a cloud in the unit sphere; lengths in spacings of the points."""

    resolution: int = 128
    half: float = 1.15  # half edge of the grid, in units of the sphere
    wall: float = 1.5  # around a point: part of the surface
    gate: float = 2.5  # half width of a gap that joins two regions; one uniform point in e^(π r²) has such a gap
    neighbors: int = 8  # whose mean spacing is a point's
    fewest: int = 500  # cells of a region


EXTERIOR = ExteriorOptions()


class Exterior:
    """The regions that a cloud in the unit sphere divides space into.

    Args:
        points: ``(N, 3)``.
        resolution: cells along each edge of the grid.

    Attributes:
        count: how many regions there are, of `fewest` cells at least; `OUTER_REGION`, and others that are enclosed.
    """

    def __init__(self, points: Float64, *, resolution: int = EXTERIOR.resolution) -> None:
        self.cell = 2 * EXTERIOR.half / resolution
        distance, near = KDTree(points).query(points, k=min(EXTERIOR.neighbors + 1, len(points)), workers=-1)
        reach = np.asarray(distance)[:, -1][np.asarray(near)].max(axis=1)  # beside a gap that is its neighbours'
        spacing = np.maximum(np.sqrt(np.pi / EXTERIOR.neighbors) * reach, self.cell / np.sqrt(3))
        where, widest = self._cells(points, resolution), np.zeros((resolution,) * 3)
        np.maximum.at(widest, tuple(where.T), spacing)
        apart, nearest = _distances(widest > 0)
        apart *= self.cell / widest[nearest]
        label: Any = ndimage.label(apart > EXTERIOR.gate)
        label = np.asarray(label[0])
        beside, nearest = _distances(label > 0)
        grown = (apart > EXTERIOR.wall) & (beside * self.cell <= (EXTERIOR.gate - EXTERIOR.wall) * widest.max())
        label = np.where(grown, label[nearest], label)
        size = np.bincount(label.ravel())
        size[[0, label[0, 0, 0]]] = 0
        kept = [int(label[0, 0, 0]), *np.argsort(-size)[: int((size >= EXTERIOR.fewest).sum())].tolist()]
        names = np.zeros(len(size), np.int64)
        names[kept] = OUTER_REGION + np.arange(len(kept))
        self.count = len(kept)
        self._region = names[label]

    def regions(self, x: Float64) -> Labels:
        """The region of each of ``(M, 3)`` places: 0 near the cloud's points, `OUTER_REGION`, or more."""
        return self._region[tuple(self._cells(x, len(self._region)).T)]

    def _cells(self, x: Float64, resolution: int) -> Labels:
        return np.floor((x + EXTERIOR.half) / self.cell).astype(np.int64).clip(0, resolution - 1)


def _distances(there: NDArray[np.bool_]) -> tuple[Float64, tuple[Labels, ...]]:
    """For each cell the distance, in cells, to the nearest that is ``there``, and the indices of that."""
    found: Any = ndimage.distance_transform_edt(~there, return_indices=True)
    return found[0], tuple(found[1])
