"""Laws and losses against fields that obey them exactly."""

import math

import pytest
import torch
from fields import SCREW, small_spacetime
from mplicits.neural_fields import Box, FunctionField, Moving, Siren, Sphere, Torus, at_time
from mplicits.neural_fields.spacetime import evolution
from mplicits.neural_fields.spacetime.field import spacetime_jet
from mplicits.neural_fields.spacetime.moving import Keyframes
from torch import Tensor

from benchmarks.motion.figures import ShrinkingSphere


def samples(count: int, *, least: float = 0.0) -> Tensor:
    """Points of space-time whose distance from the axis of time is at least so much."""
    position = torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)
    radius = least + (1 - least) * torch.rand(count, 1, dtype=torch.float64)
    return torch.cat((radius * position, torch.rand(count, 1, dtype=torch.float64)), dim=-1)


@pytest.mark.parametrize("extend", [False, True])
@pytest.mark.parametrize("shape", [Sphere(radius=0.4, center=(0.2, 0.1, 0.0)), Torus(), Box()])
def test_rigid_motions_obey_transport(shape: Sphere | Torus | Box, extend: bool) -> None:
    jet = spacetime_jet(Moving(shape, SCREW), samples(500))
    law = evolution.transport(SCREW.velocity, extend=extend)
    assert float(law.residual(jet).abs().max()) < 1e-12
    assert float(evolution.transport(lambda x, t: 2 * SCREW.velocity(x, t)).residual(jet).abs().max()) > 0.1


def test_extension_keeps_a_distance_a_distance() -> None:
    """V = x swells a sphere as r = r₀ eᵗ. Its distance obeys the extended law, and the plain one on the surface."""
    field = FunctionField(lambda x: x[..., :3].norm(dim=-1) - 0.4 * x[..., 3].exp(), in_dim=4)
    x = samples(500, least=0.1)
    away = spacetime_jet(field, x)
    assert float(evolution.transport(lambda x, t: x, extend=True).residual(away).abs().max()) < 1e-12
    assert float(evolution.transport(lambda x, t: x).residual(away).abs().max()) > 0.1
    speed = evolution.normal_speed(lambda x, t: x.norm(dim=-1), extend=True)
    # The length of the gradient is √(|∇f|² + ε) with ε = 1e-12, and speeds are below 0.4 e.
    assert float(speed.residual(away).abs().max()) < 0.4 * math.e * 1e-12 / 2 + 1e-14
    surface = x[:, :3] / x[:, :3].norm(dim=-1, keepdim=True) * (0.4 * x[:, 3:].exp())
    there = spacetime_jet(field, at_time(surface, x[:, 3]))
    assert float(evolution.transport(lambda x, t: x).residual(there).abs().max()) < 1e-12


def test_a_sphere_shrinks_by_mean_curvature() -> None:
    x = samples(500, least=0.2)
    law = evolution.mean_curvature(0.12)
    exact = spacetime_jet(ShrinkingSphere(radius=0.8, alpha=0.12, exact_law=True), x, order=2)
    assert float(law.residual(exact).abs().max()) < 1e-9
    # As a distance: on the surface only, unless the law is extended.
    distance = ShrinkingSphere(radius=0.8, alpha=0.12)
    away = spacetime_jet(distance, x, order=2)
    assert float(law.residual(away).abs().max()) > 0.01
    assert float(evolution.mean_curvature(0.12, extend=True).residual(away).abs().max()) < 1e-9
    surface = x[:, :3] / x[:, :3].norm(dim=-1, keepdim=True) * distance.radius_at(x[:, 3:])
    there = spacetime_jet(distance, at_time(surface, x[:, 3]), order=2)
    assert float(law.residual(there).abs().max()) < 1e-9


def test_extended_curvature_of_a_torus() -> None:
    """At the distance f from a torus every point sees the two curvatures of the torus below."""
    x = samples(2000)
    jet = spacetime_jet(Moving(Torus(major=0.5, minor=0.2), SCREW), x, order=2)
    home = SCREW.inverse(jet.position, jet.time)
    rho = home[:, :2].norm(dim=-1)
    cosine = (rho - 0.5) / torch.stack((rho - 0.5, home[:, 2]), -1).norm(dim=-1)
    below = 1 / 0.2 + cosine / (0.5 + 0.2 * cosine)
    near = jet.value.abs() < 0.1
    assert int(near.sum()) > 200
    rate = evolution.mean_curvature(0.3, extend=True).rate(jet)
    torch.testing.assert_close(rate[near], 0.3 * below[near], rtol=1e-9, atol=0)


