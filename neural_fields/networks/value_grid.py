"""Values of a field on the vertices of a grid, kept while the field is trained, to find its surface cheaply."""

from __future__ import annotations

import torch
from torch import Tensor

from ..backend.errors import at_least, positive
from ..fields.field import Field


class ValueGrid:
    """A level's values at (resolution + 1)³ vertices of the cube [−1, 1]³, trilinear in between.

    For second derivatives along lines of at most K the interpolation is off by 3/8 K h², h = 2 / resolution, plus the
    field's change since `refresh`.

    Attributes:
        reach: a partial `refresh` evaluates vertices whose value is at most this far from 0; at least a cell's
            diagonal.
        kept: ``(resolution + 1, resolution + 1, resolution + 1)`` values, by x, y and z; 1 where none was evaluated.
        moved: 0-d, root mean square change of the values within ``reach`` of 0 by the last `refresh`; ∞ if there were
            none.
    """

    def __init__(self, resolution: int = 64, device: torch.device | None = None, *, reach: float = 0.15) -> None:
        at_least(1, resolution=resolution)
        positive(reach=reach)
        self.resolution, self.reach = resolution, reach
        count = resolution + 1
        self.kept = torch.ones(count, count, count, device=device)
        self.moved = torch.tensor(torch.inf, device=device)

    @torch.no_grad()
    def refresh(self, field: Field, *, level: int = 0, whole: bool = True) -> None:
        """Evaluate a level of a field, in unit-sphere coordinates, at the vertices again.

        If ``whole``, at all vertices of cells in the unit ball; otherwise only near the kept surface.
        """
        near = self.kept.abs() <= self.reach
        edge = 2 / self.resolution
        axis = torch.linspace(-1, 1, self.resolution + 1, device=self.kept.device)
        if whole:
            squared = axis.square()
            length = (squared[:, None, None] + squared[:, None] + squared).sqrt()
            asked = length <= 1 + 3**0.5 * edge
        else:
            asked = near
        cells = asked.nonzero()
        flat = self.kept.view(-1)
        squares = flat.new_zeros(())
        for part in cells.split(1 << 15):
            x, y, z = part.unbind(dim=1)
            place = (x * len(axis) + y) * len(axis) + z
            before, now = flat[place], field.value(axis[part], level=level).to(flat)
            squares += torch.where(before.abs() <= self.reach, (now - before).square(), 0.0).sum()
            flat.index_copy_(0, place, now)
        count = near.sum()
        self.moved = torch.where(count > 0, (squares / count.clamp(min=1)).sqrt(), torch.inf)

    def __call__(self, x: Tensor) -> Tensor:
        """Interpolated values ``(...,)`` of points ``(..., 3)``; outside the cube, the value at its nearest point."""
        points = x.reshape(-1, 3)
        count = self.resolution + 1
        at = (points.clamp(-1, 1) + 1) * (0.5 * self.resolution)
        cell = at.floor().clamp(max=self.resolution - 1)
        u, v, w = (at - cell).unbind(dim=1)
        i, j, k = cell.long().unbind(dim=1)
        first, flat = (i * count + j) * count + k, self.kept.view(-1)

        def edge(offset: int) -> Tensor:
            """Between the two vertices along z."""
            return torch.lerp(flat[first + offset], flat[first + offset + 1], w)

        near = torch.lerp(edge(0), edge(count), v)
        far = torch.lerp(edge(count * count), edge(count * count + count), v)
        return torch.lerp(near, far, u).reshape(x.shape[:-1])
