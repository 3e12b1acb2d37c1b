"""Fields of space and time, and their slices, which are three-dimensional fields again.

A point of space-time is (x, y, z, t) with t in [0, 1]. Tracer, mesher and viewer take a slice.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..fields.field import Field, Jet, SecondJet, Wrapper, solid
from ..networks.multiscale import MultiscaleSDF, levels_of
from ..networks.siren import Siren


class SpaceTimeJet(NamedTuple):
    """A field at some points of space-time, with the derivatives by space and by time apart.

    Attributes:
        position: ``(..., 3)``.
        time: ``(...,)``.
        value: ``(...,)`` f(x, t), negative inside.
        gradient: ``(..., 3)`` ∇f, by space alone; not normalised.
        rate: ``(...,)`` ∂f/∂t; the surface moves along its normal with the speed −rate / |∇f|.
        features: ``(..., F)``.
        hessian: ``(..., 3, 3)`` second derivatives by space, or ``(..., 0, 0)`` in a jet of order 1.
    """

    position: Tensor
    time: Tensor
    value: Tensor
    gradient: Tensor
    rate: Tensor
    features: Tensor
    hessian: Tensor


def spacetime_jet(field: Field, x: Tensor, *, level: int = -1, order: int = 1) -> SpaceTimeJet:
    """Evaluate a four-dimensional field at ``x`` ``(..., 4)``, with second derivatives by space if ``order`` is 2.

    ValueError if the field is not four-dimensional, a shape does not fit, or ``order`` is neither 1 nor 2.
    """
    check_spacetime(field)
    if order not in (1, 2):
        raise ValueError(f"order={order}: expected 1 or 2")
    if order == 1:
        jet = field.jet(x, level=level)
        hessian = x.new_empty((*x.shape[:-1], 0, 0))
    else:
        *jet, hessian = field.second_jet(x, level=level, dims=3)
    value, gradient, features = jet
    return SpaceTimeJet(x[..., :3], x[..., 3], value, gradient[..., :3], gradient[..., 3], features, hessian)


def at_time(x: Tensor, t: Tensor | float) -> Tensor:
    """Points ``(..., 3)`` at a time, or each at its own ``(...,)``, as points ``(..., 4)`` of space-time."""
    time = (t.to(x) if isinstance(t, Tensor) else x.new_full((), t)).expand(x.shape[:-1])
    return torch.cat((x, time[..., None]), dim=-1)


class SpaceTimeSDF(Wrapper):
    """A multiscale signed distance field that moves: bands and residuals live in space-time.

    It wraps a four-dimensional `MultiscaleSDF`, whose bands |f_i(x, t)| < δ_i travel with the surface. ValueError for a
    field of another dimension.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import SpaceTimeSDF, TimeSlice
        >>> field = SpaceTimeSDF.from_widths([(64, 2), (128, 2)], omegas=[15, 30])
        >>> TimeSlice(field, 0.5).jet(torch.zeros(7, 3)).gradient.shape
        torch.Size([7, 3])
    """

    def __init__(self, sdf: MultiscaleSDF) -> None:
        super().__init__()
        check_spacetime(sdf)
        self.sdf = sdf
        self.in_dim, self.num_levels = 4, sdf.num_levels

    @property
    def field(self) -> Field:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The four-dimensional field."""
        return self.sdf

    @classmethod
    def from_widths(cls, sizes: Sequence[tuple[int, int]], *, omegas: Sequence[float], **options: Any) -> SpaceTimeSDF:
        """Untrained levels; the arguments are those of `MultiscaleSDF.from_widths`."""
        return cls(MultiscaleSDF.from_widths(sizes, omegas=omegas, in_dim=4, **options))

    @classmethod
    def from_static(cls, field: Field) -> SpaceTimeSDF:
        """A field of space-time that equals a static one at all times, ready to be trained.

        ``field`` is a three-dimensional `Siren` or a `MultiscaleSDF` of them; ValueError for another kind. Its weights
        are copied, and those of t start at zero.
        """
        field = solid(field)
        taper = field.taper if isinstance(field, MultiscaleSDF) else 0.0
        lifted: list[Field] = []
        for level in levels_of(field):
            if not isinstance(level, Siren):
                raise ValueError(f"a level of the field is a {type(level).__name__}; expected a Siren")
            lifted.append(_lift(level))
        return cls(_assembled(lifted, field.deltas, taper).to(field.like))

    def with_level(self, residual: Field, *, delta: float) -> SpaceTimeSDF:
        """This field with one more level inside ``|f_last| < delta``; see `MultiscaleSDF.with_level`."""
        return SpaceTimeSDF(self.sdf.with_level(residual, delta=delta))

    @torch.no_grad()
    def at(self, t: float) -> MultiscaleSDF:
        """The field of one moment: a frozen static copy that can be saved like any other.

        The time goes into the biases of the first layers, b + t W_t, so a point costs as much as in three dimensions. A
        `TimeSlice` instead follows a field in training.
        """
        levels = [_slice(level, t) for level in self.sdf.levels]
        return _assembled(levels, self.sdf.deltas, self.sdf.taper).requires_grad_(False)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the last entry of the gradient is ∂f/∂t."""
        return self.sdf.jet(x, level=level)

    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """See `Field.second_jet`."""
        return self.sdf.second_jet(x, level=level, dims=dims)


class TimeSlice(Wrapper):
    """The three-dimensional field f(·, t) of a four-dimensional one, which is shared, not copied.

    It follows the field's training. Gradients reach the field, and a time that is a scalar tensor. ValueError if the
    field is not four-dimensional, or ``t`` is not one number.
    """

    defined_by = ("t",)

    def __init__(self, field: Field, t: Tensor | float) -> None:
        super().__init__()
        check_spacetime(field)
        if isinstance(t, Tensor) and t.ndim:
            raise ValueError(f"t has shape {tuple(t.shape)}; expected one number")
        self.field, self.t = field, t
        self.in_dim, self.num_levels = 3, field.num_levels

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the gradient is that by space (see `spacetime_jet`)."""
        value, gradient, features = self.field.jet(self._home(x), level=level)
        return Jet(value, gradient[..., :3], features)

    def second_jet(self, x: Tensor, *, level: int = -1, dims: int | None = None) -> SecondJet:
        """See `Field.second_jet`."""
        dims = self.resolve_dims(dims)
        value, gradient, features, hessian = self.field.second_jet(self._home(x), level=level, dims=dims)
        return SecondJet(value, gradient[..., :3], features, hessian)

    def spacetime_jet(self, x: Tensor, *, level: int = -1, order: int = 1) -> SpaceTimeJet:
        """Value and all derivatives at ``x`` ``(..., 3)``; see `spacetime_jet`."""
        return spacetime_jet(self.field, self._home(x), level=level, order=order)

    def _home(self, x: Tensor) -> Tensor:
        return at_time(self.check_points(x), self.t)


