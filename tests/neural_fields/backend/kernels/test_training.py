"""The way back through a fused jet: against PyTorch's own in float32 and float64, and against differences."""

import copy
from collections.abc import Callable, Sequence

import mplicits.neural_fields.backend.kernels.training as fused
import pytest
import torch
from bounds import assert_within, rounding
from mplicits.neural_fields import Siren
from torch import Tensor


def loss(network: Siren, x: Tensor) -> Tensor:
    """Distances, a direction and an eikonal term: values and gradients, each with cotangents that vary."""
    value, gradient, _ = network.jet(x)
    aim = torch.linspace(-1, 1, x.shape[1]).to(x)
    return value.square().sum() + (gradient @ aim).sin().sum() + (gradient.norm(dim=-1) - 1).square().sum()


def gradients(network: Siren, x: Tensor) -> list[Tensor]:
    """Of the loss, with respect to points and parameters."""
    x = x.detach().requires_grad_()
    return list(torch.autograd.grad(loss(network, x), [x, *network.parameters()]))


def gradients_again(network: Siren, x: Tensor) -> Sequence[Tensor]:
    """For `rounding`, which takes networks without a graph."""
    with torch.enable_grad():
        return gradients(copy.deepcopy(network).requires_grad_(), x)


@pytest.fixture
def counted(watch: Callable[..., list[int]]) -> list[int]:
    return watch(fused, "jet_backward", lambda x, *_: len(x))


SIZES = [(16, 1, 65), (24, 2, 1), (24, 2, 200), (40, 3, 33), (128, 2, 33), (144, 2, 1)]
LARGE = [(256, 2, 65), (400, 2, 65), (400, 3, 65), (64, 5, 65)]


@pytest.mark.parametrize(
    ("width", "depth", "count"), [*SIZES, *(pytest.param(*size, marks=pytest.mark.slow) for size in LARGE)]
)
def test_gradients_are_those_of_float64(width, depth, count, place, counted) -> None:
    """Within what rounding may do: relative changes of weights and points by the γ of an inner product."""
    network, x = Siren(width, depth, omega=10.0).to(place), (2 * torch.rand(count, 3) - 1).to(place)
    found = gradients(network, x)
    assert counted == [count]
    exact = copy.deepcopy(network).cpu()
    bounds = rounding(exact, x.cpu(), gradients_again)
    for one, other, bound in zip(found, gradients_again(exact.double(), x.double().cpu()), bounds, strict=True):
        # A sum over points rounds once more for each of them.
        terms = 1 + count / max(16, width)
        assert_within(one.cpu(), other, terms * torch.maximum(bound, bound.median()))


def test_gradients_are_those_of_differences(place: torch.device, counted: list[int]) -> None:
    """Central differences of the loss in float64, along one direction in all weights and points at once."""
    network, x = Siren(24, 2, omega=5.0).to(place), (2 * torch.rand(40, 3) - 1).to(place)
    found = [one.double().cpu() for one in gradients(network, x)]
    ways = [torch.randn_like(one) for one in found]

    @torch.no_grad()
    def moved(step: float) -> float:
        exact = copy.deepcopy(network).cpu().double()
        for parameter, way in zip(exact.parameters(), ways[1:], strict=True):
            parameter.add_(step * way)
        return float(loss(exact, x.double().cpu() + step * ways[0]))

    step = 1e-5  # its square, and rounding over it, are far below float32
    expected = (moved(step) - moved(-step)) / (2 * step)
    products = torch.stack([(one * way).sum() for one, way in zip(found, ways, strict=True)])
    sizes = sum(float((one * way).abs().sum()) for one, way in zip(found, ways, strict=True))
    assert counted == [40]
    assert abs(float(products.sum()) - expected) <= 1e-5 * sizes  # 100 roundings of float32 of every term


def test_no_points(place: torch.device) -> None:
    network, x = Siren(24, 2).to(place), torch.empty(0, 3, device=place)
    assert all(not one.any() for one in gradients(network, x))


def test_units_and_unused_outputs(place: torch.device) -> None:
    """Of a loss on values alone; and a weight kept as W / unit has unit times the derivative."""
    network, x = Siren(24, 2).to(place), (2 * torch.rand(40, 3) - 1).to(place)
    before = torch.autograd.grad(network.jet(x).value.sum(), list(network.parameters()))
    network.set_units(sines=0.25, output=8.0)
    after = torch.autograd.grad(network.jet(x).value.sum(), list(network.parameters()))
    for (name, _), one, other in zip(network.named_parameters(), before, after, strict=True):
        assert torch.equal(one * (8.0 if name.startswith("output") else 0.25), other)


def test_twice(place: torch.device) -> None:
    """Who records the way back gets PyTorch's, which can be gone back once more."""
    network, x = Siren(16, 2, omega=5.0).to(place), (2 * torch.rand(20, 3) - 1).to(place).requires_grad_()

    def bend(field: Siren, points: Tensor) -> list[Tensor]:
        gradient = field.jet(points).gradient
        (second,) = torch.autograd.grad(gradient[:, 0].sum(), points, create_graph=True)
        return list(torch.autograd.grad(second.square().sum(), list(field.parameters())[:-1]))

    expected = bend(copy.deepcopy(network).cpu().double(), x.detach().double().cpu().requires_grad_())
    for one, other in zip(bend(network, x), expected, strict=True):
        assert_within(one.cpu(), other, 1e-5 * other.abs().max())
