"""``Field`` with its ``Jet`` and ``SecondJet``: the one interface of geometry; and fields of any function of points."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ..backend.devices import uncompiled


class Jet(NamedTuple):
    """Value, gradient and features of a field at some points (its 1-jet).

    Attributes:
        value: ``(...,)`` signed distance, negative inside; ``(..., 3)`` for a colour field.
        gradient: ``(..., d)``, or ``(..., 3, d)`` for a colour field; not normalised.
        features: ``(..., F)`` extra outputs; F may be 0.
    """

    value: Tensor
    gradient: Tensor
    features: Tensor


class SecondJet(NamedTuple):
    """A `Jet` of a scalar field with ``hessian`` ``(..., k, k)``, second derivatives by the first k coordinates."""

    value: Tensor
    gradient: Tensor
    features: Tensor
    hessian: Tensor


class Field(nn.Module, ABC):
    """A function of space, known by its value and its analytic gradient, at one or more levels of detail.

    Levels count from 0, coarse to fine (level i is the paper's f_{i+1}); ``level=-1`` is the finest. Each level but the
    last has a band, ``|f_i(x)| < deltas[i]``, outside which the next level adds nothing. A subclass implements `value`
    and `jet`. Called as a module, a field returns its value.

    Attributes:
        in_dim: dimension d of the domain, 3, or 4 for (x, y, z, t).
        num_levels: how many levels of detail the field has.
        deltas: ``(num_levels - 1,)`` half-widths of the bands, in field units; infinite where the next level is an
            alternative and not a refinement.
        defined_by: names of the attributes that decide the function beside its tensors; see `definition`.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Field, Jet, sphere_trace
        >>> class Ball(Field):
        ...     def value(self, x, *, level=-1):
        ...         return x.norm(dim=-1) - 0.5
        ...
        ...     def jet(self, x, *, level=-1):
        ...         return Jet(self.value(x), x / x.norm(dim=-1, keepdim=True), x[..., :0])
        >>> Ball()(torch.tensor([[0.0, 0.0, 2.0]]))
        tensor([1.5000])
        >>> bool(sphere_trace(Ball(), torch.tensor([0.0, 0.0, 2.0]), torch.tensor([0.0, 0.0, -1.0])).mask)
        True
    """

    in_dim: int = 3
    num_levels: int = 1
    deltas: Tensor
    defined_by: ClassVar[tuple[str, ...]] = ()

    def __init__(self) -> None:
        super().__init__()
        if not hasattr(type(self), "deltas"):  # a wrapper has those of the field that it wraps
            self.register_buffer("deltas", torch.empty(0), persistent=False)
        self.register_state_dict_post_hook(_keep_definition)
        self.register_load_state_dict_pre_hook(_check_definition)

    @abstractmethod
    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """Evaluate the field at ``x`` ``(..., d)`` → ``(...,)``.

        Raises:
            ValueError: the last dimension of ``x`` is not ``in_dim``, or there is no such level.
        """

    @abstractmethod
    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """Evaluate value and gradient at ``x`` ``(..., d)``; errors as in `value`.

        The gradient is analytic and itself differentiable with respect to parameters and ``x``.
        """

    def value_features(self, x: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
        """Value ``(...,)`` and features ``(..., F)`` at ``x`` ``(..., d)``, without the gradient; errors as in `value`.

        This default takes them from a jet; networks have them for the price of a value.
        """
        jet = self.jet(x, level=level)
        return jet.value, jet.features

    def forward(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `value`."""
        return self.value(x, level=level)

    def definition(self) -> Mapping[str, Any]:
        """What decides the function beside its tensors, by name; part of ``repr`` and of state dicts."""
        return {name: getattr(self, name) for name in self.defined_by}

    def extra_repr(self) -> str:
        """The `definition`, and the bands."""
        shown = dict(self.definition())
        if len(self.deltas):
            shown["deltas"] = [float(f"{delta:.6g}") for delta in self.deltas.tolist()]
        return ", ".join(f"{name}={value!r}" for name, value in shown.items())

    @uncompiled
    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """Evaluate value, gradient and Hessian at ``x`` ``(..., d)``.

        Differentiable with respect to parameters and ``x``. This default differentiates the analytic gradient once with
        autograd; SIRENs have their own closed form.

        Args:
            x: ``(..., d)``.
            level: as in `value`.
            dims: second derivatives by the first ``dims`` coordinates, by default all; 3 leaves time out.

        Raises:
            ValueError: as in `value`, or ``dims`` is not in 1 … d.
        """
        dims = self.resolve_dims(dims)
        recorded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in [x, *self.parameters()])
        with torch.inference_mode(False), torch.enable_grad():
            y = self.check_points(x).clone()
            y = y if y.requires_grad else y.requires_grad_()
            jet = self.jet(y, level=level)
            hessian = y.new_zeros(*y.shape[:-1], dims, dims)
            if jet.gradient.requires_grad:  # that of a plane depends on nothing
                columns = [
                    torch.autograd.grad(jet.gradient[..., k].sum(), y, create_graph=True, materialize_grads=True)[0]
                    for k in range(dims)
                ]
                hessian = torch.stack([column[..., :dims] for column in columns], dim=-1)
        result = SecondJet(*jet, hessian)
        return result if recorded else SecondJet(*(part.detach() for part in result))

    @property
    def like(self) -> Tensor:
        """A tensor on the field's device and in its precision: ``points.to(field.like)``."""
        return next(self.parameters(), self.deltas)

    @property
    def same_rows(self) -> bool:
        """Whether every field inside this one is evaluated at the same rows, in the same order.

        Tracing on a GPU is faster then. By default true for a field without other fields inside. A wrapper that
        evaluates others at every point may return true.
        """
        return sum(isinstance(module, Field) for module in self.modules()) == 1

    def slope_bound(self, slope: float) -> float:
        """A bound on |∇f|, if that of every network or closed form inside is at most ``slope``."""
        parts = (module for module in self.modules() if isinstance(module, Field) and module is not self)
        return max((part.slope_bound(slope) for part in parts), default=slope)

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """Values ``(...,)`` of all levels up to ``level`` at ``x`` ``(..., d)``, coarse to fine.

        This default evaluates level after level; a field whose levels build on each other evaluates each once.
        """
        return [self.value(x, level=each) for each in range(self.resolve_level(level) + 1)]

    def in_band(self, x: Tensor, *, level: int) -> Tensor:
        """Whether ``level`` may be evaluated at ``x`` ``(..., d)`` → bool ``(...,)``; errors as in `value`.

        True where every coarser level has ``|f_i(x)| < deltas[i]``, and everywhere for level 0.
        """
        inside = torch.ones(self.check_points(x).shape[:-1], dtype=torch.bool, device=x.device)
        level = self.resolve_level(level)
        coarser = self.level_values(x, level=level - 1) if level else []
        for value, delta in zip(coarser, self.deltas, strict=False):
            inside = inside & (value.abs() < delta)
        return inside

    def resolve_level(self, level: int) -> int:
        """Turn a level counted from either end into one counted from 0.

        Raises:
            ValueError: there is no such level.
            TypeError: it is not a whole number.
        """
        if not isinstance(level, int):
            try:
                level = operator.index(level)
            except TypeError:
                raise TypeError(f"level={level!r}: expected a whole number") from None
        if not -self.num_levels <= level < self.num_levels:
            raise ValueError(f"level={level}: this field has levels 0 to {self.num_levels - 1} (or -1 for the finest)")
        return level % self.num_levels

    def resolve_dims(self, dims: int | None) -> int:
        """The number of coordinates of second derivatives, all for None; ValueError outside 1 … d."""
        if dims is not None and not 1 <= dims <= self.in_dim:
            raise ValueError(f"dims={dims}: expected 1 to {self.in_dim}")
        return self.in_dim if dims is None else dims

    def check_points(self, x: Tensor) -> Tensor:
        """Return ``x`` if its shape is ``(..., in_dim)``; else raise ValueError, or TypeError for no tensor."""
        if not isinstance(x, Tensor):
            raise TypeError(f"x is a {type(x).__name__}; expected a tensor (..., {self.in_dim}): torch.as_tensor(x)")
        if x.ndim == 0 or x.shape[-1] != self.in_dim:
            raise ValueError(f"x has shape {tuple(x.shape)}; expected (..., {self.in_dim})")
        return x


