"""Counting how often each level of a field is evaluated."""

from __future__ import annotations

from torch import Tensor

from ..neural_fields import Field, Jet, MultiscaleSDF

__all__ = ["Counted", "counted"]


class Counted(Field):
    """A level that counts the rows it evaluates.

    Attributes:
        values: rows evaluated without their gradient.
        jets: rows evaluated with it.
    """

    def __init__(self, inner: Field) -> None:
        super().__init__()
        self.inner, self.in_dim, self.num_levels = inner, inner.in_dim, inner.num_levels
        self.values = self.jets = 0
        self.register_buffer("deltas", inner.deltas)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.values += x.shape[:-1].numel()
        return self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        self.jets += x.shape[:-1].numel()
        return self.inner.jet(x, level=level)


def counted(field: Field) -> tuple[Field, list[Counted]]:
    """The field with counters in the place of its levels; the levels themselves are shared, not copied."""
    if not isinstance(field, MultiscaleSDF):
        whole = Counted(field)
        return whole, [whole]
    levels = [Counted(level) for level in (field.base, *field.residuals) if isinstance(level, Field)]
    return MultiscaleSDF(levels[0], levels[1:], field.deltas, taper=field.taper), levels
