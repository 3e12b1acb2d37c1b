"""Rays through one network in one launch, against the same rays by PyTorch."""

from collections.abc import Callable
from typing import Any

import mplicits.neural_fields.kernels.tracing as fused
import pytest
import torch
from mplicits.neural_fields import Hits, MultiscaleSDF, Siren, sphere_trace
from mplicits.neural_fields.sphere_start import solve_sphere
from torch import Tensor
from torch.nn.functional import normalize

TOLERANCE = 1e-4
# Depths end within the tolerance of a zero of either path's values, where the surface is not grazed.
APART = 2 * TOLERANCE
STEEP = 0.3


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rays were marched each time."""
    counts: list[int] = []
    original: Callable[..., Any] = fused.march_rays

    def call(network: Any, rays: Any, **options: Any) -> Any:
        counts.append(len(rays[0]))
        return original(network, rays, **options)

    monkeypatch.setattr(fused, "march_rays", call)
    return counts


def ball(place: torch.device, width: int = 16) -> Siren:
    """A SIREN that is nearly a ball of radius 0.5, with waves of its own."""
    network = Siren(width, 2, omega=8.0)
    solve_sphere(network, radius=0.5)
    return network.to(place).requires_grad_(False)


def rays(count: int, place: torch.device) -> tuple[Tensor, Tensor]:
    """From all around towards the ball, most of them through it."""
    origins = 1.5 * normalize(torch.randn(count, 3), dim=-1)
    return origins.to(place), normalize(1.3 * torch.rand(count, 3) - 0.65 - origins, dim=-1).to(place)


def both(field: Any, origins: Tensor, directions: Tensor, monkeypatch: pytest.MonkeyPatch, **options: Any) -> Any:
    """Hits by one launch, and by PyTorch."""
    options = {"tolerance": TOLERANCE, "resolution": 1e-3} | options
    ours = sphere_trace(field, origins, directions, **options)
    with monkeypatch.context() as patch:
        patch.setenv("MPLICITS_KERNELS", "off")
        return ours, sphere_trace(field, origins, directions, **options)


def assert_same(ours: Hits, theirs: Hits, field: Any, directions: Tensor) -> None:
    """The same rays meet it at the same depth, but for those that graze it."""
    slope = (field.jet(theirs.position).gradient * directions).sum(dim=-1).abs()
    value = field.value(theirs.position).abs()
    sure = torch.where(theirs.mask, slope > STEEP, value > 10 * TOLERANCE)
    assert bool((ours.mask == theirs.mask)[sure].all())
    met = theirs.mask & sure
    assert float(sure.float().mean()) > 0.8
    assert float((ours.depth - theirs.depth).abs()[met].max()) <= APART
    assert float((ours.position - theirs.position).norm(dim=-1)[met].max()) <= APART
    assert not ours.level.any()


def test_rays_end_where_pytorchs_do(place: torch.device, counted: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """More rays than one program has places for, so that those of the first are taken by others."""
    monkeypatch.setattr(fused, "program_count", lambda *_: 1)
    field, (origins, directions) = ball(place), rays(90, place)
    ours, theirs = both(field, origins, directions, monkeypatch)
    assert sum(counted) > 64  # places of a program
    assert 30 < int(theirs.mask.sum()) < 85
    assert_same(ours, theirs, field, directions)
    # The same rules take as many steps, but where rounding turns a decision.
    assert float((ours.steps == theirs.steps).float().mean()) > 0.9


@pytest.mark.slow
def test_rays_from_inside_and_behind(place: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the middle out; and a start behind the surface sends a ray back to its beginning."""
    field = ball(place)
    _, directions = rays(40, place)
    ours, theirs = both(field, torch.zeros_like(directions), directions, monkeypatch)
    assert bool(ours.mask.all())
    assert_same(ours, theirs, field, directions)
    origins, directions = rays(40, place)
    ours, theirs = both(field, origins, directions, monkeypatch, near=1.3)
    assert_same(ours, theirs, field, directions)
    assert float(ours.depth[ours.mask].min()) < 1.3


@pytest.mark.parametrize("count", [0, 1, 20])
def test_any_number_of_rays_and_levels_in_range(
    count: int, place: torch.device, counted: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coarse level of several; the finer ones are marched as ever."""
    field = MultiscaleSDF(ball(place), [Siren(8, 1).to(place).requires_grad_(False)], [0.02]).to(place)
    origins, directions = rays(count, place)
    ours, theirs = both(field, origins, directions, monkeypatch, level=0, max_steps=20)
    assert ours.depth.shape == theirs.depth.shape == (count,)
    assert counted == [count]
    if count > 1:
        assert_same(ours, theirs, field.base, directions)
    sphere_trace(field, origins, directions, level=1)
    assert counted == [count]


def test_few_steps_end_where_they_are(place: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    field, (origins, directions) = ball(place), rays(40, place)
    ours, theirs = both(field, origins, directions, monkeypatch, max_steps=2)
    assert int(ours.steps.max()) == 2
    # Two steps of balls: nothing but rounding of values between them.
    assert float((ours.depth - theirs.depth).abs().max()) <= 1e-4
