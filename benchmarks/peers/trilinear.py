"""Values on a grid interpolated between the vertices of a cell, with derivatives in closed form."""

from __future__ import annotations

import torch
from mplicits.neural_fields.networks.trilinear import Place
from torch import Tensor

__all__ = ["interpolate", "interpolate_jet"]


def interpolate(corners: Tensor, within: Tensor) -> Tensor:
    """Interpolate ``(N, 2, 2, 2, F)`` values at the vertices → ``(N, F)``."""
    u, v, w = within[:, None, None, None, 0], within[:, None, None, 1], within[:, None, 2]
    edges = torch.lerp(corners[:, 0], corners[:, 1], u)  # (N, 2, 2, F)
    ends = torch.lerp(edges[:, 0], edges[:, 1], v)
    return torch.lerp(ends[:, 0], ends[:, 1], w)


def interpolate_jet(corners: Tensor, place: Place) -> tuple[Tensor, Tensor]:
    """Interpolate, and differentiate by x; both differentiable with respect to values and x.

    Returns:
        ``(N, F)`` values and ``(N, F, 3)`` derivatives.
    """
    u, v, w = place.within[:, None, None, None, 0], place.within[:, None, None, 1], place.within[:, None, 2]
    by_x = corners[:, 1] - corners[:, 0]
    edges = torch.lerp(corners[:, 0], corners[:, 1], u)
    by_y, ends = edges[:, 1] - edges[:, 0], torch.lerp(edges[:, 0], edges[:, 1], v)
    by_x = torch.lerp(by_x[:, 0], by_x[:, 1], v)
    by_z, value = ends[:, 1] - ends[:, 0], torch.lerp(ends[:, 0], ends[:, 1], w)
    by_x, by_y = (torch.lerp(slope[:, 0], slope[:, 1], w) for slope in (by_x, by_y))
    return value, torch.stack((by_x, by_y, by_z), dim=-1) * place.scale[:, None]
