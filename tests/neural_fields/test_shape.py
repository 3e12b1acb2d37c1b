"""A field in input coordinates: exact answers for a ball of radius 10 around a map coordinate."""

import numpy as np
import pytest
import torch
from fields import small_multiscale
from mplicits.neural_fields import MultiscaleSDF, Similarity, Siren, Sphere, WorldField

CENTER = np.array([500_000.25, 4_100_000.5, 120.0])
SCALE, RADIUS = 20.0, 10.0
BALL = WorldField(Sphere(radius=RADIUS / SCALE), Similarity(tuple(CENTER), SCALE))
# Fields answer in float32: half a unit in the last place of each of a handful of operations on numbers up to 2 units.
ROUNDING = 16 * 2.0**-24 * 2 * SCALE


def test_arrays_far_from_the_origin_keep_their_digits() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(40, 3))
    offsets = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(4, 16, (40, 1))
    lengths = np.linalg.norm(offsets, axis=1)
    found = BALL.distance(CENTER + offsets)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, lengths - RADIUS, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(BALL.normals(CENTER + offsets), offsets / lengths[:, None], rtol=0, atol=1e-6)
    position, normal, reached = BALL.closest(CENTER + offsets)
    assert reached.all()
    np.testing.assert_allclose(position - CENTER, RADIUS * offsets / lengths[:, None], rtol=0, atol=2 * ROUNDING)
    np.testing.assert_allclose(normal, offsets / lengths[:, None], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", [(3,), (0, 3), (1, 3), (2, 5, 3)])
@pytest.mark.parametrize("kind", ["float32", "float64", "int64", "numpy"])
def test_shapes_and_kinds_come_back(shape: tuple[int, ...], kind: str) -> None:
    world = WorldField(small_multiscale())
    points = np.zeros(shape) if kind == "numpy" else torch.zeros(shape, dtype=getattr(torch, kind))
    distance, normals, closest = world.distance(points), world.normals(points), world.closest(points)
    assert type(distance) is type(points)
    assert distance.shape == shape[:-1]
    assert normals.shape == closest.position.shape == closest.normal.shape == shape
    assert closest.reached.shape == shape[:-1]
    assert distance.dtype == normals.dtype == (torch.float32 if kind == "int64" else points.dtype)
    hits = world.trace(points, points + 1)
    assert hits.mask.shape == hits.depth.shape == shape[:-1]
    assert hits.position.shape == hits.normal.shape == shape


def test_levels_are_those_of_the_field() -> None:
    field = small_multiscale().double().requires_grad_(False)
    world, x = WorldField(field), torch.rand(50, 3, dtype=torch.float64)
    for level in range(3):
        torch.testing.assert_close(world.distance(x, level=level), field.value(x, level=level), rtol=0, atol=0)


def test_tensors_carry_their_graph() -> None:
    points = torch.tensor(np.add(CENTER, (0.0, 0.0, 13.0)), requires_grad=True)
    (gradient,) = torch.autograd.grad(BALL.distance(points), points)
    hits = BALL.trace(points, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), differentiable=True)
    (slope,) = torch.autograd.grad(hits.depth, points)
    torch.testing.assert_close((gradient, slope), (torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),) * 2)
    siren = Siren(8, 1)
    WorldField(siren).distance(torch.rand(4, 3)).sum().backward()
    assert siren.output.weight.grad.any()


def test_rays_in_input_units_with_directions_of_any_length() -> None:
    origins = CENTER + np.array([[0.0, 0.0, -30.0], [0.0, 11.0, -30.0]])
    hits = BALL.trace(origins, np.array([0.0, 0.0, 2.0]))
    assert hits.mask.tolist() == [True, False]
    np.testing.assert_allclose(hits.depth, [10.0, np.inf], atol=ROUNDING)
    np.testing.assert_allclose(hits.position[0] - CENTER, [0, 0, -RADIUS], atol=2 * ROUNDING)
    np.testing.assert_allclose(hits.normal[0], [0, 0, -1], atol=1e-6)
    assert np.isnan(hits.position[1]).all()
    assert np.isnan(hits.normal[1]).all()


@pytest.mark.parametrize("bounds", [None, (CENTER - 12, CENTER + 12)])
def test_meshes_lie_where_the_input_was(bounds: tuple[np.ndarray, np.ndarray] | None) -> None:
    mesh = BALL.mesh(48, bounds=bounds)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTER, axis=1), RADIUS, atol=1e-3)
    assert mesh.normals is not None


def test_a_repr_has_the_place_and_the_field() -> None:
    assert "center=(500000.25, 4100000.5, 120), scale=20, field=Sphere(radius=0.5" in repr(BALL)
    assert "taper=0.3" in repr(WorldField(MultiscaleSDF(Sphere(), [], [], taper=0.3)))
