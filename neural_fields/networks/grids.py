"""Grids: Instant-NGP's multiresolution hash encoding (Müller et al. 2022), and values of a field at grid vertices."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from ..backend.errors import at_least, positive
from ..fields.field import Field

INITIAL = 1e-4  # entries begin uniform in ±INITIAL (Sec. 4)


def grid_resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Cells along a side on each level, ``⌊N_min bˡ⌋`` with ``b = (N_max / N_min)^(1 / (L − 1))`` (Eqs. 2 and 3)."""
    growth = (finest / coarsest) ** (1 / max(1, levels - 1))
    # A power that should be whole may come out a rounding error below.
    return [math.floor(coarsest * growth**level * (1 + 1e-12)) for level in range(levels)]


def spatial_hash(x: Tensor, y: Tensor, z: Tensor, size: int) -> Tensor:
    """``(x π₁ ⊕ y π₂ ⊕ z π₃) mod T`` (Eq. 4, π₁ = 1) of whole coordinates that broadcast; ``size`` is T = 2ⁿ."""
    return (x ^ y * 2_654_435_761 ^ z * 805_459_861) & (size - 1)


def check_table(table_size: int, coarsest: int, finest: int) -> None:
    """Raise ValueError if no hash encoding has these sizes."""
    if table_size < 1 or table_size & (table_size - 1):
        raise ValueError(f"table_size={table_size}: expected a power of two")
    if not 1 <= coarsest <= finest:
        raise ValueError(f"coarsest={coarsest}, finest={finest}: expected 1 ≤ coarsest ≤ finest")


def split_tables(*modules: nn.Module) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The tables of hash encodings among the parameters of modules, and all others, for another learning rate."""
    tables = [part.table for module in modules for part in module.modules() if isinstance(part, HashEncoding)]
    known = {id(table) for table in tables}
    return tables, [p for module in modules for p in module.parameters() if id(p) not in known]


class HashEncoding(nn.Module):
    """Features of positions, piecewise trilinear, learnt with the network that reads them.

    ``levels`` grids (L) from ``coarsest`` (N_min) to ``finest`` (N_max) cells along a side cover the cube ±``extent``.
    Their vertices own table entries of ``features`` (F) numbers: one each where the grid fits into ``table_size`` (T, a
    power of two; Sec. 3), else a shared one by a spatial hash (Eq. 4). Outside the cube its nearest point counts.
    """

    def __init__(
        self,
        *,
        levels: int = 12,
        table_size: int = 1 << 15,
        features: int = 2,
        coarsest: int = 16,
        finest: int = 512,
        extent: float = 1.0,
    ) -> None:
        super().__init__()
        at_least(1, levels=levels, features=features)
        check_table(table_size, coarsest, finest)
        positive(extent=extent)
        self.table_size, self.extent = table_size, float(extent)
        self.resolutions = grid_resolutions(levels, coarsest, finest)
        sizes = [min((resolution + 1) ** 3, table_size) for resolution in self.resolutions]
        self.table = nn.Parameter(torch.empty(sum(sizes), features).uniform_(-INITIAL, INITIAL))
        fits = [(resolution + 1) ** 3 <= table_size for resolution in self.resolutions]
        starts = torch.tensor([0, *sizes[:-1]]).cumsum(0)
        self.register_buffer("cells", torch.tensor(self.resolutions), persistent=False)
        self.register_buffer("starts", starts, persistent=False)
        self.register_buffer("own", torch.tensor(fits), persistent=False)
        self.cells: Tensor
        self.starts: Tensor
        self.own: Tensor

    @classmethod
    def up_to(cls, finest: int, *, extent: float = 1.0) -> HashEncoding:
        """An encoding from 16 cells along a side, or ``finest`` if that is less, to ``finest``."""
        return cls(coarsest=min(16, finest), finest=finest, extent=extent)

    @property
    def size(self) -> int:
        """The number of features of a position."""
        return len(self.resolutions) * self.table.shape[1]

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(..., L F)`` of positions ``(..., 3)``; differentiable by the table and by ``x``.

        In the precision of the table, under ``autocast`` too: half precision cannot place a position in a fine cell.
        """
        with torch.autocast(x.device.type, enabled=False):
            return self._lookup(x.to(self.table.dtype))

    def _lookup(self, x: Tensor) -> Tensor:
        rows = x.reshape(-1, 1, 3)
        cells = self.cells[:, None]
        at = (rows.clamp(-self.extent, self.extent) + self.extent) * (0.5 / self.extent) * cells  # (N, L, 3)
        cell = torch.minimum(at.detach().floor(), cells - 1)
        within = at - cell
        sides = torch.stack((1 - within, within), dim=-1)  # (N, L, 3, 2)
        weights = torch.einsum("nli,nlj,nlk->nlijk", *sides.unbind(dim=2)).flatten(-3)
        found: Tensor = _Lookup.apply(self.table, self._entries(cell.long()), weights)  # pyright: ignore[reportAssignmentType]
        return found.reshape(*x.shape[:-1], self.size)

    def _entries(self, cell: Tensor) -> Tensor:
        """Rows of the table ``(N, L, 8)`` of the vertices of cells ``(N, L, 3)``."""
        both = torch.stack((cell, cell + 1), dim=-1)
        x, y, z = both[:, :, 0, :, None, None], both[:, :, 1, None, :, None], both[:, :, 2, None, None, :]
        edge = (self.cells + 1)[:, None, None, None]
        shared = spatial_hash(x, y, z, self.table_size)
        entries = torch.where(self.own[:, None, None, None], (x * edge + y) * edge + z, shared)
        return (entries + self.starts[:, None, None, None]).flatten(-3)


class _Lookup(torch.autograd.Function):
    """Weighted sums of table rows; PyTorch's own backward takes four times as long, mostly for sorting."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, entries: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(table, entries, weights)
        rows, by_row = entries.flatten(0, 1), weights.flatten(0, 1)
        return nn.functional.embedding_bag(rows, table, per_sample_weights=by_row, mode="sum")

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        table, entries, weights = ctx.saved_tensors
        (slope,) = (cotangent[:, None] for cotangent in cotangents)  # (N L, 1, F)
        by_table = by_weights = None
        if ctx.needs_input_grad[0]:
            shares = (slope * weights.flatten(0, 1)[..., None]).flatten(0, 1)
            by_table = torch.zeros_like(table).index_add_(0, entries.flatten(), shares)
        if ctx.needs_input_grad[2]:
            by_weights = (table[entries.flatten(0, 1)] * slope).sum(dim=2).reshape(weights.shape)
        return by_table, None, by_weights


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
            chosen = length <= 1 + 3**0.5 * edge
        else:
            chosen = near
        cells = chosen.nonzero()
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
        at = x.flip(-1).reshape(1, 1, 1, -1, 3)  # z, y, x
        found = nn.functional.grid_sample(self.kept[None, None], at, padding_mode="border", align_corners=True)
        return found.reshape(x.shape[:-1])
