"""Flows against closed forms, and failures that say how far they came."""

import math

import pytest
import torch
from fields import SCREW
from mplicits.neural_fields import flow
from mplicits.neural_fields.spacetime.flow import IntegrationError, Solver, trajectories
from torch import Tensor, nn

STRICT = Solver(rtol=1e-9, atol=1e-10)


def sphere_points(count: int, radius: float) -> Tensor:
    return radius * torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)


@pytest.mark.parametrize(
    ("solver", "tolerance"),
    [
        (STRICT, 1e-8),
        (Solver(method="dopri8", rtol=1e-9, atol=1e-10), 1e-8),
        (Solver(method="bosh3", rtol=1e-7, atol=1e-8), 1e-6),
        (Solver(method="rk4", step=0.01), 1e-8),
        (Solver(method="midpoint", step=0.002), 1e-5),
    ],
)
def test_flow_of_a_rigid_motion(solver: Solver, tolerance: float) -> None:
    x = torch.randn(50, 3, dtype=torch.float64)
    there = flow(SCREW.velocity, x, 0.0, 1.0, solver=solver)
    torch.testing.assert_close(there, SCREW.forward(x, 1.0), rtol=0, atol=tolerance)
    back = flow(SCREW.velocity, there, 1.0, 0.0, solver=solver)
    torch.testing.assert_close(back, x, rtol=0, atol=tolerance)


def test_every_point_has_its_own_time() -> None:
    x, t = torch.randn(200, 3, dtype=torch.float64), torch.rand(200, dtype=torch.float64)
    t[:20] = 0  # some are there already
    home = flow(SCREW.velocity, SCREW.forward(x, t), t, 0.0, solver=STRICT)
    torch.testing.assert_close(home, x, rtol=0, atol=1e-7)


def test_the_default_serves_single_precision() -> None:
    x, calls = torch.randn(500, 3), []

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        calls.append(len(x))
        return SCREW.velocity(x, t)

    there = flow(velocity, x, 0.0, 1.0)
    # A step of dopri5 takes six looks and may be off by atol + rtol |x|; a rigid motion carries errors on as they are.
    step = Solver().atol + Solver().rtol * float(x.abs().max())
    torch.testing.assert_close(there, SCREW.forward(x, 1.0), rtol=0, atol=len(calls) / 6 * step)


def test_tolerances_hold_for_every_point() -> None:
    speed = torch.full((2_000,), 0.01, dtype=torch.float64)
    speed[7] = 40.0
    x = sphere_points(2_000, 1.0)

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        return speed[:, None] * torch.stack((-x[:, 1], x[:, 0], torch.zeros_like(t)), dim=-1)

    end = flow(velocity, x, 0.0, 1.0, solver=Solver(rtol=1e-8, atol=1e-8))
    angle = math.atan2(x[7, 1], x[7, 0]) + 40.0
    expected = x[7, :2].norm() * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    torch.testing.assert_close(end[7, :2], expected, rtol=0, atol=1e-5)


def test_trajectories() -> None:
    times = [0.0, 0.3, 0.5, 1.0]
    x = torch.randn(40, 3, dtype=torch.float64)
    path = trajectories(SCREW.velocity, x, times, solver=STRICT)
    for index, time in enumerate(times):
        torch.testing.assert_close(path[index], SCREW.forward(x, time), rtol=0, atol=1e-7)


class Swirl(nn.Module):
    """dx/dt = a x, so x(1) = e^a x(0)."""

    def __init__(self) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.tensor(0.3, dtype=torch.float64))

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        return self.a * x


@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize("method", ["dopri5", "rk4"])
def test_gradients_of_a_flow(adjoint: bool, method: str) -> None:
    swirl, x = Swirl(), torch.randn(10, 3, dtype=torch.float64, requires_grad=True)
    solver = Solver(method=method, rtol=1e-9, atol=1e-10, adjoint=adjoint)
    flow(swirl, x, 0.0, 1.0, solver=solver).sum().backward()
    torch.testing.assert_close(x.grad, torch.full_like(x, math.exp(0.3)), rtol=0, atol=1e-6)
    torch.testing.assert_close(swirl.a.grad, math.exp(0.3) * x.detach().sum(), rtol=0, atol=1e-6)


def blow_up(x: Tensor, t: Tensor) -> Tensor:
    """dx/dt = x², which is at infinity at t = 1/x₀."""
    return x.square()


def test_a_flow_that_blows_up_reports_the_time_reached() -> None:
    x = torch.tensor([[2.0, 0.0, 0.0]], dtype=torch.float64)
    with pytest.raises(IntegrationError, match=r"reached time 0\.(49|5)") as caught:
        flow(blow_up, x, 0.0, 1.0)
    assert float(caught.value.time) == pytest.approx(0.5, abs=1e-2)
    assert float(caught.value.points[0, 0]) > 100
    with pytest.raises(IntegrationError, match=r"more than 5 steps; reached time 0\.\d+") as caught:
        flow(blow_up, x, 0.0, 1.0, solver=Solver(max_steps=5))
    reached = float(caught.value.time)
    assert 0 < reached < 0.5
    torch.testing.assert_close(float(caught.value.points[0, 0]), 2 / (1 - 2 * reached), rtol=1e-3, atol=0)


@pytest.mark.parametrize("solver", [Solver(), Solver(method="rk4", step=0.05), Solver(min_step=1e-3)])
def test_a_velocity_that_is_not_finite(solver: Solver) -> None:
    def velocity(x: Tensor, t: Tensor) -> Tensor:
        return torch.where(t[:, None] < 0.5, torch.ones_like(x), torch.nan)

    with pytest.raises(IntegrationError, match="the velocity is not finite") as caught:
        flow(velocity, torch.zeros(4, 3), 0.0, 1.0, solver=solver)
    assert 0 <= float(caught.value.time) < 0.6
    assert bool(torch.isfinite(caught.value.points).all())


def test_backward_in_time_and_with_own_times_failures_report_too() -> None:
    x = torch.tensor([[-2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]], dtype=torch.float64)
    with pytest.raises(IntegrationError) as caught:
        flow(blow_up, x, 1.0, 0.0)
    assert float(caught.value.time) == pytest.approx(0.5, abs=1e-2)
    with pytest.raises(IntegrationError, match=r"reached time 0\.\d+ to 0\.\d+") as caught:
        flow(blow_up, x, torch.tensor([1.0, 0.8]), 0.0)
    assert caught.value.time.shape == (2,)


def test_a_least_step_takes_a_stiff_field_to_its_end() -> None:
    """Towards a wall at 10⁵ per unit of time: without a limit thousands of steps, with one as many as it allows."""

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        return torch.where(x > 0.5, -1e5 * (x - 0.5), torch.ones_like(x)).clamp(min=-10)

    x = torch.zeros(1, 3, dtype=torch.float64)
    with pytest.raises(IntegrationError, match="more than 200 steps"):
        flow(velocity, x, 0.0, 1.0, solver=Solver(max_steps=200, rtol=1e-9, atol=1e-9))
    there = flow(velocity, x, 0.0, 1.0, solver=Solver(max_steps=200, min_step=0.01, rtol=1e-9, atol=1e-9))
    assert float((there - 0.5).abs().max()) < 0.15


def test_no_points() -> None:
    assert flow(SCREW.velocity, torch.zeros(0, 3), 0.0, 1.0).shape == (0, 3)
