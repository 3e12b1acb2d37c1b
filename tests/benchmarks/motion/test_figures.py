"""Figures that bend and twist: both ways agree, derivatives are those of the maps, volumes are what they should be."""

import math

import numpy as np
import pytest
import torch
from motions import ROUNDING, check_carried, check_derivatives, check_jets, inside, slopes
from mplicits.datasets.synthetic.scanner import simulate_scan
from mplicits.neural_fields import Field, Sphere, TimeSlice, at_time

from benchmarks.motion.figures import Bending, DeformingField, Twisting, bending_arm, twisting_bar

N = 500
MOTIONS = [Bending(angle=1.6, half=0.3), Bending(angle=2.4, half=0.4), Twisting(angle=1.8, half=0.6)]
FIGURES = [bending_arm, twisting_bar]
BEAM = (0.15, 0.3, 0.9)  # thin enough to be bent; points lie below, in and above the arc


@pytest.mark.parametrize("motion", MOTIONS, ids=repr)
def test_there_and_back(motion):
    x, t = inside(*BEAM)
    t[:10] = 0.0
    assert (motion.inverse(motion.forward(x, t), t) - x).abs().max() < ROUNDING
    moved = (motion.forward(x, 1.0) - x).norm(dim=1)
    assert moved.max() > 0.3


@pytest.mark.parametrize("motion", MOTIONS, ids=repr)
def test_derivatives_are_those_of_the_map(motion):
    x, t = inside(*BEAM)
    check_derivatives(motion, x, 0.05 + 0.95 * t, gradient_bound=ROUNDING)


def test_twisting_keeps_volumes_and_bending_stretches_by_one_minus_kappa_x():
    x, t = inside(*BEAM)
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
    off = line - torch.tensor([radius, 0.0, -0.25], dtype=torch.float64)
    assert (off.norm(dim=1) - radius).abs().max() < 1e-12
    assert (off[-1] - torch.tensor([0.0, 0.0, radius], dtype=torch.float64)).abs().max() < 1e-12


@pytest.mark.parametrize("figure", FIGURES)
def test_jets_are_the_derivatives_of_values(figure):
    field = figure()
    x, t = inside(*BEAM)
    t = 0.05 + 0.9 * t
    check_jets(field, at_time(field.motion.forward(x, t), t), bound=1e-5, share=0.99)


@pytest.mark.parametrize("figure", FIGURES)
def test_points_of_the_surface_stay_on_it_and_in_the_unit_sphere(figure):
    field = figure()
    check_carried(field, torch.from_numpy(scan(field, 0.0)).double(), (0.3, 1.0), until=0.9)


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
