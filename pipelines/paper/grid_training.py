"""What the grid baselines learn from, and their terms: relative errors, and derivatives by finite differences."""

from __future__ import annotations

import torch
from torch import Tensor

from ...datasets import OrientedCloud
from ..fit.cloud import CloudDistance
from ..fit.samples import DOMAIN

__all__ = ["SignedPools", "differences", "mape_loss", "stencil"]


class SignedPools:
    """Cloud points, points near them and uniform ones, with signed distances to the cloud."""

    def __init__(self, cloud: OrientedCloud, near: int, uniform: int, spread: float, *, seed: int, device: str) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        on = torch.from_numpy(cloud.points)
        index = CloudDistance(on, torch.from_numpy(cloud.normals))
        anchors = on[torch.randint(len(on), (near,), generator=self.generator)]
        # Steps shorter than the cloud's spacing would leave unsaid what is between its points.
        scale = max(spread, index.spacing)
        steps = scale * torch.logit(torch.rand(near, 3, generator=self.generator), eps=1e-6)
        by = (anchors + steps).clamp(-DOMAIN, DOMAIN)
        anywhere = (2 * torch.rand(uniform, 3, generator=self.generator) - 1) * DOMAIN
        known = ((on, torch.zeros(len(on))), (by, index.signed(by)), (anywhere, index.signed(anywhere)))
        self.pools = [(points.to(device), distance.to(device)) for points, distance in known]

    def draw(self, count: int, shares: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
        """About ``count`` points ``(N, 3)`` in random order, with their distances ``(N,)``."""
        points, distances = [], []
        for (pool, distance), share in zip(self.pools, shares, strict=True):
            number = count * share // sum(shares)
            chosen = torch.randint(len(pool), (number,), generator=self.generator).to(pool.device)
            points.append(pool[chosen])
            distances.append(distance[chosen])
        order = torch.randperm(sum(len(part) for part in points), generator=self.generator).to(points[0].device)
        return torch.cat(points)[order], torch.cat(distances)[order]


def mape_loss(value: Tensor, distance: Tensor, *, epsilon: float = 0.01) -> Tensor:
    """``|f − d| / (|d| + ε)``, Instant-NGP's loss for distances. ``(...,)`` twice → ``(...,)``.

    The nearer to the surface, the dearer an error: on it, a hundred times as dear as at distance 1.
    """
    return (value - distance).abs() / (distance.abs() + epsilon)


def stencil(x: Tensor, step: float) -> Tensor:
    """Each point and its six neighbours along the axes, ``(N, 3)`` → ``(N, 7, 3)``: x, x + h e₁, x − h e₁, ...."""
    unit = torch.eye(3, dtype=x.dtype, device=x.device)
    moves = torch.stack((unit, -unit), dim=1).reshape(6, 3)
    return x[:, None] + step * torch.cat((torch.zeros_like(moves[:1]), moves))


def differences(values: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Gradient ``(N, 3)`` and Laplacian ``(N,)`` by central differences of ``(N, 7)`` values on a `stencil`."""
    ahead, behind = values[:, 1::2], values[:, 2::2]
    return (ahead - behind) / (2 * step), (values[:, 1:].sum(dim=1) - 6 * values[:, 0]) / step**2
