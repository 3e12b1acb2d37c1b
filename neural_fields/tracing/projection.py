"""Neural attribute mapping of the paper (Sec. 3): attributes g of a field f at points p of another surface near f = 0.

g lives in the band ``|f| < δ`` and is constant along the normals of f. Points outside the band are first moved down ∇f.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..fields.field import Field, FieldLike, as_field
from ..networks.texture import TextureField


class Mapped(NamedTuple):
    """Attributes at points.

    Attributes:
        values: ``(..., C)``; zero, or the constant of a texture, at points that were not reached.
        reached: ``(...,)`` bool, whether the point lies in the band or could be moved to the surface.
    """

    values: Tensor
    reached: Tensor


@torch.no_grad()
def project_to_surface(
    field: FieldLike, points: Tensor, *, level: int = -1, steps: int = 10, tolerance: float = 1e-5
) -> tuple[Tensor, Tensor]:
    """Move points to the surface, ``x ← x − f(x) ∇f(x) / |∇f(x)|²`` until ``|f(x)|`` is small.

    Where f is a signed distance, one step lands on the closest point; elsewhere the points follow ∇f.

    Args:
        field: f; or any function of points ``(..., 3)`` → ``(...,)``.
        points: ``(..., d)``, in the field's coordinates.
        level: whose surface.
        steps: most evaluations per point; points that have arrived are left alone.
        tolerance: on ``|f|``, in field units.

    Returns:
        Points ``(..., d)``, and bool ``(...,)``: whether each of them has arrived.

    Raises:
        ValueError: there is no such level, or the dimension is wrong.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, project_to_surface
        >>> project_to_surface(Sphere(radius=0.5), torch.tensor([[0.8, 0.0, 0.0]]))
        (tensor([[0.5000, 0.0000, 0.0000]]), tensor([True]))
    """
    field = as_field(field)
    moved = field.check_points(points).reshape(-1, field.in_dim).clone()
    arrived = torch.zeros(len(moved), dtype=torch.bool, device=moved.device)
    moving = torch.arange(len(moved), device=moved.device)
    for step in range(steps + 1):
        x = moved[moving]
        value, gradient, _ = field.jet(x, level=level)
        near = value.abs() < tolerance
        arrived[moving[near]] = True
        moving = moving[~near]
        if step == steps or not len(moving):
            break
        value, gradient = value[~near, None], gradient[~near]
        slope = gradient.norm(dim=-1, keepdim=True)
        direction = gradient / slope.clamp_min(torch.finfo(slope.dtype).tiny)
        # However flat the field is, a step is never longer than 2 |f|.
        moved[moving] = x[~near] - value * direction / slope.clamp_min(0.5)
    return moved.reshape(points.shape), arrived.reshape(points.shape[:-1])


@torch.no_grad()
def map_attribute(
    field: FieldLike,
    attribute: Callable[[Tensor], Tensor],
    points: Tensor,
    *,
    delta: float,
    level: int = -1,
    batch: int = 1 << 18,
) -> Mapped:
    """The mapping {S, f, g} of the paper at points ``(..., d)`` of any surface S, in the field's coordinates.

    ``attribute`` is g, points ``(N, d)`` of the band → ``(N, C)``; ``delta`` the half-width of the band, in field
    units; ``batch`` points at a time. Errors are those of `project_to_surface`.
    """
    field = as_field(field)
    rows = field.check_points(points).reshape(-1, field.in_dim)
    parts = [_map_rows(field, attribute, part, delta, level) for part in rows.split(batch)]
    values, reached = (torch.cat(both) for both in zip(*parts, strict=True))
    return Mapped(values.reshape(*points.shape[:-1], values.shape[-1]), reached.reshape(points.shape[:-1]))


def map_colors(texture: TextureField, points: Tensor, *, batch: int = 1 << 18) -> Mapped:
    """Neural texture mapping: the colours of a texture at points ``(..., d)`` of any surface near its geometry.

    Colours ``(..., 3)`` of points that were not reached are ``texture.outside``. ``batch`` is points at a time.
    """
    values, reached = map_attribute(
        texture.geometry, texture.colors, points, delta=float(texture.delta), level=texture.geometry_level, batch=batch
    )
    return Mapped(torch.where(reached[..., None], values, texture.outside.to(values)), reached)


def _map_rows(
    field: Field, attribute: Callable[[Tensor], Tensor], rows: Tensor, delta: float, level: int
) -> tuple[Tensor, Tensor]:
    reached = field.value(rows, level=level).abs() < delta
    away = (~reached).nonzero()[:, 0]
    if len(away):
        feet, arrived = project_to_surface(field, rows[away], level=level)
        rows = rows.index_copy(0, away, feet)
        reached = reached.index_copy(0, away, arrived)
    kept = reached.nonzero()[:, 0]
    found = attribute(rows[kept])
    return found.new_zeros(len(rows), found.shape[-1]).index_copy(0, kept, found), reached
