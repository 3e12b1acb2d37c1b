"""Projection onto exact surfaces, and attributes at points near and far from them."""

import math

import pytest
import torch
from bounds import rounding
from mplicits.neural_fields import Jet, Siren, Sphere, TextureField, Torus, map_colors, project_to_surface
from mplicits.neural_fields.fields.field import OneLevelField
from mplicits.neural_fields.networks.colors import ColorSiren
from mplicits.neural_fields.tracing.sphere import map_attribute
from torch import Tensor

MAJOR, MINOR = 0.5, 0.2


def torus_point(u: Tensor, v: Tensor, minor: float | Tensor = MINOR) -> Tensor:
    """Angle u around the axis z, angle v around the tube, at distance ``minor`` from its core."""
    ring = MAJOR + minor * torch.cos(v)
    return torch.stack((ring * torch.cos(u), ring * torch.sin(u), minor * torch.sin(v)), dim=-1)


def angles(count: int) -> tuple[Tensor, Tensor]:
    return tuple(2 * math.pi * torch.rand(2, count, dtype=torch.float64))  # type: ignore[return-value]


class _Squared(OneLevelField):
    """``|x|² − r²``: right on its zero set, wrong as a distance; steps along ∇f stay on the rays."""

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        return x.square().sum(dim=-1) - 0.25

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        return Jet(self.value(x), 2 * x, x.new_empty((*x.shape[:-1], 0)))


def test_closest_points_of_a_torus() -> None:
    torus = Torus(major=MAJOR, minor=MINOR).double()
    u, v = angles(2000)
    offset = MINOR + 0.35 * torch.rand(2000, dtype=torch.float64) - 0.15  # inside and outside the tube
    inner = MAJOR + offset * torch.cos(v) > 0.05  # further through the hole the other side is nearer
    feet, arrived = project_to_surface(torus, torus_point(u, v, offset)[inner])
    assert arrived.all()
    torch.testing.assert_close(feet, torus_point(u, v)[inner], rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3)])
def test_shapes(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    x = (torch.rand(*shape, 3, dtype=dtype) + 0.1).to(device)
    feet, arrived = project_to_surface(Sphere(radius=0.5), x)
    assert arrived.shape == shape
    torch.testing.assert_close(feet, x / x.norm(dim=-1, keepdim=True) / 2, rtol=0, atol=1e-5)
    assert feet.device.type == device.type


def test_a_field_that_is_no_distance_takes_several_steps() -> None:
    x = torch.randn(500, 3, dtype=torch.float64)
    x = x / x.norm(dim=-1, keepdim=True) * (0.3 + 0.6 * torch.rand(500, 1, dtype=torch.float64))
    feet, arrived = project_to_surface(_Squared(), x, tolerance=1e-10)
    assert arrived.all()
    torch.testing.assert_close(feet, x / x.norm(dim=-1, keepdim=True) / 2, rtol=0, atol=1e-9)
    assert not project_to_surface(_Squared(), x, tolerance=1e-10, steps=1)[1].any()


def test_points_without_a_way_have_not_arrived() -> None:
    """At the centre of the sphere ∇f has no direction; a network without a zero set has no surface."""
    feet, arrived = project_to_surface(_Squared(), torch.zeros(1, 3))
    assert not arrived.any()
    assert torch.isfinite(feet).all()
    empty = Siren(16, 2, omega=3.0)
    with torch.no_grad():
        empty.output.bias.fill_(5.0)
    assert not project_to_surface(empty, torch.rand(20, 3))[1].any()


def test_the_surface_of_a_siren() -> None:
    """Untrained, and so no distance; shifted so that it has a zero set."""
    network = Siren(32, 2, omega=4.0).double()
    x = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
    with torch.no_grad():
        network.output.bias.sub_(network.value(x).median())
    feet, arrived = project_to_surface(network, x, steps=30)
    assert arrived.float().mean() > 0.5
    # The projection looks at the values of jets, which are rounded in their own way.
    value, off = network.value(feet).abs(), 2 * rounding(network, feet, lambda field, x: [field.value(x)])[0]
    assert (value < 1e-5 + off)[arrived].all()
    assert (value >= 1e-5 - off)[~arrived].all()


class _AroundTheTube(ColorSiren):
    """Colours that depend on the angles of the closest point of the torus only, so constant along its normals."""

    def value(self, x: Tensor) -> Tensor:
        u = torch.atan2(x[..., 1], x[..., 0])
        v = torch.atan2(x[..., 2], x[..., :2].norm(dim=-1) - MAJOR)
        return torch.stack((torch.cos(u), torch.sin(v), torch.cos(u + v)), dim=-1) / 2 + 0.5


def exact_texture(delta: float) -> TextureField:
    return TextureField(Torus(major=MAJOR, minor=MINOR), _AroundTheTube(2, 1), delta=delta, outside=(1, 0, 1)).double()


@pytest.mark.parametrize("shift", [-0.1, -0.01, 0.0, 0.02, 0.15])
def test_shifted_surfaces_have_the_colors_of_their_closest_points(shift: float) -> None:
    texture = exact_texture(0.03)
    u, v = angles(1000)
    surface = torus_point(u, v, MINOR + shift)
    colors, reached = map_colors(texture, surface, batch=300)
    assert reached.all()
    torch.testing.assert_close(colors, texture.colors(torus_point(u, v)), rtol=0, atol=1e-10)


def test_points_of_the_band_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    texture = exact_texture(0.03)
    u, v = angles(200)
    near, far = torus_point(u, v, 0.21), torus_point(u, v, 0.29)
    seen: list[Tensor] = []
    evaluate = _AroundTheTube.value
    monkeypatch.setattr(_AroundTheTube, "value", lambda self, x: (seen.append(x), evaluate(self, x))[1])
    map_colors(texture, torch.stack((near, far)))
    torch.testing.assert_close(seen[0], torch.cat((near, torus_point(u, v))), rtol=0, atol=1e-12)
    assert torch.equal(seen[0][:200], near)


def test_points_that_are_not_reached_get_the_color_of_outside() -> None:
    texture = TextureField(_Squared(), ColorSiren(4, 1), delta=0.1, outside=(1, 0, 1))
    colors, reached = map_colors(texture, torch.tensor([[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert reached.tolist() == [True, False]
    assert colors[1].tolist() == [1, 0, 1]
    assert colors[0].tolist() != [1, 0, 1]


def test_normals_of_a_fine_surface_on_a_coarse_one() -> None:
    """Neural normal mapping at traced or meshed points: of a polyhedron, say, inside the sphere."""
    sphere = Sphere(radius=0.5).double()
    points = torch.randn(300, 3, dtype=torch.float64)
    points = points / points.norm(dim=-1, keepdim=True) * (0.3 + 0.3 * torch.rand(300, 1, dtype=torch.float64))
    normals, reached = map_attribute(sphere, lambda x: sphere.jet(x).gradient, points.reshape(3, 100, 3), delta=0.05)
    assert reached.shape == (3, 100)
    assert reached.all()
    torch.testing.assert_close(normals.reshape(-1, 3), points / points.norm(dim=-1, keepdim=True))


def test_no_points() -> None:
    colors, reached = map_colors(exact_texture(0.1), torch.empty(0, 3, dtype=torch.float64))
    assert colors.shape == (0, 3)
    assert reached.shape == (0,)
