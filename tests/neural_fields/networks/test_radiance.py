"""Colour by direction, and the encodings."""

import torch
from mplicits.neural_fields import Sphere, ViewColor
from mplicits.neural_fields.networks.colors import Outside, encode, encoded_size
from mplicits.neural_fields.networks.grids import HashEncoding


def test_encoding_is_octaves_of_sines_and_cosines() -> None:
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    expected = torch.cat((x, x.sin(), (2 * x).sin(), x.cos(), (2 * x).cos()), dim=1)
    torch.testing.assert_close(encode(x, 2), expected)
    assert expected.shape[1] == encoded_size(2, 2)
    torch.testing.assert_close(encode(x, 0), x)


def test_colors_are_between_0_and_1_for_any_leading_shape() -> None:
    color = ViewColor(0, width=16, depth=2)
    x = torch.randn(4, 5, 3)
    seen = color(x, torch.nn.functional.normalize(x, dim=-1), Sphere().jet(x))
    assert seen.shape == (4, 5, 3)
    assert bool(((seen > 0) & (seen < 1)).all())


def test_colour_depends_on_the_direction_and_on_the_normal_but_not_on_the_gradients_length() -> None:
    color = ViewColor(0, width=32, depth=2).double()
    x = torch.randn(6, 3, dtype=torch.float64)
    along = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64), dim=-1)
    jet = Sphere(radius=0.5).double().jet(x)
    seen = color(x, along, jet)
    torch.testing.assert_close(color(x, along, jet._replace(gradient=3 * jet.gradient)), seen)
    assert float((color(x, -along, jet) - seen).detach().abs().min(dim=1).values.max()) > 1e-6
    assert float((color(x, along, jet._replace(gradient=-jet.gradient)) - seen).detach().abs().max()) > 1e-6


def test_a_grid_is_trained_where_it_is_looked_up_and_moves_with_the_colours(device: torch.device) -> None:
    color = ViewColor(0, width=16, depth=1, grid=HashEncoding(levels=2, coarsest=8, finest=16)).to(device)
    assert color.grid is not None
    x = torch.full((1, 3), 0.1, device=device)
    color(x, x, Sphere().to(device).jet(x)).sum().backward()
    assert color.grid.table.grad is not None
    assert int((color.grid.table.grad != 0).any(dim=1).sum()) == 2 * 8  # the corners of a cell of each level


def test_outside_gives_density_and_colour() -> None:
    density, seen = Outside(width=16, depth=2)(torch.randn(7, 4), torch.randn(7, 3))
    assert density.shape == (7,)
    assert seen.shape == (7, 3)
    assert bool((density > 0).all())


def test_outside_looks_its_grid_up_where_space_is_contracted_to() -> None:
    outside = Outside(width=8, depth=1, grid=HashEncoding(levels=1, coarsest=4, finest=4, extent=2.0))
    assert outside.grid is not None
    far = torch.tensor([[0.0, 0.0, 1.0, 0.0]])  # infinitely far along z: the pole of the ball of radius 2
    density, seen = outside(far, far[:, :3])
    (density.sum() + seen.sum()).backward()
    assert outside.grid.table.grad is not None
    touched = outside.grid.table.grad.any(dim=1).nonzero()[:, 0].tolist()
    assert touched == [(2 * 5 + 2) * 5 + 4]  # the vertex at (0, 0, 2) of 5³
