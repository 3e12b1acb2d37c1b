"""What every `Field` promises, over every field × level × dtype × batch shape."""

import functools
from collections.abc import Callable

import pytest
import torch
from bounds import assert_within, rounding
from fields import EXACT, FIELDS
from mplicits.neural_fields import Field
from torch import Tensor


def points(field: Field, shape: tuple[int, ...], **options: object) -> Tensor:
    return 2 * torch.rand(*shape, field.in_dim, **options) - 1


@functools.cache
def jet_rounding(make: Callable[[], Field], dtype: torch.dtype, level: int) -> tuple[Tensor, list[Tensor]]:
    """Points ``(200, d)``, and how far rounding may move a field's jets there: the same for all who ask."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # as before each test
        field = make().to(dtype)
    x = 2 * torch.rand(200, field.in_dim, dtype=dtype, generator=torch.Generator().manual_seed(0)) - 1
    return x, rounding(field, x, lambda field, x: field.jet(x, level=level))


@pytest.fixture(params=FIELDS)
def make(request: pytest.FixtureRequest) -> Callable[[], Field]:
    return FIELDS[request.param]


@pytest.fixture
def field(make: Callable[[], Field], dtype: torch.dtype, device: torch.device) -> Field:
    return make().to(device=device, dtype=dtype)


@pytest.mark.parametrize("shape", [(), (1,), (0,), (7,), (2, 3), (3, 0, 2)])
def test_shapes_and_types_follow_the_input(field, shape, dtype, device) -> None:
    x = points(field, shape, dtype=dtype, device=device)
    for level in range(-field.num_levels, field.num_levels):
        value, jet = field.value(x, level=level), field.jet(x, level=level)
        assert value.shape == jet.value.shape == shape
        assert jet.gradient.shape == x.shape
        assert jet.features.shape[:-1] == shape
        inside = field.in_band(x, level=level)
        assert (inside.shape, inside.dtype) == (shape, torch.bool)
        assert {(tensor.dtype, tensor.device.type) for tensor in (value, *jet)} == {(dtype, device.type)}


def test_jet_agrees_with_value_and_autograd(field, make, dtype, device) -> None:
    for level in range(field.num_levels):
        x, (off, slope_off, _) = jet_rounding(make, dtype, level)
        x = x.to(device).clone().requires_grad_()
        value, jet = field.value(x, level=level), field.jet(x, level=level)
        (gradient,) = torch.autograd.grad(value.sum(), x)
        assert_within(jet.value, value, 2 * off)
        assert_within(jet.gradient, gradient, 2 * slope_off)


def test_features_without_gradients_are_those_of_the_jet(field, make, dtype, device) -> None:
    for level in range(field.num_levels):
        x, (off, _, feature_off) = jet_rounding(make, dtype, level)
        x = x.to(device)
        jet = field.jet(x, level=level)
        for graph in (True, False):
            with torch.set_grad_enabled(graph):
                value, features = field.value_features(x.reshape(2, 100, -1), level=level)
            assert features.shape == (2, 100, jet.features.shape[-1])
            assert_within(value.flatten(), jet.value, 2 * off)
            assert_within(features.flatten(0, 1), jet.features, 2 * feature_off)


def test_points_can_be_brought_to_a_field(field: Field, dtype: torch.dtype, device: torch.device) -> None:
    assert (field.like.dtype, field.like.device.type) == (dtype, device.type)
    half = torch.zeros(1, field.in_dim, dtype=torch.float16).to(field.like)
    assert field.value(half).dtype == dtype


def test_results_without_a_graph_are_the_same(field, make, dtype, device) -> None:
    x, off = jet_rounding(make, dtype, field.num_levels - 1)
    x = x.to(device)
    with_graph = field.jet(x.clone().requires_grad_())
    with torch.inference_mode():
        without, value = field.jet(x), field.value(x)
    assert_within((*with_graph, with_graph.value), (*without, value), (*off, off[0]), times=2)


def test_levels_count_from_both_ends_and_stop_there(field: Field, dtype: torch.dtype, device: torch.device) -> None:
    x = points(field, (50,), dtype=dtype, device=device)
    assert field.deltas.shape == (field.num_levels - 1,)
    assert torch.equal(field.value(x), field.value(x, level=field.num_levels - 1))
    for level in range(field.num_levels):
        together = field.level_values(x, level=level)
        assert len(together) == level + 1
        assert all(torch.equal(value, field.value(x, level=each)) for each, value in enumerate(together))
    for level in (field.num_levels, -field.num_levels - 1):
        for method in (field.value, field.jet):
            with pytest.raises(ValueError, match="this field has levels"):
                method(x, level=level)


def test_levels_differ_only_inside_the_band(field: Field, dtype: torch.dtype, device: torch.device) -> None:
    x = points(field, (2000,), dtype=dtype, device=device)
    assert field.in_band(x, level=0).all()
    for level in range(1, field.num_levels):
        before, after = field.value(x, level=level - 1), field.value(x, level=level)
        inside = field.in_band(x, level=level)
        assert torch.equal(before[~inside], after[~inside])
        expected = field.in_band(x, level=level - 1) & (before.abs() < field.deltas[level - 1])
        assert torch.equal(inside, expected)
        assert set(inside.tolist()) == {True, False}


def test_wrong_dimension_is_refused(field: Field) -> None:
    for method in (field.value, field.jet):
        with pytest.raises(ValueError, match=rf"expected \(\.\.\., {field.in_dim}\)"):
            method(torch.zeros(5, field.in_dim + 1))


@pytest.mark.parametrize("name", EXACT)
def test_exact_fields_are_distances(name: str) -> None:
    """The step −f ∇f from any point lands on the zero set, and no surface point is nearer."""
    field = EXACT[name]().double()
    x = points(field, (4000,), dtype=torch.float64)
    value, gradient, _ = field.jet(x)
    off, slope_off, _ = rounding(field, x, lambda field, x: field.jet(x))
    assert_within(gradient.norm(dim=-1), torch.ones_like(value), slope_off.sum(dim=-1))
    foot = x - value[:, None] * gradient
    # The foot is off by the value, and by the distance times the direction.
    off = 2 * off + value.abs() * slope_off.sum(dim=-1)
    assert_within(field.value(foot), torch.zeros_like(value), off)
    nearest = (x[:500, None] - foot).norm(dim=-1).min(dim=1).values
    assert (nearest >= value[:500].abs() - off.max()).all()