def check_spacetime(field: Field) -> None:
    """Raise ValueError for a field that is not four-dimensional."""
    if field.in_dim != 4:
        raise ValueError(f"field.in_dim={field.in_dim}: expected a field of space-time, four-dimensional")


def _assembled(levels: list[Field], deltas: Tensor, taper: float) -> MultiscaleSDF:
    sdf = MultiscaleSDF(levels[0], levels[1:], deltas, taper=taper)
    sdf.deltas = deltas.clone()  # in its own precision and place
    return sdf


def _slice(field: Field, t: float) -> Field:
    """A frozen copy of one level with its time fixed."""
    if not isinstance(field, Siren):
        return TimeSlice(copy.deepcopy(field), t)
    # A copy whose first layer is cut down: building a new one would draw random numbers only to overwrite them.
    siren = copy.deepcopy(field)
    first = siren.layers[0]
    assert isinstance(first, nn.Linear)
    weight, bias = first.weight, first.bias
    first.bias = nn.Parameter(bias + t * weight[:, 3])
    first.weight = nn.Parameter(weight[:, :3].clone())
    first.in_features = siren.in_dim = 3
    return siren


@torch.no_grad()
def _lift(siren: Siren) -> Siren:
    """The same function of (x, y, z, t)."""
    siren = copy.deepcopy(siren).requires_grad_(True)
    siren.set_units()
    first = siren.layers[0]
    assert isinstance(first, nn.Linear)
    first.weight = nn.Parameter(nn.functional.pad(first.weight, (0, 1)))
    first.in_features = siren.in_dim = 4
    return siren
