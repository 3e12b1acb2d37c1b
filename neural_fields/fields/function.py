"""A field from any function of points: closed forms, lambdas, other people's networks."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .field import Field, Jet

__all__ = ["FieldLike", "FunctionField", "as_field"]

# What is taken where a field is expected: a field, or any function of points ``(..., 3)`` → ``(...,)``.
FieldLike = Field | Callable[[Tensor], Tensor]


class FunctionField(Field):
    """``f(x) = function(x)``; the gradient comes from autograd.

    Args:
        function: points ``(..., d)`` → signed distances ``(...,)``, negative inside, in torch operations. A module is
            registered, so that its parameters are this field's.
        in_dim: dimension d of the domain.

    Raises:
        TypeError: ``function`` cannot be called.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import FunctionField
        >>> ball = FunctionField(lambda x: x.norm(dim=-1) - 0.5)
        >>> ball.jet(torch.tensor([1.0, 0.0, 0.0])).gradient
        tensor([1., 0., 0.])
    """

    def __init__(self, function: Callable[[Tensor], Tensor], *, in_dim: int = 3) -> None:
        super().__init__()
        if not callable(function):
            raise TypeError(f"function: got a {type(function).__name__}; expected one of points (..., {in_dim})")
        self.function, self.in_dim = function, in_dim

    def extra_repr(self) -> str:
        """What is called, and the dimension of its domain."""
        return f"function={getattr(self.function, '__qualname__', type(self.function).__name__)}, in_dim={self.in_dim}"

    @property
    def same_rows(self) -> bool:
        """False: the function may evaluate other fields at any points."""
        return False

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`.

        Raises:
            ValueError: the function does not return one number for each point.
        """
        self.resolve_level(level)
        found = self.function(self.check_points(x))
        if not isinstance(found, Tensor) or found.shape != x.shape[:-1]:
            got = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise ValueError(f"function: returned {got} for points {tuple(x.shape)}; expected {tuple(x.shape[:-1])}")
        return found

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; one pass forward and one back.

        Raises:
            ValueError: see `value`.
        """
        recorded = torch.is_grad_enabled() and (x.requires_grad or any(p.requires_grad for p in self.parameters()))
        with torch.inference_mode(False), torch.enable_grad():
            y = self.check_points(x)
            y = y if y.requires_grad and recorded else y.detach().clone().requires_grad_()
            value = self.value(y, level=level)
            gradient = torch.zeros_like(y)
            if value.requires_grad:  # a constant depends on nothing
                (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=recorded, materialize_grads=True)
        if not recorded:
            value, gradient = value.detach(), gradient.detach()
        return Jet(value, gradient, x.new_empty((*x.shape[:-1], 0)))


def as_field(field: FieldLike) -> Field:
    """The field itself, or a `FunctionField` of what can be called.

    Raises:
        TypeError: it is neither.

    Example:
        >>> import torch
        >>> as_field(lambda x: x.norm(dim=-1) - 0.5)(torch.ones(1, 3)) > 0
        tensor([True])
    """
    if isinstance(field, Field):
        return field
    if not callable(field):
        raise TypeError(f"field: got a {type(field).__name__}; expected a Field, or a function of points (..., 3)")
    return FunctionField(field)
