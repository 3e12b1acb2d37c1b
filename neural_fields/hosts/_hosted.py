"""Shared by the adapters: scale, rates, narrowing bands, meshes in the host's units, and a memo of two results."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from ..backend.errors import positive
from ..fields.field import FieldLike, Jet, as_field
from ..fields.similarity import Similarity
from ..meshing._cells import Bounds
from ..meshing.mesh import Mesh
from ..shape import WorldField
from .learning_rates import HOST_RATE, Pace, parameter_groups, rescale_parameters

# The corners of a box, lowest and highest: a tensor or an array ``(2, 3)``, or two triples.
Box = Tensor | Sequence[Sequence[float]]


class Hosted(nn.Module):
    """A field f in a host's units: f(s x) / s, whose gradient is ∇f(s x). ValueError if a number is not positive.

    Arguments are those of `NeuSGeometry`; ``half`` is the half-edge of the box where there are no ``bounds``.
    """

    def __init__(
        self,
        field: FieldLike,
        *,
        scale: float | None,
        bounds: Box | None,
        half: float,
        learning_rate: float | None,
        pace: Pace,
    ) -> None:
        super().__init__()
        box = ((-half, -half, -half), (half, half, half)) if bounds is None else as_bounds(bounds)
        if scale is None:
            corner = (max(abs(low), abs(high)) for low, high in zip(*box, strict=True))
            scale = 1.0 if bounds is None else 1 / math.hypot(*corner)
        positive(scale=scale)
        self.field, self.scale, self.bounds = as_field(field), float(scale), box
        self.pace, self._memo = pace, PointMemo()
        if learning_rate is not None:
            rescale_parameters(self.field, learning_rate, pace=pace)

    @property
    def world(self) -> WorldField:
        """The field in the host's coordinates and units: distances, rays, meshes, pictures."""
        return WorldField(self.field, Similarity((0.0, 0.0, 0.0), 1 / self.scale))

    def mesh(self, resolution: int = 256, *, bounds: Box | None = None, level: int = -1, normals: bool = True) -> Mesh:
        """A triangle mesh of the surface, in the host's coordinates.

        Args:
            resolution: cells along the longest side of the box.
            bounds: lowest and highest corner of the box, in the host's coordinates; the host's own box by default.
            level: of detail, 0 the coarsest, -1 the finest.
            normals: whether vertices get normals.

        Raises:
            NoSurfaceError: there is no surface in the box.
        """
        box = self.bounds if bounds is None else as_bounds(bounds)
        return self.world.mesh(resolution, level=level, bounds=box, normals=normals)

    def parameter_groups(self, lr: float = HOST_RATE) -> list[dict[str, Any]]:
        """Groups for the host's optimiser, with a rate for each layer; see `learning_rates.parameter_groups`."""
        return parameter_groups(self.field, lr, pace=self.pace)

    @torch.no_grad()
    def follow(self, inv_s: Tensor | float, *, band: float = 4.0, least: float = 0.02, most: float = 0.3) -> None:
        """Narrow the bands with the uncertainty of the surface; to be called after each step of the optimiser.

        Every band gets the half-width ``band`` · s / inv_s, clamped to [``least``, ``most``], s being the scale.

        Args:
            inv_s: inverse standard deviation of NeuS's density, in the host's units; of several numbers the mean.
            band: half-width in standard deviations.
            least: smallest half-width, in the field's units.
            most: largest half-width.

        Raises:
            ValueError: not 0 < least <= most.
        """
        if not 0 < least <= most:
            raise ValueError(f"least={least}, most={most}: expected 0 < least <= most")
        deltas = self.field.deltas
        width = band * self.scale / torch.as_tensor(inv_s).to(deltas).mean()
        deltas.copy_(width.clamp(least, most).expand_as(deltas))

    def _value(self, x: Tensor) -> Tensor:
        with _full_precision(x):
            return self.field.value(x * self.scale) / self.scale

    def _value_features(self, x: Tensor) -> Tensor:
        """Distance and features ``(..., 1 + F)``, for the price of a value."""
        with _full_precision(x):
            value, features = self.field.value_features(x * self.scale)
        return torch.cat((value[..., None] / self.scale, features), dim=-1)

    def _jet(self, x: Tensor) -> Jet:
        """The jet of f(s x) / s, in a graph that reaches ``x``."""
        with _full_precision(x), _reaching(x) as reached:
            value, gradient, features = self.field.jet(reached * self.scale)
            return Jet(value / self.scale, gradient, features)

    def _second_jet(self, x: Tensor) -> tuple[Jet, Tensor]:
        """The jet, and the Laplacian ``(...,)``."""
        with _full_precision(x):
            value, gradient, features, hessian = self.field.second_jet(x * self.scale)
        laplacian = self.scale * hessian.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
        return Jet(value / self.scale, gradient, features), laplacian

    def _features(self, x: Tensor) -> Tensor:
        """Distance and features ``(..., 1 + F)``; with a graph they come from the jet that has the gradient too."""
        if not torch.is_grad_enabled():  # nor could the host ask for a gradient, which it takes by autograd
            return self._value_features(x)
        return self._memo.ask("value", x, self.field, lambda: self._halves(x))

    def _gradient(self, x: Tensor) -> Tensor:
        """Gradient, with its graph; like NeuS, leaves ``x`` requiring gradients."""
        gradient = self._memo.ask("gradient", x, self.field, lambda: self._halves(x))
        if torch.is_grad_enabled() and not x.is_inference():
            x.requires_grad_(True)
        return gradient

    def _halves(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Distance and features, and the gradient, in the host's shapes."""
        jet = self._jet(x)
        return joined(jet), jet.gradient


def as_bounds(box: Box) -> Bounds:
    """Two corners as plain numbers; ValueError unless ``(2, 3)`` with the second above the first."""
    corners = torch.as_tensor(box).detach().double().cpu()
    if corners.shape != (2, 3) or not bool((corners[0] < corners[1]).all()):
        raise ValueError(f"bounds={corners.tolist()}: expected the lowest and the highest corner of a box, (2, 3)")
    low, high = corners.tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def joined(jet: Jet) -> Tensor:
    """Distance and features in one tensor ``(..., 1 + F)``."""
    return torch.cat((jet.value[..., None], jet.features), dim=-1)


def _full_precision(x: Tensor) -> torch.autocast:
    """Autocast off: in half precision a distance near the surface has no digits left."""
    return torch.autocast(x.device.type, enabled=False)


@contextmanager
def _reaching(x: Tensor) -> Iterator[Tensor]:
    """``x`` for an evaluation whose graph reaches it, with its own flag restored afterwards.

    Hosts evaluate first, and mark the points as requiring gradients later, inside ``gradient``.
    """
    if not torch.is_grad_enabled() or x.requires_grad:
        yield x
    elif x.is_inference():
        yield x.clone()  # autograd cannot save inference tensors
    else:
        x.requires_grad_(True)
        try:
            yield x
        finally:
            x.requires_grad_(False)


Half = Literal["value", "gradient"]
Evaluate = Callable[[], tuple[Tensor, Tensor]]


@dataclass(frozen=True, eq=False)
class _Waiting:
    """The half of a pair (value, gradient) that was not requested yet, with all that it depends on."""

    half: Half
    result: Tensor
    points: weakref.ref[Tensor]
    handed: weakref.ref[Tensor]
    module: nn.Module
    tensors: tuple[Tensor, ...]
    state: tuple[object, ...]
    token: object  # tells this pair from others

    def fits(self, half: Half, points: Tensor, module: nn.Module, tensors: Sequence[Tensor]) -> bool:
        """Whether this is the requested half, and nothing has changed since it was evaluated."""
        return (
            self.half == half
            and self.points() is points
            and self.module is module
            and len(self.tensors) == len(tensors)
            and all(old is new for old, new in zip(self.tensors, tensors, strict=True))
            and self.state == _state(points, module, tensors)
        )


class PointMemo:
    """Keeps one half of the last pair (value, gradient) until it is requested, at the very same points.

    Renderers like NeuS's call for the values and then, by another method, for the gradient at the same tensor. The
    first call evaluates both and returns its half; the second gets the other, once. The kept half is dropped in
    three cases:

    - It is returned, or anything else is requested.
    - The points or the returned half die, so no graph lives longer than the caller's own tensors.
    - A gradient flows back through the returned half: autograd may have freed the graph of both.

    It is used only for the same tensor object at the same version, with the same tensors of the module at the same
    versions, and in the same grad mode. Writes through ``.data`` or NumPy between the two calls are not noticed.
    """

    def __init__(self) -> None:
        self._waiting: _Waiting | None = None

    def __reduce__(self) -> tuple[type[PointMemo], tuple[()]]:
        """Copies and pickles start empty: weak references cannot be copied."""
        return PointMemo, ()

    def ask(self, half: Half, points: Tensor, module: nn.Module, evaluate: Evaluate) -> Tensor:
        """One half of ``evaluate()``, which returns (value, gradient) of ``module`` at ``points``."""
        waiting, self._waiting = self._waiting, None
        tensors = (*module.parameters(), *module.buffers())
        # Inference tensors have no version; nothing that depends on one is remembered.
        countable = not any(tensor.is_inference() for tensor in (points, *tensors))
        if countable and waiting is not None and waiting.fits(half, points, module, tensors):
            return waiting.result
        value, gradient = evaluate()
        handed, kept = (value, gradient) if half == "value" else (gradient, value)
        if countable:
            memo, token = weakref.ref(self), object()

            def forget(_: object) -> None:
                owner = memo()
                if owner is not None and owner._waiting is not None and owner._waiting.token is token:
                    owner._waiting = None

            self._waiting = _Waiting(
                "gradient" if half == "value" else "value",
                kept,
                weakref.ref(points, forget),
                weakref.ref(handed, forget),
                module,
                tensors,
                _state(points, module, tensors),
                token,
            )
            if handed.requires_grad:
                handed.register_hook(forget)
        return handed


def _state(points: Tensor, module: nn.Module, tensors: Sequence[Tensor]) -> tuple[object, ...]:
    """What a result depends on beside the identity of the points, the module and its tensors."""
    # Assigning to `.data` replaces the memory and leaves the version as it was.
    places = tuple((tensor._version, tensor.data_ptr(), tensor.dtype) for tensor in (points, *tensors))
    trained = tuple(tensor.requires_grad for tensor in tensors)
    return (torch.is_grad_enabled(), torch.is_inference_mode_enabled(), module.training, trained, places)
