"""Rays through one network, or through levels and their bands, in one launch, against the same rays by PyTorch."""

import os
from collections.abc import Callable
from typing import Any
from unittest import mock

import mplicits.neural_fields.backend.kernels.launch as launch
import mplicits.neural_fields.backend.kernels.paths as banded
import mplicits.neural_fields.backend.kernels.tracing as fused
import pytest
import torch
from fields import solve_sphere
from mplicits.neural_fields import MultiscaleSDF, Siren, sphere_trace
from mplicits.neural_fields.tracing.sphere import Hits
from torch import Tensor
from torch.nn.functional import normalize

TOLERANCE = 1e-4
# Depths end within the tolerance of a zero of either path's values, where the surface is not grazed: two of it apart.
STEEP = 0.3
# For few steps: each takes the interpreter a while.
COARSE = {"tolerance": 1e-3, "resolution": 1e-2}


@pytest.fixture
def counted(watch: Callable[..., list[int]]) -> list[int]:
    """How many rays were marched each time, by one network or by levels: the latter count as negative."""
    watch(fused, "march_rays", lambda asked: len(asked.rays.origins))
    return watch(banded, "march_levels", lambda asked: -len(asked.rays.origins))


def ball(place: torch.device, width: int = 16) -> Siren:
    """A SIREN that is nearly a ball of radius 0.5, with waves of its own."""
    network = Siren(width, 2, omega=8.0)
    solve_sphere(network, radius=0.5)
    return network.to(place).requires_grad_(False)


def waves(place: torch.device, taper: float = 0.0) -> MultiscaleSDF:
    """The ball with two residuals of other sizes, which move its surface by more than the tolerance."""
    residuals = [Siren(12, 1, omega=15.0, output_gain=0.03), Siren(17, 1, omega=25.0, output_gain=0.02)]
    return MultiscaleSDF(ball(place), residuals, [0.06, 0.04], taper=taper).to(place).requires_grad_(False)


def rays(count: int, place: torch.device, aim: float = 0.65) -> tuple[Tensor, Tensor]:
    """From all around towards the ball, most of them through it; through a cube of half-width ``aim``."""
    origins = 1.5 * normalize(torch.randn(count, 3), dim=-1)
    return origins.to(place), normalize(aim * (2 * torch.rand(count, 3) - 1) - origins, dim=-1).to(place)


def both(field: Any, origins: Tensor, directions: Tensor, **options: Any) -> Any:
    options = {"tolerance": TOLERANCE, "resolution": 1e-3} | options
    ours = sphere_trace(field, origins, directions, **options)
    with mock.patch.dict(os.environ, MPLICITS_KERNELS="off"):
        return ours, sphere_trace(field, origins, directions, **options)


def assert_same(ours: Hits, theirs: Hits, field: Any, directions: Tensor, tolerance: float = TOLERANCE) -> None:
    """The same rays meet it at the same depth, but for those that graze it."""
    slope = (field.jet(theirs.position).gradient * directions).sum(dim=-1).abs()
    value = field.value(theirs.position).abs()
    sure = torch.where(theirs.mask, slope > STEEP, value > 10 * tolerance)
    assert bool((ours.mask == theirs.mask)[sure].all())
    met = theirs.mask & sure
    assert float(sure.float().mean()) > 0.8
    assert float((ours.depth - theirs.depth).abs()[met].max()) <= 2 * tolerance
    assert float((ours.position - theirs.position).norm(dim=-1)[met].max()) <= 2 * tolerance
    assert bool((ours.level == theirs.level)[met].all())


def test_one_network_too_wide_for_registers(place: torch.device, counted: list[int]) -> None:
    field, (origins, directions) = ball(place), rays(20, place)
    with mock.patch.object(fused, "IN_REGISTERS", 8):
        ours, theirs = both(field, origins, directions, **COARSE)
    assert counted == [-20]
    assert_same(ours, theirs, field, directions, COARSE["tolerance"])


