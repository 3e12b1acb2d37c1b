"""Points carried by vector fields: ordinary differential equations, solved by torchdiffeq.

`flow` follows dx/dt = V(x, t). A field carried by V keeps its value along that path, f(x(t), t) = f(x(0), 0). The
points of a moving surface follow its `CarriedVelocity`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from ..backend.errors import at_least, positive
from .evolution import VectorField

ADAPTIVE = ("dopri5", "dopri8", "bosh3", "fehlberg2", "adaptive_heun")
FIXED = ("rk4", "heun3", "heun2", "midpoint", "euler")


class IntegrationError(RuntimeError):
    """An integration that did not reach its end.

    Attributes:
        time: the time reached, a scalar, or one for each point where each had its own.
        points: ``(N, 3)`` at that time.
    """

    def __init__(self, reason: str, time: Tensor, points: Tensor) -> None:
        when = f"{float(time):.6g}" if not time.ndim else f"{float(time.min()):.6g} to {float(time.max()):.6g}"
        super().__init__(f"{reason}; reached time {when}")
        self.time, self.points = time, points


@dataclass(frozen=True)
class Solver:
    """How to integrate.

    Attributes:
        method: adaptive ("dopri5", "dopri8", "bosh3", "fehlberg2", "adaptive_heun") or of a fixed step ("rk4", "heun3",
            "heun2", "midpoint", "euler").
        rtol: relative tolerance on every coordinate of every point, adaptive methods only.
        atol: absolute tolerance, likewise; in float32 not below about 1e-6.
        step: step of the fixed methods, in units of time.
        min_step: an adaptive step this small is taken whatever its error: for stiff fields, as near a change of
            topology, which would shrink steps to nothing. 0 fails instead.
        max_steps: most steps, rejected ones included.
        adjoint: gradients from integrating backward (memory does not grow with the steps) instead of the recorded
            steps.

    Raises:
        ValueError: there is no such method, or a number is out of range.
    """

    method: str = "dopri5"
    rtol: float = 1e-5
    atol: float = 1e-6
    step: float = 0.01
    min_step: float = 0.0
    max_steps: int = 2000
    adjoint: bool = False

    def __post_init__(self) -> None:
        if self.method not in ADAPTIVE + FIXED:
            raise ValueError(f"method={self.method!r}: expected one of {', '.join(ADAPTIVE + FIXED)}")
        positive(rtol=self.rtol, atol=self.atol, step=self.step, max_steps=self.max_steps)
        at_least(0, min_step=self.min_step)


def flow(
    velocity: VectorField, points: Tensor, start: Tensor | float, end: Tensor | float, *, solver: Solver | None = None
) -> Tensor:
    """Move points from one time to another: dx/dt = V(x, t) from ``start`` to ``end``.

    Both may be one number, or one for each point: ``flow(V, x, t, 0.0)`` takes samples of space-time, each at its own
    time, back to where they came from, in one integration.

    Args:
        velocity: V, of positions ``(N, 3)`` and times ``(N,)``; an ``nn.Module`` if it has parameters.
        points: ``(N, 3)``.
        start: a number or ``(N,)``.
        end: a number or ``(N,)``, before or after ``start``.
        solver: the method, its tolerances and its limits.

    Returns:
        Points ``(N, 3)``.

    Raises:
        ValueError: shapes do not fit.
        IntegrationError: the steps became too small or too many, or V is not finite.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import RigidMotion, flow
        >>> from mplicits.neural_fields.spacetime.flow import Solver
        >>> turn = RigidMotion(angle=torch.pi)
        >>> there = flow(turn.velocity, torch.tensor([[1.0, 0.0, 0.5]]), 0.0, 1.0)
        >>> bool((there - torch.tensor([[-1.0, 0.0, 0.5]])).abs().max() < 1e-4)
        True
    """
    begin, finish = (torch.as_tensor(t, dtype=points.dtype, device=points.device) for t in (start, end))
    for name, time in (("start", begin), ("end", finish)):
        if time.shape not in ((), points.shape[:1]):
            raise ValueError(f"{name} has shape {tuple(time.shape)}; expected one number, or ({len(points)},)")
    _check_points(points)
    return integrate_rows(velocity, points, begin, finish, solver or Solver())


class VelocityJet(NamedTuple):
    """A velocity ``value`` ``(..., 3)`` with ``jacobian`` ∂v_i/∂x_j ``(..., 3, 3)`` and ``rate`` ∂v/∂t ``(..., 3)``."""

    value: Tensor
    jacobian: Tensor
    rate: Tensor

    @property
    def divergence(self) -> Tensor:
        """``tr ∂v/∂x``, ``(...,)``: the growth rate of a small volume."""
        return self.jacobian.diagonal(dim1=-2, dim2=-1).sum(dim=-1)

    @property
    def killing(self) -> Tensor:
        """``‖J + Jᵀ‖²``, ``(...,)``: 0 for rigid motions only (Killing's equation)."""
        return (self.jacobian + self.jacobian.transpose(-1, -2)).square().sum(dim=(-2, -1))


class Velocity(Protocol):
    """A velocity with its derivatives."""

    def __call__(self, x: Tensor, t: Tensor) -> Tensor:
        """Velocities ``(..., 3)`` at positions ``(..., 3)`` and times ``(...,)``."""
        ...

    def jet(self, x: Tensor, t: Tensor) -> VelocityJet:
        """Velocities with their derivatives."""
        ...


def trajectories(
    velocity: VectorField, points: Tensor, times: Sequence[float] | Tensor, *, solver: Solver | None = None
) -> Tensor:
    """Paths of points through a vector field, ``(T, N, 3)``, from ``points`` at ``times[0]``.

    Errors are those of `flow`; ValueError too if the times do not run one way.
    """
    _check_points(points)
    moments = torch.as_tensor(times, dtype=points.dtype, device=points.device)
    steps = moments.diff()
    if moments.ndim != 1 or not len(moments) or not (bool((steps > 0).all()) or bool((steps < 0).all())):
        raise ValueError(f"times={moments.tolist()}: expected at least one number, all increasing or all decreasing")
    path = [points]
    for start, end in itertools.pairwise(moments):
        path.append(integrate_rows(velocity, path[-1], start, end, solver or Solver()))
    return torch.stack(path)


class _GaveUpError(Exception):
    """Out of steps, or out of numbers; becomes an `IntegrationError` with what was reached."""


class _Progress(nn.Module):
    """dx/ds = (t₁ − t₀) V(x, t₀ + s (t₁ − t₀)) for s in [0, 1], with times of each point's own.

    It keeps where the last step began, for the report of a failure.
    """

    def __init__(self, velocity: VectorField, start: Tensor, end: Tensor, points: Tensor, max_steps: int) -> None:
        super().__init__()
        self.velocity, self.start, self.span = velocity, start, end - start
        self.reached, self.points, self.finite = torch.zeros(()), points.detach(), True
        self.steps, self.max_steps = 0, max_steps

    def forward(self, s: Tensor, x: Tensor) -> Tensor:
        time = self.start + s * self.span
        velocity = self.span.expand(len(x))[:, None] * self.velocity(x, time.expand(len(x)))
        self.finite = self.finite and bool(torch.isfinite(velocity).all())
        return velocity

    def callback_step(self, s: Tensor, x: Tensor, ds: Tensor) -> None:
        """Called by torchdiffeq before each step."""
        if not bool(torch.isfinite(x).all()):
            raise _GaveUpError("the velocity is not finite")
        self.reached, self.points, self.steps = s.detach(), x.detach(), self.steps + 1
        if self.steps > self.max_steps:
            raise _GaveUpError(f"more than {self.max_steps} steps")

    def reached_time(self) -> Tensor:
        """When the last step began, for all points or for each."""
        return (self.start + self.reached.to(self.start) * self.span).detach()


def integrate_rows(velocity: VectorField, points: Tensor, start: Tensor, end: Tensor, solver: Solver) -> Tensor:
    """`flow` of rows ``(N, n)`` that follow any equation; unchecked."""
    import torchdiffeq  # here, so that the package can be imported without it

    longest = float((end - start).detach().abs().max()) if len(points) else 0.0
    if longest == 0:
        return points.clone()
    progress = _Progress(velocity, start, end, points, solver.max_steps)
    interval = torch.tensor([0.0, 1.0], dtype=points.dtype, device=points.device)
    options: dict[str, object]
    if solver.method in ADAPTIVE:
        options = {
            "min_step": solver.min_step / longest,
            # The largest error of all, not their root mean square, which would hide that of a single point.
            "norm": lambda error: error.abs().max(),
            # Land on both ends (the adjoint comes back): stepping over them would interpolate, to a lower order.
            "step_t": interval,
        }
    else:
        # The longest way is divided evenly, into steps of at most the given size (but for rounding).
        count = max(1, math.ceil(longest / solver.step - 1e-6))
        options = {"grid_constructor": lambda _function, _points, s: torch.linspace(s[0], s[-1], count + 1).to(s)}
    integrate = torchdiffeq.odeint_adjoint if solver.adjoint else torchdiffeq.odeint
    try:
        path: Any = integrate(
            progress, points, interval, rtol=solver.rtol, atol=solver.atol, method=solver.method, options=options
        )
        moved: Tensor = path[-1]
        if not bool(torch.isfinite(moved).all()):
            raise _GaveUpError("the velocity is not finite")
    except _GaveUpError as error:
        raise IntegrationError(str(error), progress.reached_time(), progress.points) from None
    except AssertionError as error:
        reason = "steps became too small (see min_step)" if progress.finite else "the velocity is not finite"
        raise IntegrationError(reason, progress.reached_time(), progress.points) from error
    return moved


def _check_points(points: Tensor) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points has shape {tuple(points.shape)}; expected (N, 3)")
