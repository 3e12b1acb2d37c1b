"""Colour networks and texture fields: values, Jacobians, directional derivatives, and the band."""

import pytest
import torch
from bounds import assert_within, rounding
from fields import Watched
from mplicits.neural_fields import (
    Field,
    Jet,
    MultiscaleSDF,
    Siren,
    Sphere,
    TextureField,
    Torus,
)
from mplicits.neural_fields.fields.losses import color_loss, tangential_loss
from mplicits.neural_fields.networks.colors import ColorSiren
from torch import Tensor


def network(depth: int = 2, in_dim: int = 3) -> ColorSiren:
    """Small, with colours that go below 0 and above 1 in the unit cube."""
    made = ColorSiren(16, depth, omega=4.0, in_dim=in_dim)
    with torch.no_grad():
        made.siren.output.weight.mul_(8)
    return made


def texture(geometry: Field | None = None, delta: float = 0.2) -> TextureField:
    return TextureField(geometry or Torus(major=0.5, minor=0.2), network(), delta=delta, outside=(0.1, 0.2, 0.3))


def cube(*shape: int, dtype: torch.dtype = torch.float64, in_dim: int = 3) -> Tensor:
    return 2 * torch.rand(*shape, in_dim, dtype=dtype) - 1


def autograd_jacobian(value: Tensor, x: Tensor, *, create_graph: bool = False) -> Tensor:
    """(N, 3) of (N, d) → (N, 3, d)."""
    rows = [
        torch.autograd.grad(value[:, c].sum(), x, create_graph=create_graph, retain_graph=True)[0] for c in range(3)
    ]
    return torch.stack(rows, dim=1)


def test_network_is_equation_2_with_three_outputs() -> None:
    made = network().double()
    x = cube(7)
    h = x
    for layer in made.siren.layers:
        h = torch.sin(4.0 * (h @ layer.weight.T + layer.bias))
    torch.testing.assert_close(made.value(x), h @ made.siren.output.weight.T + made.siren.output.bias)


def test_untrained_network_gives_the_mean_color() -> None:
    value = ColorSiren(256, 3, omega=60.0, mean=(0.9, 0.5, 0.1)).value(cube(100, dtype=torch.float32))
    torch.testing.assert_close(value.mean(dim=0).detach(), torch.tensor([0.9, 0.5, 0.1]), rtol=0, atol=0.05)
    assert value.std(dim=0).max() < 0.1


@pytest.mark.parametrize(("depth", "in_dim"), [(1, 3), (2, 3), (3, 3), (2, 4)])
def test_jacobian_and_directional_derivative_agree_with_autograd(depth: int, in_dim: int) -> None:
    made = network(depth, in_dim).double()
    x, v = cube(60, in_dim=in_dim).requires_grad_(), cube(60, in_dim=in_dim)
    value = made.value(x)
    expected = autograd_jacobian(value, x)
    with_value, gradient = made.jet(x)
    torch.testing.assert_close(with_value, value)
    torch.testing.assert_close(gradient, expected)
    with_value, along = made.derivative_along(x, v)
    torch.testing.assert_close(with_value, value)
    torch.testing.assert_close(along, torch.einsum("ncd,nd->nc", expected, v))


@pytest.mark.parametrize("depth", [1, 3])
def test_parameter_gradients_of_the_derivatives_agree_with_autograd(depth: int) -> None:
    made = network(depth).double()
    x, v = cube(30).requires_grad_(), cube(30)
    jacobian = autograd_jacobian(made.value(x), x, create_graph=True)
    parameters = list(made.parameters())

    def gradients(value: Tensor, along: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad((value**3).sum() + (along**2).sum(), parameters)

    expected = gradients(made.value(x), torch.einsum("ncd,nd->nc", jacobian, v))
    value, gradient = made.jet(x)
    found_by_jet = gradients(value, torch.einsum("ncd,nd->nc", gradient, v))
    found_by_tangent = gradients(*made.derivative_along(x, v))
    for a, b, c in zip(expected, found_by_jet, found_by_tangent, strict=True):
        torch.testing.assert_close(b, a)
        torch.testing.assert_close(c, a)


def test_inference_in_blocks_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    made = network(3).double()
    x, v = cube(1000), cube(1000)
    off = rounding(made, x, lambda made, x: (made.value(x), *made.jet(x), *made.derivative_along(x, v)))
    expected = (made.value(x), *made.jet(x), *made.derivative_along(x, v))
    monkeypatch.setattr("mplicits.neural_fields.networks.siren.BLOCK_FLOATS", 16 * 256)
    with torch.inference_mode():
        found = (made.value(x), *made.jet(x), *made.derivative_along(x, v))
    for a, b, bound in zip(found, expected, off, strict=True):
        assert_within(a, b, 2 * bound)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (7,), (2, 3), (3, 0, 2)])
