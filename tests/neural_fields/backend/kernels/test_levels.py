"""All levels in one launch, gates decided inside: against the same weights in float64, and the walk level by level."""

import copy
from collections.abc import Callable
from typing import Any

import mplicits.neural_fields.backend.kernels.launch as launch
import mplicits.neural_fields.backend.kernels.levels as fused
import pytest
import torch
from bounds import assert_within
from mplicits.neural_fields import Jet, MultiscaleSDF
from mplicits.neural_fields.backend.fixed_shapes import fixed_shapes
from torch import Tensor

from benchmarks.costs.rounding import gated_bound, rounding_bound

SIZES = [(16, 1), (24, 2), (17, 1)]
# Residuals as large as their bands, so that gates matter: no points in the first band, none in the second, some, all.
NONE, FIRST, MIXED, ALL = [1e-12, 1e-12], [0.2, 1e-12], [0.3, 0.2], [1e3, 1e3]


def levels(
    deltas: list[float], place: torch.device, *, sizes: list[tuple[int, int]] = SIZES, **options: Any
) -> MultiscaleSDF:
    omegas = [5.0 * 2**i for i in range(len(sizes))]
    field = MultiscaleSDF.from_widths(sizes, omegas=omegas, deltas=deltas, residual_gain=0.5, **options)
    return field.to(place).requires_grad_(False)


def points(count: int, place: torch.device, dimensions: int = 3) -> Tensor:
    return (2 * torch.rand(count, dimensions) - 1).to(place)


def exact_copy(field: MultiscaleSDF) -> MultiscaleSDF:
    """The same numbers in float64, on the CPU, where PyTorch evaluates."""
    return copy.deepcopy(field).cpu().double()


def assert_exact(field: MultiscaleSDF, x: Tensor, *, least_sure: float = 0.95) -> Jet:
    """Value and jet are those of float64 but for rounding, where rounding decides no gate → the exact jet."""
    exact, rows = exact_copy(field), x.double().cpu()
    jets = [part.jet(rows) for part in exact.levels]
    bounds = [tuple(b.cpu() for b in rounding_bound(x, own.raw(), own.omega, halves=True)) for own in field.levels]
    values = [(jet.value, jet.gradient) for jet in jets]
    sure, value_bound, gradient_bound = gated_bound(values, bounds, exact.deltas, field.taper)
    assert float(sure.float().mean()) >= least_sure
    value, jet, expected = field.value(x), field.jet(x), exact.jet(rows)
    assert_within(value.cpu()[sure], expected.value[sure], value_bound[sure])
    assert_within(jet.value.cpu()[sure], expected.value[sure], value_bound[sure])
    assert_within(jet.gradient.cpu()[sure], expected.gradient[sure], gradient_bound[sure])
    return expected


def inside(field: MultiscaleSDF, x: Tensor) -> list[int]:
    """How many points each residual is evaluated at."""
    exact, rows = exact_copy(field), x.double().cpu()
    within, counts = torch.ones(len(x), dtype=torch.bool), []
    for value, delta in zip(exact.level_values(rows), exact.deltas, strict=False):
        within = within & (value.abs() < delta)
        counts.append(int(within.sum()))
    return counts


@pytest.fixture
def counted(watch: Callable[..., list[str]]) -> list[str]:
    watch(fused, "levels_value", lambda *_: "levels_value")
    return watch(fused, "levels_jet", lambda *_: "levels_jet")


@pytest.mark.parametrize(("deltas", "taper"), [(NONE, 0.4), (FIRST, 0.4), (MIXED, 0.0), (MIXED, 0.4), (ALL, 0.0)])
def test_gates_that_let_none_some_and_all_through(deltas, taper, place, counted) -> None:
    """Tiles that are full and one that is not; a program for each."""
    field, x = levels(deltas, place, taper=taper), points(100, place)
    assert_exact(field, x)
    assert counted == ["levels_value", "levels_jet"]
    first, second = inside(field, x)
    assert (first == 0, second == 0) == (deltas is NONE, deltas in (NONE, FIRST))
    assert (first == 100, second == 100) == (deltas is ALL, deltas is ALL)


@pytest.mark.parametrize("count", [0, 1, 64])
def test_any_number_of_points(count: int, place: torch.device, counted: list[str]) -> None:
    field, x = levels([0.3], place, sizes=SIZES[:2]), points(count, place)
    if count:
        assert_exact(field, x, least_sure=0.9)
    assert field.value(x).shape == (count,)
    assert field.jet(x).gradient.shape == (count, 3)
    assert counted[-2:] == ["levels_value", "levels_jet"]


def test_lists_longer_than_a_tile(place: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """One program has everything: its list is read in several tiles, and written while it is read."""
    monkeypatch.setattr(launch, "INTERPRETED_PROGRAMS", 1)
    field, x = levels([0.9, 0.4], place, taper=1.0), points(150, place)
    first, second = inside(field, x)
    assert first > 64
    assert 0 < second < first
    assert_exact(field, x)


def test_points_of_any_shape_and_dimension_and_coarser_levels(place: torch.device, counted: list[str]) -> None:
    field, x = levels(MIXED, place, in_dim=4, taper=0.5), points(70, place, 4)
    expected = assert_exact(field, x)
    shaped = field.jet(x.reshape(7, 10, 4))
    assert shaped.value.shape == (7, 10)
    assert shaped.features.shape == (7, 10, 0)
    assert torch.equal(shaped.gradient.reshape(70, 4), field.jet(x).gradient)
    del counted[:]
    middle = field.value(x, level=1).cpu()
    assert counted == ["levels_value"]
    assert not torch.allclose(middle.double(), expected.value, atol=1e-3)
    assert_within(middle, exact_copy(field).value(x.double().cpu(), level=1), 1e-4)
    field.value(x, level=0)
    assert counted == ["levels_value"]  # one network is its own business


@pytest.mark.slow
def test_the_sizes_of_the_paper(place: torch.device) -> None:
    field = levels([0.03, 0.015], place, sizes=[(128, 2), (256, 2), (400, 2)])
    assert_exact(field, points(65, place), least_sure=0.9)


def test_points_that_are_masked_out_stay_coarse(place: torch.device, counted: list[str]) -> None:
    field, x = levels(ALL, place), points(70, place)
    coarse, fine = field.value(x, level=0), field.value(x)
    with fixed_shapes([3, 3]) as shapes:
        shapes.mask = torch.arange(70, device=place) % 3 == 0
        value = field.value(x)
        assert shapes.overflow is None  # one launch has capacity for all
    assert counted == ["levels_value", "levels_value"]
    # The same network with other rows beside them, whose error `gated_bound` puts below this.
    assert_within(value[::3], fine[::3], 1e-5)
    assert bool(((fine - coarse).abs() > 1e-3).float().mean() > 0.9)
    assert torch.equal(value[1::3], coarse[1::3])


def test_what_the_launch_cannot_do_is_done_level_by_level(place: torch.device, counted: list[str]) -> None:
    x = points(5, place)
    with_features = levels(MIXED, place, num_features=2)
    assert with_features.jet(x).features.shape == (5, 2)
    with_features.value_features(x)
    levels(MIXED, place).double().value(x.double())
    levels([1.0] * 4, place, sizes=[(8, 1)] * 5).value(x)
    graph = levels(MIXED, place).requires_grad_()
    graph.jet(x).value.sum().backward()
    assert graph.base.layers[0].weight.grad.any()
    assert counted == []
    with_features.value(x)
    assert counted == ["levels_value"]
