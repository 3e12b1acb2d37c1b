"""Instant-NGP's hash grid and BANF: what their papers say of the fields, and what their recipes reach."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from mplicits.datasets import prepare_cloud, sample_sphere
from mplicits.neural_fields import Field, Plane, Sphere, Torus, extract_mesh, sphere_trace
from mplicits.neural_fields.networks.grids import spatial_hash
from scipy.interpolate import RegularGridInterpolator
from torch import Tensor

from benchmarks.paper.recipe import SignedPools, differences, stencil
from benchmarks.peers import BandLimited, BanfSDF, HashGridSDF


def reads_its_table(*, table_size: int, resolution: int) -> HashGridSDF:
    """One grid with one number per entry, and a network that hands it on: relu(t) − relu(−t)."""
    sizes = {"levels": 1, "features": 1, "coarsest": resolution, "finest": resolution, "width": 2, "depth": 1}
    field = HashGridSDF(**sizes, table_size=table_size, extent=1.0).double().requires_grad_(False)
    field.tables[0].uniform_(-1, 1)
    hidden, last = field.linear()
    hidden.weight.copy_(torch.tensor([[1.0], [-1.0]]))
    last.weight.copy_(torch.tensor([[1.0, -1.0]]))
    hidden.bias.zero_()
    last.bias.zero_()
    return field


def lattice(resolution: int) -> Tensor:
    """Vertices ``(R + 1, R + 1, R + 1, 3)`` over [-1, 1]³."""
    line = torch.linspace(-1, 1, resolution + 1, dtype=torch.float64)
    return torch.stack(torch.meshgrid(line, line, line, indexing="ij"), dim=-1)


def test_dense_grid_reproduces_a_linear_function_and_its_gradient() -> None:
    field = reads_its_table(table_size=128, resolution=4)
    slope = torch.tensor([0.3, -0.7, 0.5], dtype=torch.float64)
    field.tables[0].copy_((lattice(4).reshape(-1, 3) @ slope + 0.2)[:, None])
    x = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
    jet = field.jet(x)
    torch.testing.assert_close(jet.value, x @ slope + 0.2)
    torch.testing.assert_close(jet.gradient, slope.expand(500, 3))


def test_hashed_vertices_show_their_entries() -> None:
    """Small tables cannot hold a grid: then the value at a vertex is the entry that the hash says."""
    field = reads_its_table(table_size=64, resolution=10)
    index = torch.randint(0, 11, (200, 3))
    value = field.value(index.double() / 5 - 1)
    torch.testing.assert_close(value, field.tables[0][spatial_hash(*index.unbind(dim=1), 64), 0])


def test_outside_the_cube_the_nearest_point_counts() -> None:
    for field in (reads_its_table(table_size=128, resolution=4), BandLimited(Torus().double(), 4, extent=1.0)):
        x = torch.tensor([[1.5, 0.3, -0.2], [-4.0, 2.0, 0.1]], dtype=torch.float64)
        outside, inside = field.jet(x), field.jet(x.clamp(-1, 1))
        torch.testing.assert_close(outside.value, inside.value)
        torch.testing.assert_close(outside.gradient, torch.where(x.abs() > 1, 0.0, inside.gradient))


def test_hash_grid_may_begin_as_a_sphere() -> None:
    field = HashGridSDF(levels=2, finest=32, radius=0.5).requires_grad_(False)
    for parameter in field.parameters():
        parameter.zero_()
    x = torch.randn(100, 3)
    jet, exact = field.jet(x), Sphere(radius=0.5).jet(x)
    torch.testing.assert_close(jet.value, exact.value)
    torch.testing.assert_close(jet.gradient, exact.gradient)
    assert bool(field.jet(torch.zeros(1, 3)).gradient.isfinite().all())


@pytest.mark.parametrize("make", [lambda net: net, lambda net: BandLimited(net, 8)], ids=["hash-grid", "banf"])
def test_gradients_train_tables_and_networks(make: Callable[[HashGridSDF], Field]) -> None:
    network = HashGridSDF(levels=2, coarsest=4, finest=8, table_size=256, width=8)
    (make(network).jet(2 * torch.rand(300, 3) - 1).gradient.norm(dim=1) - 1).square().mean().backward()
    trained = [*network.tables, *(layer.weight for layer in network.linear())]
    assert all(bool(parameter.grad.isfinite().all()) and bool((parameter.grad != 0).any()) for parameter in trained)


def test_band_limited_level_is_its_grids_interpolant() -> None:
    torus = Torus().double()
    points = lattice(6)
    axis = points[:, 0, 0, 0].numpy()
    interpolant = RegularGridInterpolator((axis, axis, axis), torus.value(points).numpy())
    x = 2 * torch.rand(400, 3, dtype=torch.float64) - 1
    level = BandLimited(torus, 6, extent=1.0)
    np.testing.assert_allclose(level.value(x).numpy(), interpolant(x.numpy()), atol=1e-14)
    torch.testing.assert_close(level.value(points), torus.value(points), atol=1e-14, rtol=0)


def test_band_limiting_leaves_a_plane_as_it_is() -> None:
    plane = Plane(normal=(1.0, 2.0, 2.0), offset=0.1).double()
    x = 2 * torch.rand(300, 3, dtype=torch.float64) - 1
    jet, exact = BandLimited(plane, 5).jet(x), plane.jet(x)
    torch.testing.assert_close(jet.value, exact.value)
    torch.testing.assert_close(jet.gradient, exact.gradient)


def test_cascade_adds_up() -> None:
    sphere, torus = Sphere(), Torus()
    cascade = BanfSDF([sphere, torus], [4, 16])
    x = 2 * torch.rand(200, 3) - 1
    torch.testing.assert_close(cascade.value(x, level=0), BandLimited(sphere, 4).value(x))
    torch.testing.assert_close(cascade.value(x) - cascade.value(x, level=0), BandLimited(torus, 16).value(x))
    assert cascade.deltas.tolist() == [math.inf]


@pytest.mark.parametrize(("level", "radius"), [(0, 0.4), (1, 0.7)])
def test_cascade_is_meshed_and_traced_at_every_level(level: int, radius: float) -> None:
    """The second level moves the surface by far more than a cell: no consumer may trust the first one."""
    shrunk = HashGridSDF(levels=1, coarsest=2, finest=2, width=1).requires_grad_(False)
    for parameter in shrunk.parameters():
        parameter.zero_()
    shrunk.linear()[-1].bias.fill_(-0.3)
    cascade = BanfSDF([Sphere(radius=0.4), shrunk], [64, 2])
    lengths = torch.from_numpy(extract_mesh(cascade, resolution=32, level=level).vertices).norm(dim=1)
    torch.testing.assert_close(lengths, torch.full_like(lengths, radius), atol=1e-3, rtol=0)
    hits = sphere_trace(cascade, torch.tensor([0.0, 0.0, -2.0]), torch.tensor([0.0, 0.0, 1.0]), level=level)
    assert bool(hits.mask)
    assert float(hits.depth) == pytest.approx(2 - radius, abs=1e-3)


@pytest.mark.parametrize(
    "options", [{"levels": 0}, {"table_size": 100}, {"coarsest": 32, "finest": 16}, {"extent": 0.0}, {"width": 0}]
)
def test_impossible_grids_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        HashGridSDF(**options)


def test_differences_of_a_quadratic_are_exact() -> None:
    x = torch.randn(50, 3, dtype=torch.float64)

    def f(p: Tensor) -> Tensor:
        return p[..., 0] ** 2 + 3 * p[..., 1] ** 2 - p[..., 0] * p[..., 2] + 2 * p[..., 2]

    gradient, laplacian = differences(f(stencil(x, 0.1)), 0.1)
    a, b, c = x.unbind(dim=1)
    torch.testing.assert_close(gradient, torch.stack((2 * a - c, 6 * b, 2 - a), dim=1))
    torch.testing.assert_close(laplacian, torch.full_like(a, 8.0))


def test_pools_hold_signed_distances_of_a_sphere() -> None:
    cloud = prepare_cloud(sample_sphere(4000, radius=3.0))
    pools = SignedPools(cloud, near=3000, uniform=1000, spread=0.02, seed=0, device="cpu")
    points, distance = pools.draw(800, (4, 3, 1))
    assert points.shape == (800, 3)
    assert int((distance == 0).sum()) == 400
    assert float(points.abs().max()) <= 1.05
    exact = points.norm(dim=1) - 1
    assert float((distance - exact).abs().mean()) < 1e-3
    assert bool((distance[exact.abs() > 0.05].sign() == exact[exact.abs() > 0.05].sign()).all())
