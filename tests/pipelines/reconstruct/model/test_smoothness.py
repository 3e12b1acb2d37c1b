"""What costs is that curvature changes: not planes, spheres and cylinders, nor where photographs show something."""

import math

import numpy as np
import pytest
import torch
from mplicits.neural_fields import Box, Capsule, Field, Siren, Sphere
from mplicits.neural_fields.fields.function import as_field
from mplicits.neural_fields.networks.sphere_init import fit_sphere
from mplicits.pipelines.reconstruct.model.smoothness import (
    ALIKE,
    CREASE,
    flatness,
    normal_variation,
    tangents,
    unevenness,
)
from torch import Tensor
from torch.nn.functional import normalize

EPSILON = torch.finfo(torch.float64).eps


def drawn(count: int) -> torch.Generator:
    return torch.Generator().manual_seed(count)


def on_sphere(count: int) -> tuple[Tensor, Tensor]:
    """Points of the sphere of radius 0.375 around (0.125, 0, 0), and their normals."""
    normals = normalize(torch.randn(count, 3, dtype=torch.float64, generator=drawn(count)), dim=1)
    return torch.tensor([0.125, 0.0, 0.0]) + 0.375 * normals, normals


def on_cylinder(count: int) -> tuple[Tensor, Tensor]:
    """Points of the side of the capsule of radius 0.2 along z, away from its ends."""
    angle, height = torch.rand(2, count, dtype=torch.float64, generator=drawn(count)) - 0.5
    normals = torch.stack((torch.cos(7 * angle), torch.sin(7 * angle), 0 * angle), dim=1)
    return 0.2 * normals + height[:, None] * torch.tensor([0.0, 0.0, 0.5]), normals


def on_plane(count: int) -> tuple[Tensor, Tensor]:
    """Points of a face of a cube of half width 0.5, away from its edges."""
    across = torch.rand(count, 2, dtype=torch.float64, generator=drawn(count)) - 0.5
    up = torch.full((count, 1), 0.5, dtype=torch.float64)
    normals = torch.zeros(count, 3, dtype=torch.float64)
    normals[:, 2] = 1
    return torch.cat((0.5 * across, up), dim=1), normals


@pytest.mark.parametrize(
    ("field", "surface"),
    [
        (Sphere(radius=0.375, center=(0.125, 0.0, 0.0)), on_sphere),
        (Capsule(start=(0.0, 0.0, -0.5), end=(0.0, 0.0, 0.5), radius=0.2), on_cylinder),
        (Box(half_size=(0.5, 0.5, 0.5)), on_plane),
    ],
    ids=["sphere", "cylinder", "plane"],
)
def test_even_curvature_costs_nothing(field: Field, surface: object) -> None:
    points, normals = surface(200)  # type: ignore[operator]
    found = normal_variation(field.double(), points, tangents(normals), step=0.03)
    # Three unit normals are added, each of which is rounded a few times; and that is squared.
    assert found.max() < (30 * EPSILON) ** 2


def test_a_wave_costs_what_its_normals_say() -> None:
    height, frequency, step = 0.01, 20.0, 0.03

    def wave(x: Tensor) -> Tensor:
        return x[..., 2] - height * torch.sin(frequency * x[..., 0])

    def normal(x: Tensor) -> Tensor:
        slope = -height * frequency * torch.cos(frequency * x)
        return normalize(torch.stack((slope, 0 * x, torch.ones_like(x)), dim=1), dim=1)

    x = torch.linspace(-1, 1, 50, dtype=torch.float64)
    points = torch.stack((x, 0 * x, height * torch.sin(frequency * x)), dim=1)
    along = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(50, 3)
    bent = normal(x - step) - 2 * normal(x) + normal(x + step)
    bent = bent - (bent * normal(x)).sum(dim=1, keepdim=True) * normal(x)
    found = normal_variation(as_field(wave), points, along, step=step)
    assert torch.allclose(found, bent.square().sum(dim=1), rtol=1e-9, atol=1e-15)
    # Of the order of (h² d²n / dx²)², whose largest value is (h² a k³)².
    assert found.max() > 0.2 * (step**2 * height * frequency**3) ** 2


def test_a_crease_costs_a_bounded_amount() -> None:
    cube = Box(half_size=(0.5, 0.5, 0.5)).double()
    edge = torch.tensor([[0.5, 0.1, 0.5], [0.495, 0.1, 0.5], [0.1, 0.1, 0.5]], dtype=torch.float64)
    across = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(3, 3)
    varied, cost = normal_variation(cube, edge, across), unevenness(cube, edge, across)
    assert varied[1] > 0.4
    assert cost[2] == varied[2] == 0
    assert torch.allclose(cost, varied / (1 + varied / CREASE), rtol=1e-12)
    assert cost.max() < CREASE


def test_ripples_are_learnt_away() -> None:
    points, normals = on_sphere(100)
    torch.manual_seed(0)
    field = Siren(32, 2, omega=30.0).double()
    fit_sphere(field, 0.375, steps=20, batch=256)
    points, along = points - torch.tensor([0.125, 0.0, 0.0]), tangents(normals)
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-4)
    costs = []
    for _ in range(60):
        cost = unevenness(field, points, along).mean()
        optimizer.zero_grad()
        cost.backward()
        optimizer.step()
        costs.append(float(cost.detach()))
    assert costs[-1] < 0.5 * costs[0]


def test_tangents_are_unit_vectors_at_right_angles_in_all_directions() -> None:
    _, normals = on_sphere(100)
    found = tangents(normals.float())
    assert (found.norm(dim=1) - 1).abs().max() < 1e-6
    assert (found * normals.float()).sum(dim=1).abs().max() < 1e-6
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(96, 3)
    turned = torch.atan2(*tangents(up)[:, :2].unbind(dim=1)).sort().values
    # Golden angles leave gaps of three sizes at most, the largest of which is φ² times the smallest.
    assert turned.diff().max() < 2.7 * 2 * math.pi / 96


def test_edges_of_a_photograph_are_not_flat() -> None:
    color = np.full((5, 8, 3), 0.5, np.float32)
    color[:, 4:, 1] = 0.6
    flat = flatness(color)
    beside = math.exp(-0.1 / ALIKE)
    assert np.allclose(flat[:, [0, 1, 2, 5, 6, 7]], 1)
    assert np.allclose(flat[:, 3:5], beside, rtol=1e-5)


def test_the_rim_of_a_mask_is_an_edge() -> None:
    mask = np.zeros((5, 8), np.float32)
    mask[:, :4] = 1
    flat = flatness(np.ones((5, 8, 3), np.float32), mask)
    assert np.allclose(flat[:, [0, 1, 2, 5, 6, 7]], 1)
    assert (flat[:, 3:5] < 1e-6).all()
