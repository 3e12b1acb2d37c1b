"""Evaluations whose shapes follow from those of the points alone, so that the host never waits for the device.

A band has capacity for a given number of rows: prefix sums find the first of them, surplus places are discarded.
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
    """Fixed buffer capacity per band, and a mask of rows that overflowed.

    Attributes:
        capacity: rows for each residual level, coarse to fine; None, and levels beyond the last: all rows.
        mask: ``(N,)`` bool, points whose values are used; None for all. Others get a coarse value.
        requested: per residual level, the largest number of points in its band so far, 0-d int64.
        overflow: ``(N,)`` bool of the last evaluation, or None: points that exceeded a band's capacity, and have a
            coarser level's value.
        named_capacity: capacity of each selection by `chosen`; without a name here, all rows.
        named_requested: by the same names, how many rows were to be chosen, 0-d int64.
    """

    def __init__(
        self,
        capacity: Sequence[int] | None = None,
        mask: Tensor | None = None,
        named_capacity: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self.capacity, self.mask, self.named_capacity = capacity, mask, named_capacity
        self.requested: list[Tensor] = []
        self.named_requested: dict[str, Tensor] = {}
        self.overflow: Tensor | None = None
        self._under_way = False

    def begin(self) -> None:
        """Reset ``overflow`` at the start of an evaluation that is not part of another."""
        if not self._under_way:
            self.overflow = None

    @contextmanager
    def whole(self) -> Iterator[None]:
        """All evaluations inside count as one."""
        self.begin()
        before, self._under_way = self._under_way, True
        try:
            yield
        finally:
            self._under_way = before

    def admit(self, index: int, inside: Tensor) -> tuple[Tensor, Tensor | None]:
        """Admit the points ``inside`` ``(N,)`` to the band of residual ``index``.

        Returns the mask of those admitted, and their rows ``(C,)``, surplus ones being N; None for rows if capacity
        suffices for all, so that every point may be evaluated in place.
        """
        count = inside.sum()
        if index < len(self.requested):
            self.requested[index] = torch.maximum(self.requested[index], count)
        else:
            self.requested.append(count)
        capacity = len(inside) if self.capacity is None or index >= len(self.capacity) else self.capacity[index]
        if capacity >= len(inside):
            return inside, None
        admitted = inside & (inside.cumsum(0) <= capacity)
        rejected = inside & ~admitted
        self.overflow = rejected if self.overflow is None else self.overflow | rejected
        return admitted, first_rows(admitted, capacity)


class Rows(NamedTuple):
    """Some rows of tensors ``(N, …)``."""

    places: Tensor  # (K,) their numbers, N for surplus places
    total: int  # N
    full: bool  # whether no place is surplus

    def of(self, tensor: Tensor) -> Tensor:
        """``(N, …)`` → ``(K, …)``; surplus places get the last row."""
        return tensor[self.places] if self.full else tensor.index_select(0, self.places.clamp(max=self.total - 1))

    def back(self, values: Tensor) -> Tensor:
        """``(K, …)`` → ``(N, …)``, 0 in rows that were not chosen."""
        blank = values.new_zeros(self.total if self.full else self.total + 1, *values.shape[1:])
        filled = blank.index_copy(0, self.places, values)
        return filled if self.full else filled[: self.total]

    @property
    def used(self) -> Tensor:
        """``(K,)`` bool, False for surplus places."""
        return self.places < self.total

    @contextmanager
    def masked(self) -> Iterator[None]:
        """Inside this, fields admit no surplus place to a band."""
        shapes = current_shapes()
        if shapes is None or self.full:
            yield
            return
        before, shapes.mask = shapes.mask, self.used
        try:
            yield
        finally:
            shapes.mask = before


def chosen(name: str, mask: Tensor) -> Rows:
    """The rows of ``mask`` ``(N,)``, N ≥ 1, that are True; inside `fixed_shapes` with the capacity of ``name``."""
    shapes = current_shapes()
    if shapes is None:
        return Rows(mask.nonzero()[:, 0], len(mask), full=True)
    shapes.named_requested[name] = mask.sum()
    capacity = min(shapes.named_capacity.get(name, len(mask)), len(mask))
    return Rows(first_rows(mask, capacity), len(mask), full=False)


_shapes: ContextVar[FixedShapes | None] = ContextVar("shapes", default=None)


@contextmanager
def fixed_shapes(
    capacity: Sequence[int] | None = None, *, named_capacity: Mapping[str, int] = MappingProxyType({})
) -> Iterator[FixedShapes]:
    """Inside this, a `MultiscaleSDF` never makes the host wait, and launches the same kernels for any points.

    Without a ``capacity`` every level is evaluated at every point, and used in its band. Results are equal but for
    rounding. With capacities, check ``overflow``. The arguments are those of `FixedShapes`.
    """
    shapes = FixedShapes(capacity, named_capacity=named_capacity)
    token = _shapes.set(shapes)
    try:
        yield shapes
    finally:
        _shapes.reset(token)


def current_shapes() -> FixedShapes | None:
    """Those of the innermost `fixed_shapes`, or None."""
    return _shapes.get()


def one_evaluation() -> AbstractContextManager[None]:
    """Inside this, evaluations of several fields at the same points count as one."""
    shapes = current_shapes()
    return nullcontext() if shapes is None else shapes.whole()


def first_rows(mask: Tensor, count: int) -> Tensor:
    """The first ``count`` True rows of ``mask`` ``(N,)``, in order, padded with N: `nonzero` in a fixed shape."""
    place = torch.where(mask, mask.cumsum(0) - 1, count).clamp(max=count)
    rows = torch.full((count + 1,), len(mask), dtype=torch.int64, device=mask.device)
    return rows.scatter_(0, place, torch.arange(len(mask), device=mask.device))[:count]
