"""Moving fields in closed form, as `fields.primitives` has static ones."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..fields.field import Field, FieldLike, Jet, OneLevelField, Wrapper, as_field, solid

Vector = tuple[float, float, float]


class RigidMotion:
    """A rotation about an axis that itself travels: x(t) = c + v t + R(ω t)(x₀ − c).

    Args:
        axis: direction of the axis, of any length but zero; ValueError otherwise.
        angle: ω, radians per unit of time.
        center: c, a point on the axis at time 0.
        velocity: v, units per unit of time.

    Example:
        >>> import torch
        >>> turn = RigidMotion(axis=(0.0, 0.0, 1.0), angle=torch.pi / 2)
        >>> turn.forward(torch.tensor([1.0, 0.0, 0.0]), 1.0).round(decimals=5).tolist()[:2]
        [-0.0, 1.0]
    """

    def __init__(
        self,
        *,
        axis: Vector = (0.0, 0.0, 1.0),
        angle: float = 0.0,
        center: Vector = (0.0, 0.0, 0.0),
        velocity: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        length = sum(c * c for c in axis) ** 0.5
        if not length > 0:
            raise ValueError(f"axis={axis}: expected a vector of non-zero length")
        self.axis, self.angle = tuple(c / length for c in axis), float(angle)
        self.center, self.drift = center, velocity

    def __repr__(self) -> str:
        center, velocity = (tuple(map(float, vector)) for vector in (self.center, self.drift))
        return f"RigidMotion(axis={self.axis}, angle={self.angle}, center={center}, velocity={velocity})"

    def forward(self, x: Tensor, t: Tensor | float) -> Tensor:
        """Where points ``(..., 3)`` of time 0 are at time(s) t, ``(...,)`` or a number."""
        center, drift, time = self._terms(x, t)
        return center + drift * time[..., None] + self.rotate(x - center, time)

    def inverse(self, x: Tensor, t: Tensor | float) -> Tensor:
        """Where points ``(..., 3)`` of time(s) t were at time 0."""
        center, drift, time = self._terms(x, t)
        return center + self.rotate(x - center - drift * time[..., None], -time)

    def velocity(self, x: Tensor, t: Tensor | float) -> Tensor:
        """V(x, t) = v + ω a × (x − c − v t), the vector field that carries the points."""
        center, drift, time = self._terms(x, t)
        return drift + self.angle * _cross(x.new_tensor(self.axis), x - center - drift * time[..., None])

    def rotate(self, v: Tensor, t: Tensor) -> Tensor:
        """R(ω t) v by Rodrigues' formula, for vectors ``(..., 3)`` and times ``(...,)``."""
        axis, angle = v.new_tensor(self.axis), (self.angle * t)[..., None]
        along = (v * axis).sum(dim=-1, keepdim=True) * axis
        return along + angle.cos() * (v - along) + angle.sin() * _cross(axis, v)

    def _terms(self, x: Tensor, t: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
        return x.new_tensor(self.center), x.new_tensor(self.drift), torch.as_tensor(t, dtype=x.dtype, device=x.device)


class Moving(Wrapper):
    """A field g carried by a rigid motion: f(x, t) = g(x at time 0), a distance at all times if g is one.

    Args:
        field: g, three-dimensional, with any number of levels; or a function of points ``(..., 3)`` → ``(...,)``.
        motion: the rigid motion.
    """

    defined_by = ("motion",)

    def __init__(self, field: FieldLike, motion: RigidMotion) -> None:
        super().__init__()
        self.field, self.motion = solid(field), motion
        self.in_dim, self.num_levels = 4, self.field.num_levels

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; ∂f/∂t = −⟨∇f, V⟩."""
        value, gradient, features = self.field.jet(self._home(x), level=level)
        gradient = self.motion.rotate(gradient, x[..., 3])
        rate = -(gradient * self.motion.velocity(x[..., :3], x[..., 3])).sum(dim=-1)
        return Jet(value, torch.cat((gradient, rate[..., None]), dim=-1), features)

    def _home(self, x: Tensor) -> Tensor:
        self.check_points(x)
        return self.motion.inverse(x[..., :3], x[..., 3])


class Keyframes(OneLevelField):
    """Shapes at given times, blended in between: f(x, t) = Σ_k w_k(t) f_k(x) with hat functions w_k.

    Before the first time and after the last the field stands still. In between it is a guide, not a distance: |∇f| < 1
    where ∇f_k and ∇f_{k+1} disagree.

    Args:
        times: strictly increasing.
        fields: three-dimensional, one for each time, or functions of points; shared, not copied.

    Raises:
        ValueError: there are none, numbers differ, the times do not increase, or a field is not three-dimensional.
    """

    defined_by = ("times",)

    def __init__(self, times: tuple[float, ...] | list[float], fields: Sequence[FieldLike]) -> None:
        super().__init__(in_dim=4)
        fields = [as_field(field) for field in fields]
        if not times or len(times) != len(fields):
            raise ValueError(f"{len(times)} times for {len(fields)} fields; expected one for each, and at least one")
        if any(not a < b for a, b in itertools.pairwise(times)):
            raise ValueError(f"times={list(times)}: expected increasing numbers")
        for index, field in enumerate(fields):
            if field.in_dim != 3:
                raise ValueError(f"fields[{index}].in_dim={field.in_dim}: expected static fields, three-dimensional")
        self.times, self.fields = tuple(float(t) for t in times), torch.nn.ModuleList(fields)

    def key(self, index: int) -> Field:
        """The field at ``times[index]``."""
        field = self.fields[index]
        assert isinstance(field, Field)
        return field

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; a key is evaluated only where it has a weight."""
        self.resolve_level(level)
        return self.blended(x, lambda index, rows: self.key(index).value(rows[:, :3]))

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; between two keys ∂f/∂t = (f_{k+1} − f_k) / (t_{k+1} − t_k)."""

        def still(index: int, rows: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient, _ = self.key(index).jet(rows[:, :3])
            return value, pad(gradient, (0, 1))

        self.resolve_level(level)
        return self.blended_jet(x, still)

    def blended(self, x: Tensor, value_of: Callable[[int, Tensor], Tensor]) -> Tensor:
        """Σ_k w_k(t) f_k ``(...,)`` at ``x`` ``(..., 4)``; ``value_of(k, rows)`` has f_k of rows ``(N, 4)``."""
        rows = self.check_points(x).reshape(-1, 4)
        value = rows.new_zeros(len(rows))
        for index in range(len(self.times)):
            weight, _ = self.weight(index, rows[:, 3])
            heard = weight.nonzero()[:, 0]
            value = value.index_add(0, heard, weight[heard] * value_of(index, rows[heard]))
        return value.reshape(x.shape[:-1])

    def blended_jet(self, x: Tensor, jet_of: Callable[[int, Tensor], tuple[Tensor, Tensor]]) -> Jet:
        """The jet of `blended`; ``jet_of`` has f_k ``(N,)`` and its gradient ``(N, 4)``, of f_k alone."""
        rows = self.check_points(x).reshape(-1, 4)
        value, gradient = rows.new_zeros(len(rows)), torch.zeros_like(rows)
        for index in range(len(self.times)):
            weight, slope = self.weight(index, rows[:, 3])
            heard = ((weight != 0) | (slope != 0)).nonzero()[:, 0]
            own, by_place = jet_of(index, rows[heard])
            by_time = pad((slope[heard] * own)[:, None], (3, 0))
            value = value.index_add(0, heard, weight[heard] * own)
            gradient = gradient.index_add(0, heard, weight[heard, None] * by_place + by_time)
        return Jet(value.reshape(x.shape[:-1]), gradient.reshape(x.shape), x.new_empty((*x.shape[:-1], 0)))

    def weight(self, index: int, t: Tensor) -> tuple[Tensor, Tensor]:
        """w_k(t) of key ``index`` and its derivative; at a key time the derivative is that of the time after it."""
        weight, slope = torch.ones_like(t), torch.zeros_like(t)
        here = self.times[index]
        if index > 0:
            before = self.times[index - 1]
            rising = t < here
            inside = rising & (t >= before)
            weight = torch.where(rising, ((t - before) / (here - before)).clamp(min=0), weight)
            slope = torch.where(inside, 1 / (here - before), slope)
        if index + 1 < len(self.times):
            after = self.times[index + 1]
            falling = t >= here
            inside = falling & (t < after)
            weight = torch.where(falling, ((after - t) / (after - here)).clamp(min=0), weight)
            slope = torch.where(inside, -1 / (after - here), slope)
        return weight, slope


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a.expand(b.shape), b)
