"""Light that reaches a surface, where geometry says how much that is."""

import pytest
import torch
from mplicits.neural_fields import Box, Field, FunctionField, MultiscaleSDF, Plane, Siren, Sphere, Torus, Union
from mplicits.pipelines.render.shade import ambient_occlusion, level_set_curvature, soft_shadow

UP = torch.tensor([0.0, 0.0, 1.0])
HEIGHT, RADIUS = 0.6, 0.2


def ball_over_plane() -> Field:
    return Union(Plane(), Sphere(radius=RADIUS, center=(0, 0, HEIGHT)))


def on_plane(*places: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.tensor([(x, y, 0.0) for x, y in places])
    return points, UP.expand_as(points)


def on_torus(count: int) -> torch.Tensor:
    """Random points of the torus (0.5, 0.2)."""
    u, v = (2 * torch.pi * torch.rand(2, count, dtype=torch.float64)).unbind()
    rho = 0.5 + 0.2 * v.cos()
    return torch.stack((rho * u.cos(), rho * u.sin(), 0.2 * v.sin()), -1)


@pytest.mark.parametrize("tilt", [0.0, 0.4, -0.6])
def test_a_sharp_shadow_of_a_ball_is_the_ellipse_that_geometry_says(tilt):
    # Towards the lamp (sin, 0, cos): the shadow's centre is at −h tan, its half axes r / cos along x and r along y.
    tilt = torch.tensor(tilt)
    lamp = torch.stack((tilt.sin(), torch.zeros(()), tilt.cos()))
    angle = torch.linspace(0, 2 * torch.pi, 41)
    center, wide = -HEIGHT * tilt.tan(), RADIUS / tilt.cos()
    for scale, expected in ((0.99, 0.0), (1.01, 1.0)):
        points = torch.stack((center + scale * wide * angle.cos(), scale * RADIUS * angle.sin(), 0 * angle), -1)
        lit = soft_shadow(ball_over_plane(), points, UP.expand_as(points), lamp, softness=1e-3, offset=1e-4)
        assert (lit == expected).all()


def test_the_penumbra_of_a_thin_plate_has_its_width_and_profile():
    edge, height, softness = 0.1, 0.5, 0.2
    plate = Box(half_size=(0.4, 2.0, 0.002), center=(edge + 0.4, 0, height))
    away = torch.tensor([-0.02, 0.005, 0.02, 0.05, 0.08, 0.12, 0.3])  # from the edge of the shadow
    places = on_plane(*((edge - d, 0.0) for d in away.tolist()))
    lit = soft_shadow(Union(Plane(), plate), *places, UP, softness=softness)
    # The narrowest place is the one nearest to the edge: a distance d after h, give or take the way d can go along.
    u = (away / (softness * height)).clamp(0, 1)
    torch.testing.assert_close(lit, u * u * (3 - 2 * u), atol=0.03, rtol=0)
    assert (lit[0], lit[-1]) == (0, 1)


@pytest.mark.parametrize("elevation", [0.02, 0.1, 0.5, 1.2])
def test_nothing_convex_shadows_itself_and_what_faces_away_is_dark(elevation):
    elevation = torch.tensor(elevation)
    lamp = torch.stack((elevation.cos(), torch.zeros(()), elevation.sin()))
    points, normals = on_plane((0, 0), (0.5, -0.3), (-0.9, 0.1))
    assert (soft_shadow(Plane(), points, normals, lamp) == 1).all()
    assert (soft_shadow(Plane(), points, normals, -lamp) == 0).all()
    normals = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    lit = soft_shadow(Sphere(radius=0.6), 0.6 * normals, normals, lamp)
    assert torch.equal(lit, (normals @ lamp > 0).float())


def test_softer_lamps_blur_more_and_never_brighten():
    points, normals = on_plane(*((x / 50, 0.0) for x in range(45)))
    lit = torch.stack([soft_shadow(ball_over_plane(), points, normals, UP, softness=s) for s in (1e-3, 0.05, 0.2, 0.4)])
    assert (lit[1:] <= lit[:-1] + 1e-3).all()
    blurred = ((lit > 0.01) & (lit < 0.99)).sum(1)
    assert (blurred[1:] > blurred[:-1]).all()


def test_a_coarse_level_shadows_the_finer_surface_but_not_itself():
    """Points of the fine level lie under the coarse one, which must not put them in the dark."""
    coarse = Union(Plane(offset=0.01), Sphere(radius=RADIUS, center=(0, 0, HEIGHT)))
    points, normals = on_plane((0, 0), (0.1, 0), (0.7, 0.2), (-0.8, 0))
    assert soft_shadow(coarse, points, normals, UP, softness=0.05).tolist() == [0, 0, 1, 1]


def raised(height: float) -> Field:
    """A residual that moves the surface outward by a constant."""
    return FunctionField(lambda x: torch.full_like(x[..., 0], -height))


def test_rays_through_the_bands_of_a_multiscale_field_meet_the_fine_surface():
    field = MultiscaleSDF(ball_over_plane(), [raised(0.05)], [0.08])
    points = torch.tensor([[0.0, 0, 0.05], [0.225, 0, 0.05], [0.28, 0, 0.05]])  # the ball's radius is 0.25 now
    lit = soft_shadow(field, points, UP.expand_as(points), UP, softness=1e-3)
    assert lit.tolist() == [0, 0, 1]
    # A coarse ball of next to no size grows to 0.06: steps of the coarse value jump over what its rim shadows.
    field = MultiscaleSDF(Sphere(radius=1e-3), [raised(0.059)], [0.08])
    points = torch.stack((torch.full((200,), 0.058), torch.zeros(200), -torch.linspace(0.06, 0.3, 200)), -1)
    assert (soft_shadow(field, points, UP.expand_as(points), UP, softness=1e-3) == 0).all()


def test_the_middle_of_a_thin_plates_shadow_is_dark_however_soft():
    plate = Box(half_size=(0.6, 0.6, 1e-3), center=(0, 0, 0.3))
    points = torch.stack((torch.zeros(50), torch.zeros(50), torch.linspace(-0.6, 0.2, 50)), -1)
    for softness in (0.15, 0.5, 0.9):
        assert (soft_shadow(plate, points, UP.expand_as(points), UP, softness=softness) == 0).all()


@pytest.mark.parametrize("reach", [0.05, 0.2, 0.5])
def test_planes_and_convex_shapes_are_open(reach):
    points, normals = on_plane((0, 0), (0.4, 0.1))
    torch.testing.assert_close(ambient_occlusion(Plane(), points, normals, reach=reach), torch.ones(2))
    normals = torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    openness = ambient_occlusion(Sphere(radius=0.6), 0.6 * normals, normals, reach=reach)
    torch.testing.assert_close(openness, torch.ones(50))


def test_a_corner_darkens_with_nearness_and_with_reach():
    corner = Union(Plane(), Plane(normal=(1, 0, 0)))  # free where x > 0 and z > 0
    away = torch.tensor([0.01, 0.03, 0.1, 0.3])
    points, normals = on_plane(*((a, 0.0) for a in away.tolist()))
    last = torch.ones(4)
    for reach in (0.02, 0.05, 0.1, 0.2, 0.4):
        openness = ambient_occlusion(corner, points, normals, reach=reach, samples=8)
        steps = reach * torch.arange(1, 9)[:, None] / 8
        torch.testing.assert_close(openness, (away / steps).clamp(max=1).mean(0), atol=1e-5, rtol=0)
        assert (openness <= last + 1e-6).all()
        assert (openness[1:] >= openness[:-1]).all()
        last = openness
    assert last[0] < 0.2


def test_no_points_are_no_work(device):
    none = torch.empty(0, 3, device=device)
    field = Sphere().to(device)
    assert soft_shadow(field, none, none, UP).shape == ambient_occlusion(field, none, none).shape == (0,)
    assert level_set_curvature(field, none).shape == (0,)


def test_curvature_of_spheres_planes_and_a_torus(dtype):
    tolerance = 2e-4 if dtype == torch.float64 else 2e-2
    direction = torch.nn.functional.normalize(torch.randn(200, 3, dtype=dtype), dim=1)
    for radius in (0.1, 0.25, 0.8):
        found = level_set_curvature(Sphere(radius=radius), radius * direction)
        torch.testing.assert_close(found, torch.full_like(found, 1 / radius), rtol=tolerance, atol=0)
    assert level_set_curvature(Plane(normal=(1, 2, 2)), direction).abs().max() < tolerance
    points = on_torus(500)
    rho = points[:, :2].norm(dim=1)
    expected = (1 / 0.2 + (rho - 0.5) / 0.2 / rho) / 2  # of the tube, and of the circle around the axis
    found = level_set_curvature(Torus(major=0.5, minor=0.2), points.to(dtype))
    torch.testing.assert_close(found, expected.to(dtype), atol=5 * tolerance, rtol=0)


def test_curvature_of_a_network_is_half_the_divergence_of_its_unit_gradient():
    torch.manual_seed(3)
    field = Siren(24, 2, omega=4.0).double()
    points = torch.rand(50, 3, dtype=torch.float64, requires_grad=True)
    unit = torch.nn.functional.normalize(field.jet(points).gradient, dim=-1)
    rows = [torch.autograd.grad(unit[:, k].sum(), points, retain_graph=True)[0][:, k] for k in range(3)]
    exact = torch.stack(rows).sum(0) / 2
    found = level_set_curvature(field, points.detach(), step=1e-4)
    torch.testing.assert_close(found, exact.detach(), rtol=1e-4, atol=1e-4)