def test_shapes_and_types_follow_the_input(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    field = texture().to(device=device, dtype=dtype)
    x = cube(*shape, dtype=dtype).to(device)
    for mode in (torch.enable_grad, torch.inference_mode):
        with mode():
            jet = field.jet(x)
            assert isinstance(jet, Jet)
            value, along = field.derivative_along(x, x)
            for color in (field.value(x), field.colors(x), jet.value, value, along):
                assert color.shape == (*shape, 3)
                assert color.dtype == dtype
                assert color.device.type == device.type
            assert jet.gradient.shape == (*shape, 3, 3)
            assert jet.features.shape == (*shape, 0)
            assert field.in_band(x).shape == shape


def test_colors_are_those_of_the_network_in_the_band_and_constant_outside() -> None:
    field = texture().double()
    x = cube(2000)
    inside = field.geometry.value(x).abs() < 0.2
    assert 100 < inside.sum() < 1900
    assert torch.equal(field.in_band(x), inside)
    raw, value = field.network.value(x), field.value(x)
    assert (raw[inside] < 0).any()
    assert (raw[inside] > 1).any()
    torch.testing.assert_close(value[inside], raw[inside].clamp(0, 1))
    outside = field.outside.expand(int((~inside).sum()), 3)
    assert torch.equal(value[~inside], outside)
    assert torch.equal(outside[0], torch.tensor([0.1, 0.2, 0.3]).double())
    torch.testing.assert_close(field.colors(x), raw.clamp(0, 1))


def test_derivatives_of_the_clamped_and_gated_colors_agree_with_autograd() -> None:
    field = texture().double()
    x, v = cube(500).requires_grad_(), cube(500)
    expected = autograd_jacobian(field.value(x), x)
    assert (expected[~field.in_band(x)] == 0).all()
    torch.testing.assert_close(field.jet(x).gradient, expected)
    torch.testing.assert_close(field.derivative_along(x, v)[1], torch.einsum("ncd,nd->nc", expected, v))
    torch.testing.assert_close(field.derivative_along(x, v)[0], field.value(x))


def test_the_geometry_is_asked_once_and_the_network_only_in_the_band(monkeypatch: pytest.MonkeyPatch) -> None:
    geometry = Watched(Sphere(radius=0.5))
    field = texture(geometry, delta=0.05)
    seen: list[int] = []
    evaluate = ColorSiren.value
    monkeypatch.setattr(ColorSiren, "value", lambda self, x: (seen.append(len(x)), evaluate(self, x))[1])
    x = cube(1000, dtype=torch.float32)
    inside = int((geometry.inner.value(x).abs() < 0.05).sum())
    field.value(x)
    assert (geometry.counts(), seen) == ((1000, 0), [inside])
    field.colors(x)
    assert geometry.counts() == (1000, 0)


def test_the_level_of_the_geometry_decides_the_band() -> None:
    geometry = MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0)], [0.3])
    x = cube(3000, dtype=torch.float32)
    coarse = TextureField(geometry, network(), delta=0.1, geometry_level=0)
    fine = TextureField(geometry, network(), delta=0.1)
    assert (coarse.geometry_level, fine.geometry_level) == (0, 1)
    assert torch.equal(coarse.in_band(x), (x.norm(dim=-1) - 0.5).abs() < 0.1)
    assert torch.equal(fine.in_band(x), geometry.value(x).abs() < 0.1)
    assert not torch.equal(coarse.in_band(x), fine.in_band(x))


def test_training_leaves_the_geometry_alone() -> None:
    geometry = Siren(16, 2, omega=4.0)
    field = texture(geometry)
    value, along = field.derivative_along(cube(200, dtype=torch.float32), cube(200, dtype=torch.float32))
    (value.square().sum() + along.square().sum()).backward()
    assert all(parameter.grad is None for parameter in geometry.parameters())
    assert all(parameter.grad is not None for parameter in field.network.parameters())


def test_loss_terms_are_those_of_the_paper() -> None:
    color, target = torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]), torch.tensor([[0.5, 0.5, 0.5], [0.4, 0.0, 0.3]])
    torch.testing.assert_close(color_loss(color, target), torch.tensor([0.0, (0.36 + 0.09) / 3]))
    derivative = torch.tensor([[3.0, 0.0, -4.0], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(tangential_loss(derivative, 0.1), torch.tensor([0.01 * 25 / 3, 0.0]))
