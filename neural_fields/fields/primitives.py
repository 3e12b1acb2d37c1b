"""Exact signed distance fields: ground truth for tests, examples and initialisation."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from ..backend.devices import few_numbers
from ..backend.errors import positive
from .field import Jet, OneLevelField

# A value, and a function that returns the gradient.
Evaluated = tuple[Tensor, Callable[[], Tensor]]


class ClosedForm(OneLevelField):
    """A closed-form field; a subclass returns value and gradient at points."""

    @abstractmethod
    def _evaluate(self, x: Tensor) -> Evaluated: ...

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.resolve_level(level)
        return self._evaluate(self.check_points(x))[0]

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        self.resolve_level(level)
        value, gradient = self._evaluate(self.check_points(x))
        return Jet(value, gradient(), x.new_empty((*x.shape[:-1], 0)))


def _direction(v: Tensor, length: Tensor) -> Tensor:
    """``v`` over its length; 0 for zero vectors."""
    safe = torch.where(length > 0, length, torch.ones_like(length))
    return v / safe[..., None]


class Sphere(ClosedForm):
    """``f(x) = |x − center| − radius``.

    Example:
        >>> import torch
        >>> Sphere(radius=0.5).value(torch.tensor([[1.0, 0.0, 0.0]]))
        tensor([0.5000])
    """

    defined_by = ("radius", "center")

    def __init__(self, *, radius: float = 0.5, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        super().__init__()
        positive(radius=radius)
        self.radius, self.center = radius, center

    def _evaluate(self, x: Tensor) -> Evaluated:
        v = x - few_numbers(self.center, x)
        length = v.norm(dim=-1)
        return length - self.radius, lambda: _direction(v, length)


class Plane(ClosedForm):
    """``f(x) = ⟨normal, x⟩ − offset`` with a unit normal; negative on the side the normal leaves."""

    defined_by = ("normal", "offset")

    def __init__(self, *, normal: tuple[float, float, float] = (0.0, 0.0, 1.0), offset: float = 0.0) -> None:
        super().__init__()
        length = sum(c * c for c in normal) ** 0.5
        if not length > 0:
            raise ValueError(f"normal={normal}: expected a vector of non-zero length")
        self.normal, self.offset = tuple(c / length for c in normal), offset

    def _evaluate(self, x: Tensor) -> Evaluated:
        normal = few_numbers(self.normal, x)
        return x @ normal - self.offset, lambda: normal.expand(x.shape)


class Torus(ClosedForm):
    """``f(x) = √((√(x² + y²) − major)² + z²) − minor``, around the z axis."""

    defined_by = ("major", "minor")

    def __init__(self, *, major: float = 0.5, minor: float = 0.2) -> None:
        super().__init__()
        if not major > minor > 0:
            raise ValueError(f"major={major}, minor={minor}: expected major > minor > 0")
        self.major, self.minor = major, minor

    def _evaluate(self, x: Tensor) -> Evaluated:
        rho = x[..., :2].norm(dim=-1)
        v = torch.stack((rho - self.major, x[..., 2]), -1)
        length = v.norm(dim=-1)

        def gradient() -> Tensor:
            q = _direction(v, length)
            return torch.cat((q[..., :1] * _direction(x[..., :2], rho), q[..., 1:]), -1)

        return length - self.minor, gradient


class Box(ClosedForm):
    """Axis-aligned box with half-sizes ``half_size`` around ``center``.

    Outside, the distance to the nearest point of the box; inside, minus the distance to the nearest face.
    """

    defined_by = ("half_size", "center")

    def __init__(
        self,
        *,
        half_size: tuple[float, float, float] = (0.4, 0.4, 0.4),
        center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__()
        if not min(half_size) > 0:
            raise ValueError(f"half_size={half_size}: expected three numbers > 0")
        self.half_size, self.center = half_size, center

    def _evaluate(self, x: Tensor) -> Evaluated:
        p = x - few_numbers(self.center, x)
        q = p.abs() - few_numbers(self.half_size, x)
        v = q.clamp(min=0)
        outside = v.norm(dim=-1)
        inside, axis = q.max(dim=-1)

        def gradient() -> Tensor:
            sign = torch.where(p < 0, -1.0, 1.0).to(x.dtype)
            facing = torch.nn.functional.one_hot(axis, 3).to(x.dtype)
            return torch.where((inside > 0)[..., None], _direction(v, outside), facing) * sign

        return outside + inside.clamp(max=0), gradient


class Capsule(ClosedForm):
    """All points within ``radius`` of the segment from ``start`` to ``end``."""

    defined_by = ("start", "end", "radius")

    def __init__(
        self,
        *,
        start: tuple[float, float, float] = (0.0, 0.0, -0.4),
        end: tuple[float, float, float] = (0.0, 0.0, 0.4),
        radius: float = 0.2,
    ) -> None:
        super().__init__()
        if not radius > 0 or start == end:
            raise ValueError(f"start={start}, end={end}, radius={radius}: expected two different points and radius > 0")
        self.start, self.end, self.radius = start, end, radius

    def _evaluate(self, x: Tensor) -> Evaluated:
        start = few_numbers(self.start, x)
        axis = few_numbers(self.end, x) - start
        along = (((x - start) @ axis) / (axis @ axis)).clamp(0, 1)
        v = x - start - along[..., None] * axis
        length = v.norm(dim=-1)
        return length - self.radius, lambda: _direction(v, length)
