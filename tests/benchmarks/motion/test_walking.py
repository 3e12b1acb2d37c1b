"""The walker: both ways agree, derivatives are those of the map, legs are rigid beyond their joints."""

import pytest
import torch
from motions import ROUNDING, check_carried, check_derivatives, check_jets, inside
from mplicits.neural_fields import TimeSlice, at_time, extract_mesh

from benchmarks.motion.walking import Walking, walker

MOTION = Walking()
BODY = (0.14, 0.3, 0.85)  # points lie between its legs too


def test_there_and_back():
    x, t = inside(*BODY)
    t[:10] = 0.0
    assert (MOTION.inverse(MOTION.forward(x, t), t) - x).abs().max() < ROUNDING
    # The least curvature 1e-6 of both joints, times half the square of a length below 1.
    for whole in (0.0, 1.0):
        assert (MOTION.forward(x, whole) - x).abs().max() < 2e-6
    assert (MOTION.forward(x, 0.25) - x).norm(dim=1).max() > 0.3


def test_derivatives_are_those_of_the_map():
    # The curvature, held away from 0, jumps at 0 and 1/2; it changes by 2π · 2 · 0.6 / 0.16 < 50 in a unit of time.
    # Between the legs ∂κ/∂y is 1.5 · 0.5 / (0.04 · 0.16) < 120. The series miss 2e-12 of it.
    x, t = inside(*BODY)
    check_derivatives(MOTION, x, 0.03 + 0.44 * t, gradient_bound=1e-8)


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
    rest = torch.from_numpy(extract_mesh(field.field, resolution=32, normals=False).vertices).double()
    check_carried(field, rest, (0.2, 0.75), until=0.4)
    check_jets(field, at_time(field.motion.forward(rest[::20], 0.2), 0.2), bound=1e-4, share=0.98)
    for time in (0.2, 0.75):
        found = extract_mesh(TimeSlice(field, time), resolution=32, normals=False).vertices
        home = field.motion.inverse(torch.from_numpy(found).double(), time)
        assert field.field.value(home).abs().mean() < 0.01  # a cell is 1/16, and limbs as thin as that
