"""A learnt velocity field, and shapes that it carries: motion with correspondences.

A surface carried by v(x, t) is f(x, t) = f_k(φ_{t→t_k}(x)), φ following dx/dt = v from time t to that of a known shape.
`CarriedKeyframes` blends the shapes before and after; both agree where v carries the first onto the second.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..fields.field import Jet, OneLevelField
from ..networks.siren import Siren, plain_jet
from .field import at_time
from .flow import Solver, Velocity, VelocityJet, integrate_rows
from .moving import Keyframes


class VelocitySiren(nn.Module):
    """v(x, t) as one SIREN with three outputs, whose Jacobian comes from three sweeps back in one matrix.

    Args:
        width: neurons in each sine layer.
        depth: number of sine layers.
        omega: the frequency ω₀; low ones are the prior that neighbours move alike.
        gain: factor on the initial outputs; training starts from almost standing still.

    Example:
        >>> import torch
        >>> jet = VelocitySiren(16, 2).jet(torch.zeros(5, 3), torch.zeros(5))
        >>> jet.value.shape, jet.jacobian.shape, jet.killing.shape
        (torch.Size([5, 3]), torch.Size([5, 3, 3]), torch.Size([5]))
    """

    def __init__(self, width: int = 64, depth: int = 2, *, omega: float = 3.0, gain: float = 0.01) -> None:
        super().__init__()
        self.siren = Siren(width, depth, omega=omega, in_dim=4, num_features=2, output_gain=gain, feature_gain=gain)

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """Velocities ``(..., 3)`` at positions ``(..., 3)`` and times ``(...,)``."""
        first, others = self.siren.value_features(at_time(x, t))
        return torch.cat((first[..., None], others), dim=-1)

    def jet(self, x: Tensor, t: Tensor) -> VelocityJet:
        """Velocities with all first derivatives; differentiable any number of times."""
        points = self.siren.check_points(at_time(x, t))
        value, jacobian = plain_jet(points.reshape(-1, 4), self.siren.folded(), 3)
        jacobian = jacobian.reshape(*points.shape[:-1], 3, 4)
        return VelocityJet(value.reshape(*points.shape[:-1], 3), jacobian[..., :3], jacobian[..., 3])


class CarriedKeyframes(OneLevelField):
    """Shapes at given times, carried by a velocity: f(x, t) = Σ_k w_k(t) f_k(φ_{t→t_k}(x)), w_k hat functions.

    At the key times it is the shapes themselves. In between sign and zero set count: values are no distances where v
    strains.

    Args:
        keys: the shapes and their times; shared, not copied.
        velocity: v, as `VelocitySiren` or anything with ``jet``; registered if it is a module.
        steps: of Runge-Kutta 4 from each moment to each of its two keys, at least 1, the same for all points.
    """

    defined_by = ("steps",)

    def __init__(self, keys: Keyframes, velocity: Velocity, *, steps: int = 8) -> None:
        super().__init__(in_dim=4)
        if steps < 1:
            raise ValueError(f"steps={steps}: expected at least 1")
        self.keys, self.velocity, self.steps = keys, velocity, steps

    def home(self, x: Tensor, t: Tensor, index: int) -> Tensor:
        """φ_{t→t_k}: where points ``(N, 3)`` of times ``(N,)`` are at the time of key ``index``."""
        span = _Span(self.velocity, t, self.keys.times[index])
        return integrate_rows(span, x, x.new_zeros(()), x.new_ones(()), self._solver)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; points are followed only to keys that have a weight."""

        def carried(index: int, rows: Tensor) -> Tensor:
            return self.keys.key(index).value(self.home(rows[:, :3], rows[:, 3], index))

        self.resolve_level(level)
        return self.keys.blended(x, carried)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; the derivatives of f_k∘φ are ∇f_k times those of φ, which are integrated with it."""

        def carried(index: int, rows: Tensor) -> tuple[Tensor, Tensor]:
            span = _Span(self.velocity, rows[:, 3], self.keys.times[index])
            still = torch.eye(3, 4, dtype=x.dtype, device=x.device).reshape(1, 12).expand(len(rows), -1)
            begin = torch.cat((rows[:, :3], still), dim=1)
            state = integrate_rows(span.with_derivatives, begin, x.new_zeros(()), x.new_ones(()), self._solver)
            jet = self.keys.key(index).jet(state[:, :3])
            return jet.value, (state[:, 3:].reshape(-1, 3, 4) * jet.gradient[:, :, None]).sum(dim=1)

        self.resolve_level(level)
        return self.keys.blended_jet(x, carried)

    @property
    def _solver(self) -> Solver:
        return Solver(method="rk4", step=1 / self.steps)


class _Span:
    """v in a time s of each point's own, which runs from 0 to 1 while t runs from ``start`` to ``end``."""

    def __init__(self, velocity: Velocity, start: Tensor, end: float) -> None:
        self.velocity, self.start, self.span = velocity, start, end - start

    def __call__(self, x: Tensor, s: Tensor) -> Tensor:
        return self.span[:, None] * self.velocity(x, self.start + s * self.span)

    def with_derivatives(self, state: Tensor, s: Tensor) -> Tensor:
        """The rate of rows ``(N, 15)``: a point, and its derivatives ``(3, 4)`` by where and when it started.

        The exact flow has ∂φ/∂t = −M v(x, t) with M = ∂φ/∂x; integrated, it is the derivative of what is computed.
        """
        value, jacobian, rate = self.velocity.jet(state[:, :3], self.start + s * self.span)
        change = self.span[:, None, None] * (jacobian @ state[:, 3:].reshape(-1, 3, 4))
        late = (self.span * (1 - s))[:, None] * rate - value
        change = change + torch.nn.functional.pad(late[:, :, None], (3, 0))
        return torch.cat((self.span[:, None] * value, change.flatten(1)), dim=1)
