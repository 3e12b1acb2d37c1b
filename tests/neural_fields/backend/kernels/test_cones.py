"""Cones by one launch for each size of tiles, against PyTorch's."""

import os
from collections.abc import Callable
from typing import Any
from unittest import mock

import mplicits.neural_fields.backend.kernels.cones as fused
import pytest
import torch
from fields import solve_sphere
from mplicits.neural_fields import MultiscaleSDF, Siren, sphere_trace
from mplicits.neural_fields.tracing.cones import cone_starts
from torch import Tensor
from torch.nn.functional import normalize


@pytest.fixture
def counted(watch: Callable[..., list[int]]) -> list[int]:
    return watch(fused, "march_cones", lambda network, cones, *_: len(cones[1]))


def picture(place: torch.device, size: int = 16) -> tuple[Tensor, Tensor]:
    """Rays of a pinhole; those at the edge miss the ball."""
    across = torch.linspace(-0.6, 0.6, size)
    rows, columns = torch.meshgrid(across, across, indexing="ij")
    directions = normalize(torch.stack((columns, rows, torch.ones_like(rows)), dim=-1), dim=-1)
    return torch.tensor([0.1, 0.0, -2.2]).to(place), directions.to(place)


def test_cones_end_where_pytorchs_do(place: torch.device, counted: list[int]) -> None:
    """Those of a field with a band keep out of it, and of the surface of the level behind it."""
    base = Siren(16, 2, omega=8.0)
    solve_sphere(base, radius=0.5)
    field = MultiscaleSDF(base, [Siren(8, 1, output_gain=0.01)], [0.05]).to(place).requires_grad_(False)
    origin, directions = picture(place)
    options: Any = {"tiles": (8, 2), "lipschitz": 1.3}
    ours = cone_starts(field, origin, directions, **options)
    assert counted == [4, 64]
    with mock.patch.dict(os.environ, MPLICITS_KERNELS="off"):
        theirs = cone_starts(field, origin, directions, **options)
        hits = sphere_trace(field, origin, directions, lipschitz=1.3)
    assert len(counted) == 2
    # Rounding may make a cone stop one step sooner or later, which is as good.
    assert float(ours.isclose(theirs, rtol=0, atol=1e-4).float().mean()) > 0.95
    assert 0 < int(ours.isinf().sum()) < ours.numel()
    assert bool((ours <= hits.depth)[hits.mask].all())
    assert not bool(hits.mask[ours.isinf()].any())


def test_cones_stop_after_so_many_steps(place: torch.device, counted: list[int]) -> None:
    base = Siren(16, 1, omega=8.0)
    solve_sphere(base, radius=0.5)
    base.to(place).requires_grad_(False)
    origin, directions = picture(place)
    once, often = (cone_starts(base, origin, directions, tiles=(8,), max_steps=n) for n in (1, 64))
    assert counted == [4, 4]
    assert bool((once <= often).all())
    assert not torch.equal(once, often)
