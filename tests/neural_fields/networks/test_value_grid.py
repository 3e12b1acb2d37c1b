"""Values kept on a grid: what they interpolate exactly, how far off they may be, and what is brought up to date."""

import torch
from mplicits.neural_fields import Sphere
from mplicits.neural_fields.fields.field import as_field
from mplicits.neural_fields.networks.grids import ValueGrid
from torch import Tensor


def some_points(count: int = 500) -> Tensor:
    """In the unit ball."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    lengths = torch.rand(count, 1, generator=generator) ** (1 / 3)
    return lengths * torch.nn.functional.normalize(points, dim=1)


def test_what_is_linear_in_each_coordinate_is_kept_exactly() -> None:
    def product(x: Tensor) -> Tensor:
        return (1 + x[..., 0]) * (2 - x[..., 1]) * (0.5 + 3 * x[..., 2])

    grid, points = ValueGrid(7), some_points()
    grid.refresh(as_field(product))
    torch.testing.assert_close(grid(points), product(points), atol=1e-5, rtol=1e-5)
    assert grid(points.reshape(5, 100, 3)).shape == (5, 100)


def test_curved_fields_are_off_by_the_bound_at_most() -> None:
    grid, points = ValueGrid(10), some_points()
    grid.refresh(as_field(lambda x: x.square().sum(dim=-1)))
    # The second derivative along the axes is K = 2, the edge h = 0.2: h²/8 K along each of them.
    error = grid(points) - points.square().sum(dim=-1)
    assert float(error.min()) > -1e-6  # chords of a convex function lie above it
    assert 0.5 * 3 / 8 * 2 * 0.04 < float(error.max()) <= 3 / 8 * 2 * 0.04 + 1e-6


def test_points_outside_the_cube_count_as_its_nearest() -> None:
    grid = ValueGrid(2)
    grid.kept.copy_(torch.linspace(-1, 1, 3)[:, None, None].expand(3, 3, 3))
    assert grid(torch.tensor([[5.0, 0.3, -9.0], [-2.0, 0.0, 0.0], [1.0, 1.0, 1.0]])).tolist() == [1.0, -1.0, 1.0]


def test_the_near_part_is_that_around_the_kept_surface() -> None:
    grid = ValueGrid(16, reach=0.2)
    for whole in (False, True):
        grid.refresh(Sphere(radius=0.5), whole=whole)
        assert grid.moved.isinf()  # nothing was known of a surface
    before = grid.kept.clone()
    grid.refresh(Sphere(radius=0.6), whole=False)
    torch.testing.assert_close(grid.moved, torch.tensor(0.1), atol=1e-6, rtol=0)
    near = before.abs() <= 0.2
    assert 0.02 < float(near.float().mean()) < 0.5
    torch.testing.assert_close(grid.kept[near], before[near] - 0.1, atol=1e-6, rtol=0)
    assert torch.equal(grid.kept[~near], before[~near])
    grid.refresh(Sphere(radius=0.6))
    assert float(grid.moved) == 0.0  # what was far off, and out of date, does not count
