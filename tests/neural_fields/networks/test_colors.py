import pytest
import torch
from bounds import assert_within, rounding
from fields import Watched, cube
from mplicits.neural_fields import ColorNetwork, Field, MultiscaleSDF, Siren, Sphere, TextureField, Torus
from mplicits.neural_fields.networks.colors import BackgroundField, ColorSiren, encode, encoded_size
from mplicits.neural_fields.networks.grids import HashEncoding
from torch import Tensor


def network(depth: int = 2, in_dim: int = 3) -> ColorSiren:
    """Small, with colours that go below 0 and above 1 in the unit cube."""
    made = ColorSiren(16, depth, omega=4.0, in_dim=in_dim)
    with torch.no_grad():
        made.siren.output.weight.mul_(8)
    return made


def texture(geometry: Field | None = None, delta: float = 0.2) -> TextureField:
    return TextureField(geometry or Torus(major=0.5, minor=0.2), network(), delta=delta, outside=(0.1, 0.2, 0.3))


def autograd_jacobian(value: Tensor, x: Tensor, *, create_graph: bool = False) -> Tensor:
    """(N, 3) of (N, d) → (N, 3, d)."""
    options = {"create_graph": create_graph, "retain_graph": True}
    return torch.stack([torch.autograd.grad(value[:, c].sum(), x, **options)[0] for c in range(3)], dim=1)


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
    x, v = cube(60, dim=in_dim).requires_grad_(), cube(60, dim=in_dim)
    value = made.value(x)
    expected = autograd_jacobian(value, x)
    torch.testing.assert_close(tuple(made.jet(x)), (value, expected))
    along = torch.einsum("ncd,nd->nc", expected, v)
    torch.testing.assert_close(tuple(made.derivative_along(x, v)), (value, along))


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
    torch.testing.assert_close(found_by_jet, expected)
    torch.testing.assert_close(found_by_tangent, expected)


def test_inference_in_blocks_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    made = network(3).double()
    x, v = cube(1000), cube(1000)

    def evaluated(made: ColorSiren, x: Tensor) -> list[Tensor]:
        return [made.value(x), *made.jet(x), *made.derivative_along(x, v)]

    off, expected = rounding(made, x, evaluated), evaluated(made, x)
    monkeypatch.setattr("mplicits.neural_fields.networks.siren.BLOCK_FLOATS", 16 * 256)
    with torch.inference_mode():
        assert_within(evaluated(made, x), expected, off, times=2)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (7,), (2, 3), (3, 0, 2)])
def test_shapes_and_types_follow_the_input(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
    field = texture().to(device=device, dtype=dtype)
    x = cube(*shape, dtype=dtype).to(device)
    for mode in (torch.enable_grad, torch.inference_mode):
        with mode():
            jet = field.jet(x)
            for color in (field.value(x), field.colors(x), jet.value):
                assert (color.shape, color.dtype, color.device.type) == ((*shape, 3), dtype, device.type)
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
    assert raw[inside].min() < 0 < 1 < raw[inside].max()
    torch.testing.assert_close(value[inside], raw[inside].clamp(0, 1))
    outside = field.outside.expand(int((~inside).sum()), 3)
    assert torch.equal(value[~inside], outside)
    assert torch.equal(outside[0], torch.tensor([0.1, 0.2, 0.3]).double())
    torch.testing.assert_close(field.colors(x), raw.clamp(0, 1))


def test_derivatives_of_the_clamped_and_gated_colors_agree_with_autograd() -> None:
    field = texture().double()
    x = cube(500).requires_grad_()
    expected = autograd_jacobian(field.value(x), x)
    assert (expected[~field.in_band(x)] == 0).all()
    torch.testing.assert_close(field.jet(x).gradient, expected)


def test_the_geometry_is_evaluated_once_and_the_network_only_in_the_band(monkeypatch: pytest.MonkeyPatch) -> None:
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
    jet = field.jet(cube(200, dtype=torch.float32))
    (jet.value.square().sum() + jet.gradient.square().sum()).backward()
    assert all(parameter.grad is None for parameter in geometry.parameters())
    assert all(parameter.grad is not None for parameter in field.network.parameters())


def test_encoding_is_octaves_of_sines_and_cosines() -> None:
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    expected = torch.cat((x, x.sin(), (2 * x).sin(), x.cos(), (2 * x).cos()), dim=1)
    torch.testing.assert_close(encode(x, 2), expected)
    assert expected.shape[1] == encoded_size(2, 2)
    torch.testing.assert_close(encode(x, 0), x)


def test_colors_are_between_0_and_1_for_any_leading_shape() -> None:
    color = ColorNetwork(0, width=16, depth=2)
    x = torch.randn(4, 5, 3)
    seen = color(x, torch.nn.functional.normalize(x, dim=-1), Sphere().jet(x))
    assert seen.shape == (4, 5, 3)
    assert bool(((seen > 0) & (seen < 1)).all())


def test_colour_depends_on_the_direction_and_on_the_normal_but_not_on_the_gradients_length() -> None:
    color = ColorNetwork(0, width=32, depth=2).double()
    x = torch.randn(6, 3, dtype=torch.float64)
    along = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64), dim=-1)
    jet = Sphere(radius=0.5).double().jet(x)
    seen = color(x, along, jet)
    torch.testing.assert_close(color(x, along, jet._replace(gradient=3 * jet.gradient)), seen)
    assert float((color(x, -along, jet) - seen).detach().abs().min(dim=1).values.max()) > 1e-6
    assert float((color(x, along, jet._replace(gradient=-jet.gradient)) - seen).detach().abs().max()) > 1e-6


def test_a_grid_is_trained_where_it_is_looked_up_and_moves_with_the_colours(device: torch.device) -> None:
    color = ColorNetwork(0, width=16, depth=1, grid=HashEncoding(levels=2, coarsest=8, finest=16)).to(device)
    x = torch.full((1, 3), 0.1, device=device)
    color(x, x, Sphere().to(device).jet(x)).sum().backward()
    assert int((color.grid.table.grad != 0).any(dim=1).sum()) == 2 * 8  # the corners of a cell of each level


def test_background_field_returns_density_and_colour() -> None:
    density, color = BackgroundField(width=16, depth=2)(torch.randn(7, 4), torch.randn(7, 3))
    assert density.shape == (7,)
    assert color.shape == (7, 3)
    assert bool((density > 0).all())


def test_background_field_evaluates_its_grid_at_contracted_points() -> None:
    outside = BackgroundField(width=8, depth=1, grid=HashEncoding(levels=1, coarsest=4, finest=4, extent=2.0))
    far = torch.tensor([[0.0, 0.0, 1.0, 0.0]])  # infinitely far along z: the pole of the ball of radius 2
    density, color = outside(far, far[:, :3])
    (density.sum() + color.sum()).backward()
    touched = outside.grid.table.grad.any(dim=1).nonzero()[:, 0].tolist()
    assert touched == [(2 * 5 + 2) * 5 + 4]  # the vertex at (0, 0, 2) of 5³
