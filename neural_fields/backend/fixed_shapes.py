"""Evaluations whose shapes follow from those of the points alone, so that the host never waits for the device.

The number of rows in a band is known only on the device. A CPU gathers exactly these rows; a GPU would have to finish
all its work first. Inside `fixed_shapes` a band has room for a given number of rows instead. The first ones in it are
found by prefix sums; places that are left over are computed and thrown away.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor


class FixedShapes:
    """How much room bands have, and who found none.

    Attributes:
        capacity: rows for each residual level, coarse to fine; None, and levels beyond the last, have room for all.
        wanted: ``(N,)`` bool, the points whose values anybody will read; None for all. Others get a coarse value.
        demand: for each residual level that was evaluated, the most points that were in its band, 0-dimensional int64.
        lost: ``(N,)`` bool of the last evaluation, the points that found no room in a band: they have the value of a
            coarser level. None where there was room for all. Of a field of fields (`Union`, …), in a band of any part.
        rooms: how many rows each choice by `chosen` has room for; those without a name here for all.
        asked: by the same names, how many rows were to be chosen, 0-dimensional int64.
    """

    def __init__(
        self,
        capacity: Sequence[int] | None = None,
        wanted: Tensor | None = None,
        rooms: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self.capacity, self.wanted, self.rooms = capacity, wanted, rooms
        self.demand: list[Tensor] = []
        self.asked: dict[str, Tensor] = {}
        self.lost: Tensor | None = None
        self._under_way = False

    def begin(self) -> None:
        """Forget who was lost: a new evaluation begins, unless it is part of another."""
        if not self._under_way:
            self.lost = None

    @contextmanager
    def whole(self) -> Iterator[None]:
        """What is evaluated inside this is one evaluation."""
        self.begin()
        before, self._under_way = self._under_way, True
        try:
            yield
        finally:
            self._under_way = before

    def admit(self, index: int, inside: Tensor) -> tuple[Tensor, Tensor | None]:
        """Let points into the band of a residual level.

        Args:
            index: of the residual, from 0.
            inside: ``(N,)`` bool, who lies in the band.

        Returns:
            ``(N,)`` bool, who found room; and their rows ``(C,)``, those left over being N; None if there is room for
            all, so that every point may be evaluated where it is.
        """
        count = inside.sum()
        if index < len(self.demand):
            self.demand[index] = torch.maximum(self.demand[index], count)
        else:
            self.demand.append(count)
        room = len(inside) if self.capacity is None or index >= len(self.capacity) else self.capacity[index]
        if room >= len(inside):
            return inside, None
        admitted = inside & (inside.cumsum(0) <= room)
        turned_away = inside & ~admitted
        self.lost = turned_away if self.lost is None else self.lost | turned_away
        return admitted, first_rows(admitted, room)


class Rows(NamedTuple):
    """Some rows of tensors ``(N, …)``, and the way to them and back.

    Attributes:
        places: ``(K,)`` their numbers; places that are left over have N.
        total: N.
        full: whether none can be left over.
    """

    places: Tensor
    total: int
    full: bool

    def of(self, tensor: Tensor) -> Tensor:
        """``(N, …)`` → ``(K, …)``; places that are left over get the last row, and whatever they find is lost."""
        return tensor[self.places] if self.full else tensor.index_select(0, self.places.clamp(max=self.total - 1))

    def back(self, found: Tensor) -> Tensor:
        """``(K, …)`` → ``(N, …)``, 0 in rows that were not chosen."""
        blank = found.new_zeros(self.total if self.full else self.total + 1, *found.shape[1:])
        filled = blank.index_copy(0, self.places, found)
        return filled if self.full else filled[: self.total]

    @property
    def used(self) -> Tensor:
        """``(K,)`` bool, False for places that are left over."""
        return self.places < self.total

    @contextmanager
    def wanted(self) -> Iterator[None]:
        """Inside this, fields let none of the places that are left over into a band."""
        shapes = current_shapes()
        if shapes is None or self.full:
            yield
            return
        before, shapes.wanted = shapes.wanted, self.used
        try:
            yield
        finally:
            shapes.wanted = before


def chosen(name: str, mask: Tensor) -> Rows:
    """The rows of ``mask`` ``(N,)`` that are True; with a given room inside `fixed_shapes`.

    Args:
        name: of the choice, for `FixedShapes.rooms`.
        mask: bool, N ≥ 1.
    """
    shapes = current_shapes()
    if shapes is None:
        return Rows(mask.nonzero()[:, 0], len(mask), full=True)
    shapes.asked[name] = mask.sum()
    room = min(shapes.rooms.get(name, len(mask)), len(mask))
    return Rows(first_rows(mask, room), len(mask), full=False)


_shapes: ContextVar[FixedShapes | None] = ContextVar("shapes", default=None)


@contextmanager
def fixed_shapes(
    capacity: Sequence[int] | None = None, *, rooms: Mapping[str, int] = MappingProxyType({})
) -> Iterator[FixedShapes]:
    """Inside this, a `MultiscaleSDF` never makes the host wait, and launches the same kernels for any points.

    Without a ``capacity`` every level is evaluated at every point, and used where it lies in the band. Results are the
    usual ones but for rounding. With capacities, check ``lost``. The arguments are those of `FixedShapes`.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import MultiscaleSDF
        >>> from mplicits.neural_fields.backend.fixed_shapes import fixed_shapes
        >>> sdf = MultiscaleSDF.from_widths([(16, 1), (16, 1)], omegas=[5, 10])
        >>> x = torch.zeros(4, 3)
        >>> with fixed_shapes():
        ...     value = sdf.value(x)
        >>> bool((value - sdf.value(x)).abs().max() < 1e-6)
        True
    """
    shapes = FixedShapes(capacity, rooms=rooms)
    token = _shapes.set(shapes)
    try:
        yield shapes
    finally:
        _shapes.reset(token)


def current_shapes() -> FixedShapes | None:
    """Those of the innermost `fixed_shapes`; None outside of any."""
    return _shapes.get()


def one_evaluation() -> AbstractContextManager[None]:
    """Inside this, fields that are asked one after the other, at the same points, count as one."""
    shapes = current_shapes()
    return nullcontext() if shapes is None else shapes.whole()


def first_rows(mask: Tensor, count: int) -> Tensor:
    """The first ``count`` rows of ``mask`` ``(N,)`` that are True, in order; N where there are fewer → ``(count,)``.

    What `nonzero` gives, in a shape that is known before: each row goes to where the sum of those before it says.
    """
    place = torch.where(mask, mask.cumsum(0) - 1, count).clamp(max=count)
    rows = torch.full((count + 1,), len(mask), dtype=torch.int64, device=mask.device)
    return rows.scatter_(0, place, torch.arange(len(mask), device=mask.device))[:count]
