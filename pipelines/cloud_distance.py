"""Signed distance to an oriented point cloud: what level 0 learns from, without any mesh.

Magnitude: each point stands for a disc in its tangent plane, as wide as its neighbourhood is spaced; the distance
to the nearest of a few discs has neither the bias of the distance to the nearest point (√(d² + h²) instead of d)
nor the reach of an infinite tangent plane. Sign: away from the surface by the generalised winding number of
the cloud, which closes the holes that scans have; close to it by the side of the nearest discs. Beside the edge of a
blade, where all discs are seen edge-on, what smoothing has left of noise would decide: of a cloud that was noisy, the
winding number is asked down to half the width of the noise.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

__all__ = ["CloudDistance"]

Float32 = NDArray[np.float32]

# Area of a point's disc over the median one: scans are this much sparser where they graze the surface, hardly more.
LARGEST_AREA = 100.0


class CloudDistance:
    """Nearest distances to, and signed distances from, an oriented cloud in the unit sphere.

    Args:
        points: ``(N, 3)`` points.
        normals: ``(N, 3)`` outward unit normals.
        neighbors: how many discs are compared at each query.
        cell: edge of the cells in which points are merged into dipoles for the winding number; dipoles
            are used only further than ``2 · cell`` from the surface, where their error is below 0.05.
        noise: standard deviation of the noise that was smoothed off the points.
    """

    def __init__(
        self, points: Tensor, normals: Tensor, *, neighbors: int = 6, cell: float = 0.05, noise: float = 0.0
    ) -> None:
        self.points: Float32 = points.cpu().numpy()
        self.normals: Float32 = normals.cpu().numpy()
        self.tree = KDTree(self.points, compact_nodes=False, balanced_tree=False)
        self.noise = noise
        self.neighbors, self.cell = min(neighbors, len(points)), cell
        count = min(8, len(points) - 1)
        reach = np.asarray(self.tree.query(self.points, k=count + 1, workers=-1)[0])[:, -1]
        # `count` neighbours share the disc of radius `reach`: each of them has this much area to itself.
        areas = math.pi * reach**2 / count
        # A few points on their own have nobody near, but no surface of that size either.
        self.areas: Float32 = np.minimum(areas, LARGEST_AREA * np.median(areas)).astype(np.float32)
        self.radii: Float32 = np.sqrt(self.areas / math.pi)
        self.spacing = float(np.median(np.sqrt(self.areas)))

    def nearest(self, x: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance from each of ``(M, 3)`` to the nearest point of the cloud → ``(M,)``."""
        return np.asarray(self.tree.query(x, workers=-1)[0])

    def signed(self, x: Tensor) -> Tensor:
        """Signed distance of ``(M, 3)`` points → ``(M,)`` on the CPU, negative inside."""
        query = x.cpu().numpy()
        found, index = self.tree.query(query, k=self.neighbors, workers=-1)
        distance = np.asarray(found)
        offset = query[:, None] - self.points[index]  # (M, k, 3)
        along = np.einsum("mkd,mkd->mk", offset, self.normals[index])
        across = np.sqrt(np.maximum(distance**2 - along**2, 0))
        discs = np.hypot(along, np.maximum(across - self.radii[index], 0))
        magnitude = discs.min(axis=1)
        # Each disc votes with its side, the nearer and the more face-on the louder.
        side = np.sum(along / (distance**3 + 1e-12), axis=1)
        far = distance[:, 0] > 2 * self.cell
        near = ~far & (distance[:, 0] > 0.5 * self.noise) if self.noise else np.zeros_like(far)
        for some, cell in ((far, self.cell), (near, self.cell / 2)):
            if some.any():
                side[some] = 0.5 - self.winding_number(query[some], cell=cell)
        return torch.from_numpy(np.where(side < 0, -magnitude, magnitude).astype(np.float32))

    def winding_number(self, x: Float32, *, cell: float | None = None, chunk: int = 1024) -> NDArray[np.float64]:
        """Generalised winding number at ``(M, 3)`` points: about 1 inside, 0 outside, in between near holes.

        ``w(x) = Σ_i a_i ⟨p_i − x, n_i⟩ / (4π |p_i − x|³)`` over dipoles (Barill et al. 2018, first order).

        Args:
            x: the points.
            cell: edge of the cells of one dipole each; None for that of the index.
            chunk: points at a time.
        """
        centers, moments = self._dipoles(cell or self.cell)
        offset = (centers * moments).sum(dim=1)
        squares = (centers**2).sum(dim=1)
        query = torch.from_numpy(np.ascontiguousarray(x, np.float32))
        result = torch.empty(len(query))
        for start in range(0, len(query), chunk):
            part = query[start : start + chunk]
            flux = torch.addmm(offset, part, moments.t(), alpha=-1)
            d2 = torch.addmm(squares, part, centers.t(), alpha=-2).add_((part**2).sum(dim=1)[:, None])
            inverse = d2.clamp_(min=1e-8).rsqrt_()
            result[start : start + chunk] = flux.mul_(inverse).mul_(inverse).mul_(inverse).sum(dim=1)
        return (result / (4 * math.pi)).double().numpy()

    def _dipoles(self, cell: float) -> tuple[Tensor, Tensor]:
        """Area-weighted centres and area-weighted normal sums of the cloud's occupied cells."""
        cells = np.floor(self.points / cell).astype(np.int64)
        _, owner = np.unique(cells @ np.array([1 << 40, 1 << 20, 1]), return_inverse=True)
        area = np.bincount(owner, self.areas)
        center = np.stack([np.bincount(owner, self.areas * self.points[:, i]) for i in range(3)], 1) / area[:, None]
        moment = np.stack([np.bincount(owner, self.areas * self.normals[:, i]) for i in range(3)], 1)
        return torch.from_numpy(center.astype(np.float32)), torch.from_numpy(moment.astype(np.float32))
