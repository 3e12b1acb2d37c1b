"""Sums over all pairs of thousands of points: the winding number of softened dipoles, its adjoint and its gradient.

A dipole μ at p has the winding number ``⟨p − x, μ⟩ K(|p − x|)`` at x, with ``K(r) = (r² + ε²)^(−3/2) / 4π``: that of a
small disc whose area-weighted normal is μ, seen from further away than the softening ε. Points lie in leaves of a k-d
tree, all of the same size, so that everything is a product of dense matrices: leaves near a point's own are summed
point by point, each further one as a single dipole at its middle. For N points that is of order N^1.5 instead of N²
(20,000 points: 3 % of the pairs), and bounded by `leaf`. `DipoleSums` asks at the points themselves, over and over;
`DipoleField` once at any places.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["DipoleField", "DipoleSums"]

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class DipoleOptions:
    """How sums over dipoles are split into leaves."""

    leaf: int = 48  # points of a leaf, about
    # Leaves are near whose middles are closer than this many times the sum of their radii; sums are then off by 2 %.
    near: float = 1.4
    most_leaves: int = 2048  # of larger clouds, leaves are larger
    batch: int = 1 << 22  # pairs handled at once, to bound memory


DIPOLES = DipoleOptions()


class _Batch(NamedTuple):
    """Leaves, or groups of places, with about as many near leaves.

    Attributes:
        leaves: ``(b,)`` those.
        near: ``(b, c)`` the leaves near each of them, filled up to the largest count.
        there: ``(b, c, 1, 1)`` 0 for those that only fill up.
    """

    leaves: Tensor
    near: Tensor
    there: Tensor


class DipoleSums:
    """Sums over the pairs of ``(N, 3)`` points within the unit sphere, in float32.

    Args:
        points: ``(N, 3)``, at least one.
        softening: ε, a length; positive.
    """

    def __init__(self, points: Float64, softening: float) -> None:
        order, real, leaves = _leaves(points)
        self._count, self._leaves = len(points), leaves
        self._order, self._real = torch.from_numpy(order), torch.from_numpy(real)
        self._x = torch.from_numpy(points[order].astype(np.float32))
        self._squares = (self._x**2).sum(dim=1)
        placed = self._by_leaf(self._x)
        self._middles = placed.mean(dim=1)
        radii = (placed - self._middles[:, None]).norm(dim=2).amax(dim=1)
        near = torch.cdist(self._middles, self._middles) < DIPOLES.near * (radii[:, None] + radii)
        self._near = near.fill_diagonal_(True)
        members = self._x.shape[0] // leaves
        self._batches = list(_batches(near, lambda count: count * members**2))
        self.soften(softening)

    def soften(self, softening: float) -> None:
        """Take another ε; the points stay."""
        self._epsilon2 = softening**2
        self._far = _kernel(self._far_squares())
        self._by_leaf(self._far).masked_fill_(self._near[:, None, :], 0)
        self._close = [_kernel(self._close_squares(batch)) for batch in self._batches]

    def winding(self, dipoles: Tensor) -> Tensor:
        """``Σ_j ⟨p_j − p_i, μ_j⟩ K_ij`` at every point ``(N,)``, of dipoles ``(N, 3)``."""
        mu = self._placed(dipoles)
        total = self._by_leaf(mu).sum(dim=1)
        sources = torch.cat([(self._x * mu).sum(dim=1, keepdim=True), mu], dim=1)
        far = torch.cat([(self._middles * total).sum(dim=1, keepdim=True), total], dim=1)
        sums = self._summed(sources, far)
        return self._back(sums[:, 0] - (self._x * sums[:, 1:]).sum(dim=1))

    def adjoint(self, values: Tensor) -> Tensor:
        """``Σ_i v_i (p_j − p_i) K_ij`` at every point ``(N, 3)``, of values ``(N,)``: the transposed of `winding`."""
        v = self._placed(values[:, None])
        sources = torch.cat([v, v * self._x], dim=1)
        sums = self._summed(sources, self._by_leaf(sources).sum(dim=1))
        return self._back(self._x * sums[:, :1] - sums[:, 1:])

    def descent(self, dipoles: Tensor) -> Tensor:
        """``−∇`` of the winding number at every point ``(N, 3)``: out of the body that the dipoles ``(N, 3)`` bound.

        ``Σ_j K_ij μ_j − 3 K_ij ⟨d, μ_j⟩ d / (|d|² + ε²)`` with ``d = p_j − p_i``.
        """
        mu = self._placed(dipoles)
        total = self._by_leaf(mu).sum(dim=1)
        flux = torch.addmm((self._middles * total).sum(dim=1), self._x, total.t(), alpha=-1)
        flux.mul_(self._far).div_(self._far_squares())
        ones = torch.ones(len(self._x), 1)
        moment = flux @ torch.cat([self._middles, ones[: self._leaves]], dim=1)
        result = (self._far @ total).sub_(moment[:, :3] - self._x * moment[:, 3:], alpha=3)
        leaves = self._by_leaf(result)
        points, sources = torch.cat([self._x, ones], dim=1), torch.cat([(self._x * mu).sum(1, keepdim=True), mu], dim=1)
        for batch, kernel in zip(self._batches, self._close, strict=True):
            x, near = self._by_leaf(self._x)[batch.leaves], self._gathered(batch, sources)
            flux = torch.baddbmm(near[:, None, :, 0], x, near[:, :, 1:].transpose(1, 2), alpha=-1)
            flux.mul_(kernel).div_(self._close_squares(batch))
            moment = torch.bmm(flux, self._gathered(batch, points))
            leaves[batch.leaves] += torch.bmm(kernel, near[:, :, 1:])
            leaves[batch.leaves] -= 3 * (moment[:, :, :3] - x * moment[:, :, 3:])
        return self._back(result)

    def leaf_means(self, values: Tensor) -> Tensor:
        """Means ``(leaves,)`` of values ``(N,)`` over the points of each leaf."""
        real = self._by_leaf(self._real[:, None].float()).sum(dim=1)[:, 0]
        return self._by_leaf(self._placed(values[:, None])).sum(dim=1)[:, 0] / real.clamp(min=1)

    def _summed(self, sources: Tensor, far: Tensor) -> Tensor:
        """``Σ_j K_ij s_j`` of placed sources ``(padded, c)``, and their sums ``(leaves, c)`` for those far away."""
        sums = self._far @ far
        leaves = self._by_leaf(sums)
        for batch, kernel in zip(self._batches, self._close, strict=True):
            leaves[batch.leaves] += torch.bmm(kernel, self._gathered(batch, sources))
        return sums

    def _far_squares(self) -> Tensor:
        offsets = (self._middles**2).sum(dim=1) + self._epsilon2
        return torch.addmm(offsets, self._x, self._middles.t(), alpha=-2).add_(self._squares[:, None])

    def _close_squares(self, batch: _Batch) -> Tensor:
        """``|p_j − p_i|² + ε²`` ``(b, leaf, c · leaf)``; rounding must leave it above zero for sources that fill up."""
        x, near = self._by_leaf(self._x)[batch.leaves], self._by_leaf(self._x)[batch.near].flatten(1, 2)
        offsets = (near**2).sum(dim=2)[:, None] + self._epsilon2
        squares = torch.baddbmm(offsets, x, near.transpose(1, 2), alpha=-2).add_((x**2).sum(dim=2)[:, :, None])
        return squares.clamp_(min=self._epsilon2)

    def _gathered(self, batch: _Batch, sources: Tensor) -> Tensor:
        return (self._by_leaf(sources)[batch.near] * batch.there).flatten(1, 2)

    def _by_leaf(self, rows: Tensor) -> Tensor:
        return rows.view(self._leaves, -1, rows.shape[-1])

    def _placed(self, rows: Tensor) -> Tensor:
        return torch.where(self._real[:, None], rows[self._order], 0)

    def _back(self, rows: Tensor) -> Tensor:
        result = torch.empty(self._count, *rows.shape[1:])
        result[self._order[self._real]] = rows[self._real]
        return result


class DipoleField:
    """The winding number of dipoles at any places: about 1 inside of what their points surround, and 0 outside.

    Neighbouring dipoles near a place count one by one, so that the sides of a bar do not cancel where it is thinner
    than the leaves.

    Args:
        points: ``(N, 3)`` within the unit sphere, at least one.
        dipoles: ``(N, 3)`` outward normals, times the area that each stands for.
        softening: ε of each ``(N,)``, a length; positive.

    Example:
        >>> import numpy as np
        >>> from mplicits.datasets import sample_sphere
        >>> sphere = sample_sphere(2000)  # of radius 0.5
        >>> area = np.pi / 2000
        >>> field = DipoleField(sphere.points, area * sphere.normals, np.full(2000, 0.01))
        >>> (field.winding(np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]])) > 0.5).tolist()
        [True, False]
    """

    def __init__(
        self, points: NDArray[np.floating], dipoles: NDArray[np.floating], softening: NDArray[np.floating]
    ) -> None:
        order, real, leaves = _leaves(points.astype(np.float64), max(DIPOLES.leaf, len(points) / DIPOLES.most_leaves))

        def by_leaf(rows: NDArray[np.floating]) -> Tensor:
            return torch.from_numpy(rows.astype(np.float32)).view(leaves, -1, rows.shape[1])

        self._x, self._mu = by_leaf(points[order]), by_leaf(np.where(real[:, None], dipoles[order], 0))
        self._epsilon2 = by_leaf(softening[order, None] ** 2)
        weight = self._mu.norm(dim=2, keepdim=True)  # the middle of a leaf's area, as in Barill et al. 2018
        self._middles = (self._x * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1e-30)
        self._radii = (self._x - self._middles[:, None]).norm(dim=2).amax(dim=1)
        self._total = self._mu.sum(dim=1)

    def winding(self, x: NDArray[np.floating]) -> Float64:
        """``Σ_j ⟨p_j − x, μ_j⟩ / 4π (|p_j − x|² + ε_j²)^(3/2)`` at ``(M, 3)`` places → ``(M,)``.

        Args:
            x: the places.
        """
        if len(x) == 0:
            return np.empty(0)
        order, real, groups = _leaves(x.astype(np.float64))
        places = torch.from_numpy(x[order].astype(np.float32)).view(groups, -1, 3)
        middles = places.mean(dim=1)
        radii = (places - middles[:, None]).norm(dim=2).amax(dim=1)
        near = torch.cdist(middles, self._middles) < DIPOLES.near * (radii[:, None] + self._radii)
        sums = torch.empty(places.shape[:2])
        (size, leaves), members = (places.shape[1], len(self._middles)), self._x.shape[1]
        for batch in _batches(near, lambda count: size * max(leaves, count * members)):
            # About the middle of a group: of the squares of small offsets float32 keeps more digits.
            middle = middles[batch.leaves, None]
            asked = places[batch.leaves] - middle
            apart = (~near[batch.leaves, :, None]).float()
            total = _sums_of(asked, self._middles - middle, self._total * apart, torch.zeros(()))
            x_near, mu_near = (self._x[batch.near] - middle[:, None]).flatten(1, 2), self._mu[batch.near] * batch.there
            total += _sums_of(asked, x_near, mu_near.flatten(1, 2), self._epsilon2[batch.near].flatten(1, 3)[:, None])
            sums[batch.leaves] = total
        result = torch.empty(len(x))
        result[torch.from_numpy(order[real])] = sums.view(-1)[torch.from_numpy(real)]
        return result.double().numpy() / (4 * math.pi)


def _sums_of(places: Tensor, points: Tensor, dipoles: Tensor, epsilon2: Tensor) -> Tensor:
    """``Σ_j ⟨p_j − x, μ_j⟩ (|p_j − x|² + ε_j²)^(−3/2)`` ``(b, s)``: places ``(b, s, 3)``, dipoles ``(b, c, 3)``."""
    flux = torch.baddbmm((points * dipoles).sum(dim=2)[:, None], places, dipoles.transpose(1, 2), alpha=-1)
    squares = torch.baddbmm((points**2).sum(dim=2)[:, None] + epsilon2, places, points.transpose(1, 2), alpha=-2)
    inverse = squares.add_((places**2).sum(dim=2, keepdim=True)).clamp_(min=1e-12).rsqrt_()
    return flux.mul_(inverse).mul_(inverse).mul_(inverse).sum(dim=2)


def _batches(near: Tensor, pairs: Callable[[int], int]) -> Iterator[_Batch]:
    """Rows of ``(n, leaves)`` together that have about as many near leaves; so many leaves are so many pairs a row."""
    counts, order = near.sum(dim=1).sort()
    start = 0
    while start < len(near):
        few = int(counts[start])
        alike = int((counts <= 1.15 * few + 1).sum()) - start
        end = start + max(1, min(alike, DIPOLES.batch // pairs(few)))
        rows = order[start:end]
        there, found = torch.topk(near[rows].to(torch.int8), int(counts[end - 1]), dim=1)
        yield _Batch(rows, found, (there > 0)[:, :, None, None].float())
        start = end


def _kernel(squares: Tensor) -> Tensor:
    """``s^(−3/2) / 4π``."""
    return squares.sqrt().mul_(squares).reciprocal_().mul_(1 / (4 * math.pi))


def _leaves(points: Float64, size: float = DIPOLES.leaf) -> tuple[NDArray[np.int64], NDArray[np.bool_], int]:
    """The points in the order of a balanced k-d tree's leaves, all of the same size: ``size``, or down to half of it.

    Returns:
        Indices ``(padded,)``, leaf after leaf; some points come twice so that leaves are full, and which of them is the
        first ``(padded,)``; how many leaves there are.
    """
    count = len(points)
    levels = max(0, math.ceil(math.log2(count / size)))
    members = -(-count // 2**levels)
    again = np.linspace(0, count - 1, members * 2**levels - count).astype(np.int64)
    index = np.concatenate((np.arange(count), again))
    place = np.arange(len(index))
    for level in range(levels):
        place = place.reshape(2**level, -1)
        inside = points[index[place]]
        widest = np.ptp(inside, axis=1).argmax(axis=1)
        along = np.take_along_axis(inside, widest[:, None, None], axis=2)[:, :, 0]
        place = np.take_along_axis(place, np.argsort(along, axis=1, kind="stable"), axis=1)
    place = place.ravel()
    return index[place], place < count, 2**levels