def test_rays_end_where_pytorchs_do(place: torch.device, counted: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """More rays than one program has places for, so that those of the first are taken by others."""
    monkeypatch.setattr(launch, "INTERPRETED_PROGRAMS", 1)
    field, (origins, directions) = ball(place), rays(90, place)
    ours, theirs = both(field, origins, directions)
    assert sum(counted) > 64  # places of a program
    assert 30 < int(theirs.mask.sum()) < 85
    assert_same(ours, theirs, field, directions)
    assert not ours.level.any()
    # The same rules take as many steps, but where rounding turns a decision.
    assert float((ours.steps == theirs.steps).float().mean()) > 0.9


@pytest.mark.slow
def test_rays_from_inside_and_behind(place: torch.device) -> None:
    """From the middle out; and a start behind the surface sends a ray back to its beginning."""
    field = ball(place)
    _, directions = rays(40, place)
    ours, theirs = both(field, torch.zeros_like(directions), directions)
    assert bool(ours.mask.all())
    assert_same(ours, theirs, field, directions)
    origins, directions = rays(40, place)
    ours, theirs = both(field, origins, directions, near=1.3)
    assert_same(ours, theirs, field, directions)
    assert float(ours.depth[ours.mask].min()) < 1.3


@pytest.mark.parametrize("count", [0, 1, 20])
def test_any_number_of_rays_and_levels_in_range(count: int, place: torch.device, counted: list[int]) -> None:
    field = MultiscaleSDF(ball(place), [Siren(8, 1).to(place).requires_grad_(False)], [0.02]).to(place)
    origins, directions = rays(count, place)
    ours, theirs = both(field, origins, directions, level=0, max_steps=20)
    assert ours.depth.shape == theirs.depth.shape == (count,)
    assert counted == [count] * (count > 0)
    if count > 1:
        assert_same(ours, theirs, field.base, directions)
    ours, theirs = both(field, origins, directions, max_steps=4, **COARSE)
    assert counted == [count, -count] * (count > 0)
    assert ours.depth.shape == (count,)
    assert float((ours.depth - theirs.depth).abs().sum()) <= 1e-4 * count


@pytest.mark.parametrize("taper", [pytest.param(0.0, marks=pytest.mark.slow), 0.5])
def test_rays_through_bands_end_where_pytorchs_do(taper: float, place: torch.device, counted: list[int]) -> None:
    """Some begin inside, and are traced to their exit; some start behind the surface, and go back."""
    field, (origins, directions) = waves(place, taper), rays(20, place, aim=0.3)
    origins[:4] *= 0.1
    near = torch.where(torch.arange(20, device=place) < 16, 0.0, 1.2)
    ours, theirs = both(field, origins, directions, near=near, max_steps=16, **COARSE)
    assert counted == [-20]
    assert int((ours.level == 2).sum()) > 15
    assert float(ours.depth[16:].min()) < 1.2
    assert_same(ours, theirs, field, directions, COARSE["tolerance"])
    coarse = sphere_trace(field, origins, directions, level=0, **COARSE)
    met = ours.mask & coarse.mask
    assert float((ours.depth - coarse.depth).abs()[met].max()) > 3 * COARSE["tolerance"]


def test_more_rays_than_a_tile_go_round_their_rings(place, counted, monkeypatch) -> None:
    """One program, whose rings are longer than a tile and no multiple of it; three steps take no ray far."""
    monkeypatch.setattr(launch, "INTERPRETED_PROGRAMS", 1)
    field, (origins, directions) = waves(place), rays(90, place)
    ours, theirs = both(field, origins, directions, max_steps=3, **COARSE)
    assert counted == [-90]
    assert torch.equal(ours.steps, theirs.steps)
    assert torch.equal(ours.mask, theirs.mask)
    assert float((ours.depth - theirs.depth).abs().max()) <= 1e-4