def test_curvature_of_a_network_against_the_divergence_of_its_normals() -> None:
    field = Siren(12, 2, omega=3.0, in_dim=4).double()
    x = samples(20).requires_grad_()
    normal = torch.nn.functional.normalize(field.jet(x).gradient[:, :3], dim=-1)
    divergence = sum(torch.autograd.grad(normal[:, k].sum(), x, retain_graph=True)[0][:, k] for k in range(3))
    torch.testing.assert_close(evolution.curvature(spacetime_jet(field, x, order=2)), divergence, rtol=1e-6, atol=1e-8)


def test_a_growing_sphere_morphs() -> None:
    """Concentric spheres: the blend is a distance at all times and obeys the law."""
    guide = Keyframes([0.0, 0.5, 1.0], [Sphere(radius=0.3), Sphere(radius=0.7), Sphere(radius=0.5)])
    jet = spacetime_jet(guide, samples(500, least=0.05))
    assert float(evolution.morph(guide).residual(jet).abs().max()) < 1e-10
    late = jet.time > 0.5
    torch.testing.assert_close(evolution.morph(guide).rate(jet), torch.where(late, 0.4, -0.8).double())


def test_laws_add_scale_and_take_any_callable() -> None:
    jet = spacetime_jet(small_spacetime(0.4).double(), samples(100), order=2)
    swell = evolution.Law(lambda jet: -jet.gradient.norm(dim=-1))
    law = 2.0 * swell + evolution.transport(SCREW.velocity) * 0.5 + evolution.mean_curvature(0.1)
    assert law.order == 2
    assert (swell + evolution.transport(SCREW.velocity)).order == 1
    terms = [(2, swell), (0.5, evolution.transport(SCREW.velocity)), (1, evolution.mean_curvature(0.1))]
    expected = sum(factor * term.rate(jet) for factor, term in terms)
    torch.testing.assert_close(law.rate(jet), expected)
    torch.testing.assert_close(law.residual(jet), jet.rate - expected)
    with pytest.raises(ValueError, match=r"order=law\.order"):
        law.residual(spacetime_jet(small_spacetime().double(), samples(5)))


def test_the_law_loss_is_the_squared_error_of_the_normal_speed() -> None:
    """Scaling f changes nothing; being 0.3 too slow costs 0.09."""
    jet = spacetime_jet(Moving(Sphere(), SCREW), samples(100))
    law = evolution.transport(SCREW.velocity) + evolution.normal_speed(lambda x, t: torch.full_like(t, 0.3))
    torch.testing.assert_close(evolution.law_loss(jet, law), torch.full_like(jet.value, 0.09), rtol=1e-3, atol=0)
    scaled = jet._replace(value=7 * jet.value, gradient=7 * jet.gradient, rate=7 * jet.rate)
    torch.testing.assert_close(evolution.law_loss(scaled, law), evolution.law_loss(jet, law), rtol=1e-3, atol=0)


def test_the_key_loss_sees_values_and_directions() -> None:
    x = samples(50, least=0.1)[:, :3]
    target = Sphere(radius=0.5).jet(x)
    assert float(evolution.key_loss(target, target).max()) == 0
    torch.testing.assert_close(evolution.key_loss(Sphere(radius=0.3).jet(x), target), torch.full_like(x[:, 0], 0.04))
    turned = target._replace(gradient=-target.gradient)
    torch.testing.assert_close(evolution.key_loss(turned, target, length=0.1), torch.full_like(x[:, 0], 0.04))


def test_near_surface_weights() -> None:
    value = torch.tensor([0.0, 0.1, -0.2], requires_grad=True)
    weight = evolution.near_surface(value, 0.1)
    assert not weight.requires_grad
    torch.testing.assert_close(weight, torch.tensor([0.0, -0.5, -2.0]).exp())