def _keep_definition(field: Field, _state: object, _prefix: str, metadata: dict[str, Any]) -> None:
    """Keep the definition in the state dict's metadata, in types that ``weights_only=True`` loads."""
    metadata["definition"] = plain(field.definition())


def _check_definition(field: Field, _state: object, prefix: str, metadata: Mapping[str, Any], *others: Any) -> None:
    """Refuse tensors of another function than this one; a dict without metadata is not checked."""
    here = plain(field.definition())
    there, errors = metadata.get("definition", here), others[-1]
    errors += [
        f"{prefix}{name} is {there.get(name)!r} where the tensors come from and {here.get(name)!r} here: "
        "the same tensors would be another function"
        for name in sorted({*here, *there})
        if here.get(name) != there.get(name)
    ]


def plain(value: Any) -> Any:
    """Numbers, words and their containers as Python's own types; anything else as its ``repr``."""
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Real):
        return float(value)
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    return tuple(map(plain, value)) if isinstance(value, tuple | list) else repr(value)


class OneLevelField(Field):
    """A field with one level of detail and without bands, of dimension ``in_dim``."""

    def __init__(self, in_dim: int = 3) -> None:
        super().__init__()
        self.in_dim = in_dim


class Wrapper(Field):
    """A field evaluated through another one, ``field``, whose levels and bands it has; a subclass defines the jet."""

    field: Field

    @property
    def same_rows(self) -> bool:
        """Whether it holds for the field inside."""
        return self.field.same_rows

    @property
    def deltas(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Half-widths of the bands of the field inside."""
        return self.field.deltas

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.field.value(self._home(x), level=level)

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """See `Field.level_values`."""
        return self.field.level_values(self._home(x), level=level)

    def _home(self, x: Tensor) -> Tensor:
        """The points at which the field inside is evaluated."""
        return x


# Accepted where a field is expected: a field, or any function of points ``(..., 3)`` → ``(...,)``.
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
        """The function and the dimension of its domain."""
        return f"function={getattr(self.function, '__qualname__', type(self.function).__name__)}, in_dim={self.in_dim}"

    @property
    def same_rows(self) -> bool:
        """False: the function may evaluate other fields at any points."""
        return False

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; ValueError if the function does not return one number for each point."""
        self.resolve_level(level)
        found = self.function(self.check_points(x))
        if not isinstance(found, Tensor) or found.shape != x.shape[:-1]:
            got = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise ValueError(f"function: returned {got} for points {tuple(x.shape)}; expected {tuple(x.shape[:-1])}")
        return found

    @uncompiled
    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; one pass forward and one back."""
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
    """The field itself, or a `FunctionField` of a callable; TypeError for anything else."""
    if isinstance(field, Field):
        return field
    if not callable(field):
        raise TypeError(f"field: got a {type(field).__name__}; expected a Field, or a function of points (..., 3)")
    return FunctionField(field)


def solid(field: FieldLike) -> Field:
    """`as_field`; ValueError for a field that is not three-dimensional."""
    field = as_field(field)
    if field.in_dim != 3:
        raise ValueError(f"field.in_dim={field.in_dim}: expected 3 (fix the time of a field in space-time first)")
    return field
