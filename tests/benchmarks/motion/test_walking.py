"""The walker: both ways agree, derivatives are those of the map, legs are rigid beyond their joints."""

import pytest
import torch
from mplicits.neural_fields import TimeSlice, at_time, extract_mesh, flow
from torch import Tensor

from benchmarks.motion.walking import Walking, walker

N = 400
# Some tens of operations on numbers of order one, and a division by κ ≥ 1e-6, in float64.
ROUNDING = 1e-9
MOTION = Walking()


def inside() -> tuple[Tensor, Tensor]:
    """Points around the body, between its legs too, and times."""
    generator = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(N, 3, generator=generator, dtype=torch.float64) - 1
    x *= torch.tensor([0.14, 0.3, 0.85], dtype=torch.float64)
    return x, torch.rand(N, generator=generator, dtype=torch.float64)


def test_there_and_back():
    x, t = inside()
    t[:10] = 0.0
    assert (MOTION.inverse(MOTION.forward(x, t), t) - x).abs().max() < ROUNDING
    # The least curvature 1e-6 of both joints, times half the square of a length below 1.
    for whole in (0.0, 1.0):
        assert (MOTION.forward(x, whole) - x).abs().max() < 2e-6
    assert (MOTION.forward(x, 0.25) - x).norm(dim=1).max() > 0.3


def test_derivatives_are_those_of_the_map():
    x, t = inside()
    t = 0.03 + 0.44 * t  # at 0 and 1/2 the curvature that is held away from 0 has a jump
    places, times = x.clone().requires_grad_(), t.clone().requires_grad_()
    moved = MOTION.forward(places, times)
    rows = [torch.autograd.grad(moved[:, axis].sum(), (places, times), retain_graph=True) for axis in range(3)]
    jacobian, rate = torch.stack([row[0] for row in rows], dim=1), torch.stack([row[1] for row in rows], dim=1)
    # The series of slopes at φ = 0.05 miss φ⁶ / 10⁴; curvatures change by 2π · 2 · 0.6 / 0.16 < 50 in a unit of time.
    assert (MOTION.velocity(x, t) - rate).abs().max() < 1e-8
    covector = torch.ones_like(x) * torch.tensor([1.0, -2.0, 0.5], dtype=x.dtype)
    wanted = torch.linalg.solve(jacobian.mT, covector)
    # Between the legs ∂κ/∂y is 1.5 · 0.5 / (0.04 · 0.16) < 120, and the series miss 2e-12 of it.
    assert (MOTION.gradient(x, t, covector) - wanted).abs().max() < 1e-8


def test_thighs_and_shins_are_rigid_and_angles_are_what_they_should_be():
    t = 0.25  # the left leg, y > 0, is in front, with its knee bent
    for y, hip, knee in ((0.15, 0.5, 0.6), (-0.15, -0.5, 0.6 * 0.2 / 2.2)):
        for top, bottom, angle in ((-0.15, -0.28, hip), (-0.5, -0.8, hip - knee)):
            ends = torch.tensor([[0.05, y, top], [0.05, y, bottom]], dtype=torch.float64)
            before, after = (points[1] - points[0] for points in (ends, MOTION.forward(ends, t)))
            assert torch.dist(after.norm(), before.norm()) < 1e-9
            assert float(torch.atan2(after[0], -after[2])) == pytest.approx(angle, abs=1e-5)  # 1e-6 of curvature


def test_the_field_is_the_body_that_moves():
    field = walker()
    mesh = extract_mesh(field.field, resolution=32, normals=False)
    rest = torch.from_numpy(mesh.vertices).double()
    for time in (0.2, 0.75):
        moved = field.motion.forward(rest, time)
        assert (field.value(at_time(moved, time)) - field.field.value(rest)).abs().max() < 1e-7
        assert moved.norm(dim=1).max() < 1
        found = extract_mesh(TimeSlice(field, time), resolution=32, normals=False).vertices
        home = field.motion.inverse(torch.from_numpy(found).double(), time)
        assert field.field.value(home).abs().mean() < 0.01  # a cell is 1/16, and limbs as thin as that
    carried = flow(lambda x, t: field.motion.velocity(field.motion.inverse(x, t), t), rest[::40], 0.1, 0.4)
    wanted = field.motion.forward(field.motion.inverse(rest[::40], 0.1), 0.4)
    assert (carried - wanted).abs().max() < 1e-3  # `Solver`'s 1e-5 over a hundred steps
    points = at_time(field.motion.forward(rest[::20], 0.2), 0.2)
    jet, step = field.jet(points), 1e-6
    for axis in range(4):
        shift = torch.zeros(4, dtype=rest.dtype)
        shift[axis] = step
        slope = (field.value(points + shift) - field.value(points - shift)) / (2 * step)
        # Central differences are off by h² times third derivatives, but where parts meet in between.
        assert ((slope - jet.gradient[:, axis]).abs() < 1e-4).double().mean() > 0.98
