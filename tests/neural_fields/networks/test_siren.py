import math

import pytest
import torch
from bounds import assert_within, rounding
from fields import cube
from mplicits.neural_fields import Siren
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode


@pytest.mark.parametrize(("width", "depth", "count"), [(128, 2, 17_153), (256, 2, 67_073), (400, 2, 162_401)])
def test_parameter_counts_of_the_paper(width: int, depth: int, count: int) -> None:
    assert sum(p.numel() for p in Siren(width, depth).parameters()) == count


def test_initialisation_bounds() -> None:
    network = Siren(200, 3, omega=30.0)
    first, *hidden = [layer.weight for layer in network.layers]
    for weight, bound in [(first, 1 / 3), *((w, math.sqrt(6 / 200) / 30) for w in [*hidden, network.output.weight])]:
        assert weight.abs().max() <= bound
        assert weight.abs().max() > 0.95 * bound
    assert Siren(200, 3, output_gain=0.1).output.weight.abs().max() <= 0.1 * math.sqrt(6 / 200) / 30


def test_value_is_equation_2() -> None:
    network = Siren(8, 2, omega=7.0, num_features=1).double()
    x = torch.rand(5, 3, dtype=torch.float64)
    h = x
    for layer in network.layers:
        h = torch.sin(7.0 * (h @ layer.weight.T + layer.bias))
    expected = h @ network.output.weight.T + network.output.bias
    off = rounding(network, x, lambda field, x: field.jet(x))
    assert_within(network.value(x), expected[:, 0], 2 * off[0])
    assert_within(network.jet(x).features, expected[:, 1:], 2 * off[2])


def some_loss(value: Tensor, gradient: Tensor) -> Tensor:
    return (value**2).sum() + ((gradient.norm(dim=-1) - 1) ** 2).sum() + (gradient[:, 0] * value).sum()


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_hand_written_derivatives_of_the_jet(depth: int) -> None:
    network = Siren(12, depth, omega=4.0, num_features=2).double()
    x = torch.rand(20, 3, dtype=torch.float64, requires_grad=True)
    jet = network.jet(x)
    inputs = [x, *network.parameters()]
    ours = torch.autograd.grad(some_loss(jet.value, jet.gradient) + (jet.features**3).sum(), inputs)
    value, plain_features = network.value(x), network.jet(x).features  # features alone have a zero cotangent
    (slope,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    loss = some_loss(value, slope) + (plain_features**3).sum()
    expected = torch.autograd.grad(loss, inputs, materialize_grads=True)
    torch.testing.assert_close(ours, expected)


def test_jets_pass_gradcheck_twice() -> None:
    network = Siren(5, 2, omega=3.0).double()
    x = torch.rand(3, 3, dtype=torch.float64, requires_grad=True)

    def jet(x: Tensor) -> tuple[Tensor, Tensor]:
        result = network.jet(x)
        return result.value, result.gradient

    assert torch.autograd.gradcheck(jet, x)
    assert torch.autograd.gradgradcheck(jet, x)


def test_derivative_of_the_jet_with_frozen_points_or_parameters() -> None:
    network = Siren(8, 2, omega=3.0).double()
    x = torch.rand(9, 3, dtype=torch.float64)
    some_loss(*network.jet(x)[:2]).backward()
    assert all(p.grad is not None for p in network.parameters())
    network.requires_grad_(False)
    y = x.clone().requires_grad_()
    some_loss(*network.jet(y)[:2]).backward()
    assert y.grad.any()
    assert network.jet(x).value.grad_fn is None


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    network, x = Siren(32, 3).double(), cube(1000)

    def evaluated(network: Siren, x: Tensor) -> list[Tensor]:
        return [network.value(x), *network.jet(x), network.second_jet(x).hessian]

    off = rounding(network, x, evaluated)
    with torch.no_grad():
        whole = evaluated(network, x)
        monkeypatch.setattr("mplicits.neural_fields.networks.siren.BLOCK_FLOATS", 32 * 256)
        assert_within(evaluated(network, x), whole, off, times=2)
    monkeypatch.setattr("mplicits.neural_fields.networks.siren.GRAPH_BLOCK_FACTOR", 1)
    assert_within(evaluated(network, x), whole, off, times=2)


def test_non_contiguous_points() -> None:
    network = Siren(16, 2)
    x = torch.rand(3, 40).t()
    off = rounding(network, x, lambda field, x: field.jet(x))
    with torch.no_grad():
        assert_within(network.jet(x), network.jet(x.contiguous()), off, times=2)


@pytest.mark.parametrize(("training", "times"), [(False, 2.5), (True, 3.0)])
def test_a_second_jet_costs_two_and_a_half_jets(training: bool, times: float) -> None:
    """Products of width × width matrices: 2 in a jet, 5 in a second jet; with backward passes 5 and 15."""
    siren, x = Siren(64, 4), torch.rand(32, 3)
    counts = []
    for evaluate in (siren.jet, siren.second_jet):
        with FlopCounterMode(display=False) as counter, torch.set_grad_enabled(training):
            parts = [part for part in evaluate(x) if part.numel()]
            if training:
                torch.autograd.backward(parts, [torch.ones_like(part) for part in parts])
        counts.append(counter.get_total_flops())
    # The other products have at most three rows or columns, 3 / width of those.
    assert 0 < counts[1] <= (times + 3 * 3 / 64) * counts[0]
