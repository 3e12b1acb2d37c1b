import pytest
import torch
from fields import FIELDS, Scaled, sphere_depth
from mplicits.neural_fields import Sphere, sphere_trace
from mplicits.neural_fields.tracing.cones import cone_starts
from torch.nn.functional import normalize


def pinhole(reach, size):
    across = torch.linspace(-reach, reach, size, dtype=torch.float64)
    rows, columns = torch.meshgrid(across, across, indexing="ij")
    return normalize(torch.stack((columns, rows, torch.ones_like(rows)), dim=-1), dim=-1)


def test_cones_that_find_themselves_behind_the_surface_go_back():
    directions = pinhole(0.1, 64)
    origin = torch.tensor([0.0, 0.0, -2.5], dtype=torch.float64)
    near = cone_starts(Scaled(Sphere(radius=0.6), 1.3).double(), origin, directions)
    expected = sphere_depth(origin, directions, 0.6)
    assert bool(expected.isfinite().all())
    assert bool((near < expected).all())


@pytest.mark.parametrize("level", [0, -1])
@pytest.mark.parametrize("name", ["sphere", "torus", "box", "multiscale-over-sphere"])
def test_cones_stop_before_the_surface(name, level):
    field = FIELDS[name]().double().requires_grad_(False)
    origin = torch.tensor([0.4, 0.3, -3.0], dtype=torch.float64)
    directions = pinhole(0.4, 75)[:60]
    near = cone_starts(field, origin, directions, level=level, lipschitz=1.3)
    hits = sphere_trace(field, origin, directions, level=level, lipschitz=1.3)
    assert near.shape == (60, 75)
    assert bool((near <= hits.depth)[hits.mask].all())
    assert not bool(hits.mask[near.isinf()].any())
    assert bool(near.isinf().any())
    assert float((hits.depth - near)[hits.mask].median()) < 0.35
    again = sphere_trace(field, origin, directions, level=level, near=near, lipschitz=1.3)
    assert torch.equal(again.mask, hits.mask)
    assert float((again.depth - hits.depth)[hits.mask].abs().max()) < 2e-5
    assert int(again.steps.sum()) < int(hits.steps.sum())
