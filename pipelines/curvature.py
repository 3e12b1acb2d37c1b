"""Mean curvature of a field's level sets."""

from __future__ import annotations

import torch
from torch import Tensor

from ..neural_fields import Field

__all__ = ["mean_curvature"]


@torch.no_grad()
def mean_curvature(field: Field, points: Tensor, *, level: int = -1, step: float = 2e-3) -> Tensor:
    """H = ½ div(∇f / |∇f|) of the level set through each point, by central differences: 1/r on a sphere.

    The unit gradient n changes only within the tangent plane, ⟨n, ∂n⟩ = 0, so that along two tangents a and b

        2 H = ⟨a, n(p + h a) − n(p − h a)⟩ / 2h + ⟨b, n(p + h b) − n(p − h b)⟩ / 2h.

    Convex is positive. The error grows with h² and with (rounding of n) / h.

    Args:
        field: a 3-D field; where its gradient is zero there is no level set, and H is 0.
        points: ``(P, 3)``.
        level: the level to ask.
        step: h; details smaller than it are averaged.

    Raises:
        ValueError: ``step`` is not positive.
    """
    if not step > 0:
        raise ValueError(f"step={step}: expected a number > 0")
    tangents = _tangents(_unit(field.jet(points, level=level).gradient))  # (2, P, 3)
    offsets = step * torch.stack((tangents, -tangents))  # (2, 2, P, 3)
    normals = _unit(field.jet(points + offsets, level=level).gradient)
    return (tangents * (normals[0] - normals[1])).sum((0, -1)) / (4 * step)


def _unit(gradient: Tensor) -> Tensor:
    return torch.nn.functional.normalize(gradient, dim=-1)


def _tangents(n: Tensor) -> Tensor:
    """Two unit tangents ``(2, P, 3)`` across unit normals (Duff et al. 2017, "Building an orthonormal basis")."""
    x, y, z = n.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    second = torch.stack((b, sign + y * y * a, -y), -1)
    return torch.stack((first, second))
