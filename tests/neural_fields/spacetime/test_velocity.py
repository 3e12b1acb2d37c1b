"""Velocities against autograd, characteristics against exponentials of matrices, carried shapes against moved ones."""

import math

import pytest
import torch
from fields import SCREW
from mplicits.neural_fields import Box, Moving, Sphere, TimeSlice, at_time, flow
from mplicits.neural_fields.spacetime.flow import Solver
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.spacetime.velocity import CarriedKeyframes, VelocityJet, VelocitySiren
from torch import Tensor

ROTATION = ((0.0, -1.5, 0.0), (1.5, 0.0, 0.0), (0.0, 0.0, 0.0))
SHEAR = ((0.0, 1.2, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
EXPANSION = ((0.7, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, 0.0, 0.7))
STEPS = 16


class Linear:
    """v = A x, whose flow is x → exp(A t) x."""

    def __init__(self, rows: tuple[tuple[float, ...], ...]) -> None:
        self.matrix = torch.tensor(rows, dtype=torch.float64)

    def __call__(self, x: Tensor, t: Tensor) -> Tensor:
        return x @ self.matrix.T

    def jet(self, x: Tensor, t: Tensor) -> VelocityJet:
        return VelocityJet(self(x, t), self.matrix.expand(*x.shape[:-1], 3, 3), torch.zeros_like(x))


class Screw:
    """The velocity of a rigid motion, with its derivatives."""

    def __call__(self, x: Tensor, t: Tensor) -> Tensor:
        return SCREW.velocity(x, t)

    def jet(self, x: Tensor, t: Tensor) -> VelocityJet:
        turn = torch.linalg.cross(torch.tensor(SCREW.axis).to(x).expand(3, 3), torch.eye(3).to(x)).T
        drift = torch.tensor(SCREW.drift).to(x)
        jacobian = SCREW.angle * turn
        return VelocityJet(self(x, t), jacobian.expand(len(x), 3, 3), -(jacobian @ drift).expand(len(x), 3))


def taylor_rest(matrix: Tensor, steps: int) -> float:
    """Bound on what Runge-Kutta 4, the Taylor polynomial of order 4 of each step, misses of exp(A) over all steps."""
    size = float(torch.linalg.matrix_norm(matrix, 2))
    return math.exp(size) * steps * (size / steps) ** 5 / math.factorial(5) * math.exp(size / steps)


@pytest.mark.parametrize("rows", [ROTATION, SHEAR, EXPANSION])
def test_characteristics_of_linear_flows(rows: tuple[tuple[float, ...], ...]) -> None:
    v = Linear(rows)
    x = torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=-1)
    exact, bound = torch.linalg.matrix_exp(v.matrix), taylor_rest(v.matrix, STEPS) + 1e-14
    solver = Solver(method="rk4", step=1 / STEPS)
    there = flow(v, x, 0.0, 1.0, solver=solver)
    assert float((there - x @ exact.T).norm(dim=-1).max()) <= bound
    # Coming back adds as much again, carried by the inverse, whose norm exp(‖A‖) bounds.
    back = flow(v, there, 1.0, 0.0, solver=solver)
    assert float((back - x).norm(dim=-1).max()) <= bound * (math.exp(float(v.matrix.norm())) + math.e)


def test_energies_of_linear_flows() -> None:
    x, t = torch.randn(5, 3, dtype=torch.float64), torch.zeros(5, dtype=torch.float64)
    jets = [Linear(rows).jet(x, t) for rows in (ROTATION, SHEAR, EXPANSION)]
    found = [(float(jet.divergence[0]), float(jet.killing[0])) for jet in jets]
    assert found == [(0, 0), (0, pytest.approx(2 * 1.2**2)), (pytest.approx(3 * 0.7), pytest.approx(3 * 1.4**2))]


def test_derivatives_of_a_siren() -> None:
    v = VelocitySiren(12, 2, gain=1.0).double()
    x, t = torch.randn(6, 3, dtype=torch.float64), torch.rand(6, dtype=torch.float64)
    jet = v.jet(x, t)
    torch.testing.assert_close(jet.value, v(x, t))
    for row in range(len(x)):
        jacobian, rate = torch.autograd.functional.jacobian(lambda y, s: v(y, s), (x[row], t[row]))
        torch.testing.assert_close(jet.jacobian[row], jacobian)
        torch.testing.assert_close(jet.rate[row], rate)
    assert v.jet(x.reshape(2, 3, 3), t.reshape(2, 3)).jacobian.shape == (2, 3, 3, 3)


def test_carried_from_both_sides_a_rigid_motion_is_exact() -> None:
    moving = Moving(Box(half_size=(0.4, 0.2, 0.3)), SCREW)
    keys = Keyframes([0.0, 0.6, 1.0], [TimeSlice(moving, t) for t in (0.0, 0.6, 1.0)])
    field = CarriedKeyframes(keys, Screw(), steps=32)
    x = at_time(torch.randn(200, 3, dtype=torch.float64), torch.rand(200, dtype=torch.float64))
    found, exact = field.jet(x), moving.jet(x)
    torch.testing.assert_close(found.value, exact.value, rtol=0, atol=1e-7)
    corner = (found.gradient - exact.gradient).abs().amax(dim=-1) > 1e-5  # ∇ of a box jumps
    assert int(corner.sum()) == 0


def test_still_it_is_the_blend_and_at_the_keys_the_shapes() -> None:
    keys = Keyframes([0.0, 1.0], [Sphere(radius=0.3), Box()])
    x = at_time(torch.randn(50, 3, dtype=torch.float64), torch.rand(50, dtype=torch.float64))
    still = CarriedKeyframes(keys, Linear(((0.0,) * 3,) * 3))
    torch.testing.assert_close(still.jet(x).gradient, keys.jet(x).gradient)
    wild = CarriedKeyframes(keys, Linear(SHEAR))
    for time in (0.0, 1.0):
        at = at_time(x[:, :3], time)
        torch.testing.assert_close(wild.value(at), keys.value(at), rtol=0, atol=1e-14)
