"""Value and jet of one launch, against the same weights in float64 and against PyTorch."""

import copy
from collections.abc import Callable
from typing import Any

import mplicits.neural_fields.backend.kernels.siren as fused
import pytest
import torch
from bounds import assert_within, rounding
from mplicits.neural_fields import Siren

from benchmarks.costs.rounding import rounding_bound

# Widths that fill their blocks and widths that do not, in one block and in several; every depth that puts aside other
# things; points that end within a tile, at its end, and more than there are programs.
NETWORKS = [(16, 1), (16, 3), (40, 2), (64, 2), (128, 1), (128, 2), (100, 3), (144, 2)]
WIDE = [(128, 3), (256, 1), (256, 2), (256, 3), (400, 1), (400, 2), (400, 3), (130, 5)]


def points(count: int, place: torch.device, dimensions: int = 3) -> torch.Tensor:
    return (2 * torch.rand(count, dimensions) - 1).to(place)


def siren(width: int, depth: int, place: torch.device, **options: Any) -> Siren:
    return Siren(width, depth, **({"omega": 30.0} | options)).to(place).requires_grad_(False)


def assert_exact(network: Siren, x: torch.Tensor) -> None:
    value, jet = network.value(x), network.jet(x)
    exact = copy.deepcopy(network).cpu().double()
    expected = exact.jet(x.double().cpu())
    frequency, gain = network.omega * network.units[0], network.units[1]
    bounds = [bound.cpu() for bound in rounding_bound(x, network.raw(), frequency, gain, halves=True)]
    # Those bounds hold for any network and are loose; `rounding` perturbs the weights and points of this one.
    if len(x):
        likely = rounding(exact, x.cpu(), lambda field, p: (field.jet(p).value, field.jet(p).gradient))
        bounds = [torch.minimum(*pair) for pair in zip(bounds, likely, strict=True)]
    assert_within(value.cpu(), expected.value, bounds[0])
    assert_within(jet.value.cpu(), expected.value, bounds[0])
    assert_within(jet.gradient.cpu(), expected.gradient, bounds[1])


@pytest.fixture
def counted(watch: Callable[..., list[str]]) -> list[str]:
    watch(fused, "siren_value", lambda *_: "siren_value")
    return watch(fused, "siren_jet", lambda *_: "siren_jet")


@pytest.mark.parametrize(
    ("width", "depth"), [*NETWORKS, *(pytest.param(*size, marks=pytest.mark.slow) for size in WIDE)]
)
def test_networks_of_float32_are_those_of_float64(width, depth, place, counted) -> None:
    assert_exact(siren(width, depth, place), points(65, place))
    assert counted == ["siren_value", "siren_jet"]


@pytest.mark.parametrize("count", [0, 1, 63, 64, 300])
def test_any_number_of_points(count: int, place: torch.device, counted: list[str]) -> None:
    """300 points are five tiles for the interpreter's three programs."""
    network, x = siren(24, 2, place), points(count, place)
    assert_exact(network, x)
    assert network.jet(x).gradient.shape == (count, 3)
    assert counted == ["siren_value", "siren_jet", "siren_jet"]


def test_points_of_any_shape_and_dimension(place: torch.device) -> None:
    network = siren(24, 2, place, in_dim=4)
    assert_exact(network, points(70, place, 4))
    x = points(70, place, 4)
    assert torch.equal(network.value(x.reshape(7, 10, 4)), network.value(x).reshape(7, 10))
    assert_exact(network, x[::2])
    assert network.jet(x[:0].reshape(0, 5, 4)).features.shape == (0, 5, 0)


def test_large_phases_keep_their_digits(place: torch.device) -> None:
    """Phases of some thousands: a sine of limited range would be off by far more than the bound."""
    network = siren(16, 2, place, omega=3000.0)
    assert_exact(network, points(65, place))


def test_values_of_a_network_with_features(place: torch.device, counted: list[str]) -> None:
    """A value is the first output alone; features are PyTorch's."""
    network, x = siren(24, 2, place, num_features=3), points(65, place)
    value, features = network.value_features(x)
    assert counted == []
    bound, _ = rounding_bound(x, network.raw(), network.omega, halves=True)
    assert_within(network.value(x), value, 2 * bound)
    assert counted == ["siren_value"]
    assert features.shape == (65, 3)


def test_what_has_a_graph_is_pytorchs(place: torch.device, counted: list[str]) -> None:
    network = siren(24, 2, place)
    x = points(5, place).requires_grad_()
    network.value(x).sum().backward()
    assert x.grad.any()
    assert counted == []


def test_a_bound_that_is_no_bound_would_be_noticed(place: torch.device) -> None:
    """Weights changed by a thousandth are told from rounding, so that the tests above can fail."""
    network, x = siren(24, 2, place), points(65, place)
    value_bound, gradient_bound = rounding_bound(x, network.raw(), network.omega, halves=True)
    before = network.jet(x)
    network.layers[1].weight.mul_(1.001)
    after = network.jet(x)
    assert bool(((before.value - after.value).abs() > value_bound).any())
    assert bool(((before.gradient - after.gradient).abs() > gradient_bound).any())
