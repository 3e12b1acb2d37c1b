"""Figures that bend and twist: both ways agree, derivatives are those of the maps, volumes are what they should be."""

import math

import numpy as np
import pytest
import torch
from mplicits.datasets.synthetic.scanner import simulate_scan
from mplicits.neural_fields import Field, Sphere, TimeSlice, at_time, flow
from torch import Tensor

from benchmarks.motion.figures import Bending, DeformingField, Motion, Twisting, bending_arm, twisting_bar

MOTIONS = [Bending(angle=1.6, half=0.3), Bending(angle=2.4, half=0.4), Twisting(angle=1.8, half=0.6)]
FIGURES = [bending_arm, twisting_bar]
N = 500
# Some tens of operations on numbers of order one, and a division by κ ≥ 1e-6, in float64.
ROUNDING = 1e-9


def inside() -> tuple[Tensor, Tensor]:
    """Points of a beam that is thin enough to be bent, below, in and above the arc, and times."""
    generator = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(N, 3, generator=generator, dtype=torch.float64) - 1
    return x * torch.tensor([0.15, 0.3, 0.9], dtype=torch.float64), torch.rand(
        N, generator=generator, dtype=torch.float64
    )


def slopes(motion: Motion, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """∂Φ/∂X ``(N, 3, 3)`` and ∂Φ/∂t ``(N, 3)`` by autograd: no row of the map looks at another one."""
    x, t = x.clone().requires_grad_(), t.clone().requires_grad_()
    moved = motion.forward(x, t)
    rows = [torch.autograd.grad(moved[:, axis].sum(), (x, t), retain_graph=True) for axis in range(3)]
    return torch.stack([row[0] for row in rows], dim=1), torch.stack([row[1] for row in rows], dim=1)


@pytest.mark.parametrize("motion", MOTIONS, ids=repr)
def test_there_and_back(motion):
    x, t = inside()
    t[:10] = 0.0
    assert (motion.inverse(motion.forward(x, t), t) - x).abs().max() < ROUNDING
    moved = (motion.forward(x, 1.0) - x).norm(dim=1)
    assert moved.max() > 0.3


@pytest.mark.parametrize("motion", MOTIONS, ids=repr)
def test_derivatives_are_those_of_the_map(motion):
    x, t = inside()
    t = 0.05 + 0.95 * t
    jacobian, rate = slopes(motion, x, t)
    assert (motion.velocity(x, t) - rate).abs().max() < 1e-8  # the series at φ = 0.05: φ⁶ / 10⁴
    covector = torch.ones_like(x) * torch.tensor([1.0, -2.0, 0.5], dtype=x.dtype)
    wanted = torch.linalg.solve(jacobian.mT, covector)
    assert (motion.gradient(x, t, covector) - wanted).abs().max() < ROUNDING


def test_twisting_keeps_volumes_and_bending_stretches_by_one_minus_kappa_x():
    x, t = inside()
    for motion in MOTIONS:
        jacobian, _ = slopes(motion, x, t)
        wanted = torch.ones(N, dtype=x.dtype)
        if isinstance(motion, Bending):
            arc = x[:, 2].abs() < motion.half
            wanted = torch.where(arc, 1 - motion.angle * t / (2 * motion.half) * x[:, 0], wanted)
        assert (torch.linalg.det(jacobian) - wanted).abs().max() < 1e-6  # the least curvature


def test_the_middle_line_of_a_beam_becomes_a_quarter_of_a_circle():
    motion = Bending(angle=math.pi / 2, half=0.25)
    z = torch.linspace(-0.25, 0.25, 11, dtype=torch.float64)
    line = motion.forward(torch.stack((0 * z, 0 * z, z), dim=1), 1.0)
    radius = 0.5 / (math.pi / 2)
    center = torch.tensor([radius, 0.0, -0.25], dtype=torch.float64)
    assert ((line - center).norm(dim=1) - radius).abs().max() < 1e-12
    assert torch.allclose(line[-1], center + torch.tensor([0.0, 0.0, radius], dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("figure", FIGURES)
def test_jets_are_the_derivatives_of_values(figure):
    field: Field = figure()
    x, t = inside()
    t = 0.05 + 0.9 * t
    points = at_time(field.motion.forward(x, t), t)
    jet = field.jet(points)
    assert torch.equal(jet.value, field.value(points))
    step = 1e-6
    for axis in range(4):
        shift = torch.zeros(4, dtype=x.dtype)
        shift[axis] = step
        slope = (field.value(points + shift) - field.value(points - shift)) / (2 * step)
        # Central differences are off by h² times third derivatives, but where parts meet in between.
        assert ((slope - jet.gradient[:, axis]).abs() < 1e-5).double().mean() > 0.99


@pytest.mark.parametrize("figure", FIGURES)
def test_points_of_the_surface_stay_on_it_and_in_the_unit_sphere(figure):
    field: DeformingField = figure()
    rest = torch.from_numpy(scan(field, 0.0)).double()
    for time in (0.3, 1.0):
        moved = field.motion.forward(rest, time)
        values = field.value(at_time(moved, time)) - field.field.value(rest)
        assert values.abs().max() < 1e-7
        assert moved.norm(dim=1).max() < 1
    carried = flow(lambda x, t: field.motion.velocity(field.motion.inverse(x, t), t), rest[:50], 0.1, 0.9)
    wanted = field.motion.forward(field.motion.inverse(rest[:50], 0.1), 0.9)
    assert (carried - wanted).abs().max() < 1e-3  # `Solver`'s 1e-5 over a hundred steps


def scan(field: Field, time: float) -> np.ndarray:
    return simulate_scan(TimeSlice(field, time), scanners=2, resolution=24, noise=0.0).points


@pytest.mark.parametrize("figure", FIGURES)
def test_scans_lie_on_the_surface_of_their_time(figure):
    field = figure()
    points = torch.from_numpy(scan(field, 0.7)).double()
    assert len(points) > 50
    assert field.value(at_time(points, 0.7)).abs().max() < 1e-3  # where rays graze, 4e-5, and a slope below 25


def test_a_shape_at_rest_is_itself():
    ball = Sphere(radius=0.2)
    points = at_time(torch.rand(50, 3, dtype=torch.float64) - 0.5, 0.0)
    assert torch.equal(DeformingField(ball, Twisting()).value(points), ball.value(points[:, :3]))
