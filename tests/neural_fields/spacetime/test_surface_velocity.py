import pytest
import torch
from fields import SCREW
from mplicits.neural_fields import Box, Moving, Sphere, Torus, flow
from mplicits.neural_fields.spacetime.surface_velocity import CarriedVelocity

from benchmarks.motion.figures import ShrinkingSphere

ON_BOX = Box(half_size=(0.4, 0.25, 0.3))


@pytest.mark.parametrize("t", [0.0, 0.37, 1.0])
def test_a_rigid_motion_is_found_from_the_field_alone(t):
    velocity = CarriedVelocity(Moving(ON_BOX, SCREW), nodes=33)
    points = torch.tensor([[0.4, 0.1, 0.1], [0.1, -0.25, 0.2], [-0.3, 0.1, 0.3], [-0.4, -0.2, -0.1]])
    there = SCREW.forward(points, t)
    found = velocity(there, torch.full((4,), t))
    torch.testing.assert_close(found, SCREW.velocity(there, t), atol=0.02, rtol=0)
    torch.testing.assert_close(flow(velocity, points, 0.0, t), there, atol=0.02, rtol=0)


def test_what_normals_do_not_show_stays_at_rest():
    for shape, point in ((Sphere(radius=0.5), (0.5, 0.0, 0.0)), (Torus(major=0.5, minor=0.2), (0.7, 0.0, 0.0))):
        velocity = CarriedVelocity(Moving(shape, type(SCREW)(angle=3.0, velocity=(0.0, 0.0, 0.4))))
        end = flow(velocity, torch.tensor([point]), 0.0, 1.0)
        torch.testing.assert_close(end, torch.tensor([[point[0], 0.0, 0.4]]), atol=0.02, rtol=0)


def test_points_of_a_sphere_that_shrinks_go_inward():
    field, towards = ShrinkingSphere(radius=0.8, alpha=0.12), torch.nn.functional.normalize(torch.randn(50, 3), dim=-1)
    end = flow(CarriedVelocity(field), 0.8 * towards, 0.0, 1.0)
    torch.testing.assert_close(end, 0.4 * towards, atol=1e-4, rtol=0)
