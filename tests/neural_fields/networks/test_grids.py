import torch
from fields import cube
from mplicits.neural_fields import Sphere
from mplicits.neural_fields.fields.field import as_field
from mplicits.neural_fields.networks.grids import HashEncoding, ValueGrid, grid_resolutions, spatial_hash, split_tables
from torch import Tensor


def small(**options: int) -> HashEncoding:
    """A level that has its own entries and two that share theirs, all of them of unit size, in float64."""
    encoding = HashEncoding(**{"levels": 3, "table_size": 512, "coarsest": 4, "finest": 16} | options).double()
    torch.nn.init.uniform_(encoding.table, -1, 1)
    return encoding


def test_resolutions_grow_geometrically() -> None:
    assert grid_resolutions(16, 16, 2048)[:4] == [16, 22, 30, 42]
    assert grid_resolutions(16, 16, 2048)[-1] == 2048
    assert grid_resolutions(8, 16, 2048) == [16, 32, 64, 128, 256, 512, 1024, 2048]
    assert grid_resolutions(1, 7, 7) == [7]


def test_hash_is_the_published_one() -> None:
    """On the low 19 bits: π₂ = 0x9E3779B1 and π₃ = 0x30025795."""
    x, y, z = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1234, 777, 2048]]).unbind(dim=1)
    last = (1234 ^ (777 * 0x9E3779B1 % 2**32) ^ (2048 * 0x30025795 % 2**32)) % 2**19
    assert spatial_hash(x, y, z, 1 << 19).tolist() == [1, 0x779B1, 0x25795, 0x779B1 ^ 0x25795 ^ 1, last]


def test_linear_functions_are_reproduced() -> None:
    encoding = HashEncoding(levels=2, table_size=128, features=2, coarsest=2, finest=4, extent=1.5).double()
    slopes, x = torch.tensor([[0.3, -0.7, 0.5], [1.0, 0.2, -0.1]], dtype=torch.float64), 1.5 * cube(200)
    lines = [torch.linspace(-1.5, 1.5, cells + 1, dtype=torch.float64) for cells in (2, 4)]
    lattices = [torch.cartesian_prod(line, line, line) for line in lines]
    with torch.no_grad():
        encoding.table.copy_(torch.cat(lattices) @ slopes.T)
    torch.testing.assert_close(encoding(x), (x @ slopes.T).repeat(1, 2))


def test_both_derivatives_are_those_of_finite_differences() -> None:
    encoding, x = small(), cube(6).requires_grad_()
    table = encoding.table.detach().clone().requires_grad_()

    def features(entries: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(encoding, {"table": entries}, (at,))

    assert torch.autograd.gradcheck(features, (table, x))
    assert torch.autograd.gradgradcheck(lambda at: features(table.detach(), at).square(), x)


def test_outside_the_cube_the_nearest_point_counts() -> None:
    encoding, x = small(), torch.tensor([[1.5, 0.3, -0.2], [-4.0, 2.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(encoding(x), encoding(x.clamp(-1, 1)))


def test_any_leading_shape_and_any_device(device: torch.device) -> None:
    encoding, x = small().float(), cube(24).float()
    expected = encoding(x)
    moved = encoding.to(device)
    found = moved(x.reshape(2, 3, 4, 3).to(device))
    assert found.shape == (2, 3, 4, encoding.size)
    torch.testing.assert_close(found.reshape(24, -1).cpu(), expected)
    assert moved(x[:0].to(device)).shape == (0, encoding.size)


def test_under_autocast_features_are_those_of_full_precision() -> None:
    encoding, x = small().float(), cube(24).float()
    expected = encoding(x)
    (slope,) = torch.autograd.grad(expected.square().sum(), encoding.table)
    with torch.autocast("cpu", torch.bfloat16):
        found, of_half = encoding(x), encoding(x.bfloat16())
    assert torch.equal(found, expected)
    assert of_half.dtype == torch.float32
    assert torch.equal(torch.autograd.grad(found.square().sum(), encoding.table)[0], slope)


def test_tables_are_told_from_all_other_parameters() -> None:
    encodings = [HashEncoding.up_to(finest) for finest in (8, 32)]
    assert [(encoding.resolutions[0], encoding.resolutions[-1]) for encoding in encodings] == [(8, 8), (16, 32)]
    readers = [torch.nn.Sequential(encoding, torch.nn.Linear(encoding.size, 3)) for encoding in encodings]
    tables, others = split_tables(*readers)
    assert all(found is encoding.table for found, encoding in zip(tables, encodings, strict=True))
    assert [tuple(parameter.shape) for parameter in others] == 2 * [(3, encodings[0].size), (3,)]


def some_points(count: int = 500) -> Tensor:
    """In the unit ball; the grid has no values outside it."""
    points = torch.nn.functional.normalize(torch.randn(count, 3), dim=1)
    return torch.rand(count, 1) ** (1 / 3) * points


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
