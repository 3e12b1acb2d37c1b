"""Rates for each layer, as groups or in units: the same steps either way, and the same function."""

import copy

import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, NeuSGeometry, Siren, SpaceTimeSDF, Sphere, Union
from mplicits.neural_fields.hosts.learning_rates import OUTPUT_RATE, SINE_RATE, parameter_groups, rescale_parameters
from torch import Tensor, nn


def tapered() -> MultiscaleSDF:
    return MultiscaleSDF.from_widths([(16, 2), (24, 3)], omegas=[10, 30], deltas=[0.5], taper=0.3, num_features=2)


def outputs(field: MultiscaleSDF, x: Tensor) -> list[Tensor]:
    return [field.value(x), *field.jet(x), *field.second_jet(x), *field.value_features(x)]


@pytest.mark.parametrize("graph", [True, False])
def test_units_change_no_bit_of_the_function(graph: bool) -> None:
    field, x = tapered(), torch.rand(300, 3) - 0.5
    with torch.set_grad_enabled(graph):
        before = outputs(field, x)
        stored = field.base.output.weight.detach().clone()
        rescale_parameters(field, 5e-4)
        assert not torch.equal(field.base.output.weight, stored)
        torch.testing.assert_close(outputs(field, x), before, rtol=0, atol=0)


def test_state_dicts_hold_the_weights_whatever_the_units() -> None:
    plain, x = tapered(), torch.rand(50, 3)
    shared = copy.deepcopy(plain)
    rescale_parameters(shared, 5e-4)
    state = shared.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in plain.state_dict().items())
    other = tapered()
    rescale_parameters(other, 1e-2)
    other.load_state_dict(state)
    fresh = tapered()
    fresh.load_state_dict(other.state_dict())
    again = copy.deepcopy(other)
    again.load_state_dict(again.state_dict())
    for field in (other, fresh, again):
        assert torch.equal(field.value(x), plain.value(x))
    assert all(torch.equal(tensor, plain.state_dict()[name]) for name, tensor in state.items())  # not written into


def test_a_gradient_counts_as_much_as_its_unit() -> None:
    siren, x = Siren(8, 2, omega=10.0), torch.rand(20, 3)
    plain = torch.autograd.grad(siren.value(x).sum(), list(siren.parameters()))
    siren.set_units(0.5, 0.125)
    found = torch.autograd.grad(siren.value(x).sum(), list(siren.parameters()))
    for (name, _), one, other in zip(siren.named_parameters(), plain, found, strict=True):
        assert torch.equal(other, one * (0.125 if name.startswith("output") else 0.5))


def test_one_rate_takes_the_steps_of_the_groups() -> None:
    """Adam's first step is the rate itself, whatever the gradient; units are rounded to powers of two."""
    host, x = 5e-4, torch.rand(50, 3) - 0.5
    grouped, shared = tapered(), tapered()
    shared.load_state_dict(grouped.state_dict())
    rescale_parameters(shared, host)
    moved = []
    for field, groups in ((grouped, parameter_groups(grouped, host)), (shared, shared.parameters())):
        before = {name: tensor.clone() for name, tensor in field.state_dict().items()}
        optimizer = torch.optim.Adam(groups, lr=host, eps=1e-30)
        jet = field.jet(x)
        (jet.value.square().sum() + jet.gradient.square().sum() + jet.features.sum()).backward()
        optimizer.step()
        moved.append({name: (tensor - before[name]).abs().max() for name, tensor in field.state_dict().items()})
    for level, omega in (("base", 10), ("residuals.0", 30)):
        for name, rate in (("layers.0.weight", SINE_RATE / omega), ("output.weight", OUTPUT_RATE)):
            exact, near = (float(steps[f"{level}.{name}"]) for steps in moved)
            # Each weight is rounded before and after; weights are below 1.
            assert abs(exact - rate) <= 2 * torch.finfo(torch.float32).eps
            assert rate / 2**0.5 - 1e-6 <= near <= rate * 2**0.5 + 1e-6


@pytest.mark.parametrize(("pace", "shares"), [(0.5, (0.5, 0.5)), ((0.5, 0.25), (0.5, 0.25)), ((2.0,), (2.0, 2.0))])
def test_levels_learn_at_their_pace(pace: float | tuple[float, ...], shares: tuple[float, float]) -> None:
    field = tapered()
    plain, slow = ([group["lr"] for group in parameter_groups(field, 1e-3, pace=each)] for each in (1.0, pace))
    of_group = [share for share in shares for _ in range(2)]  # sine layers and output
    assert slow == pytest.approx([share * rate for share, rate in zip(of_group, plain, strict=True)], rel=1e-12)
    rescale_parameters(field, 5e-4)
    units = [unit for siren in field.levels for unit in siren.units]
    shell = NeuSGeometry(field, learning_rate=5e-4, pace=pace)
    found = [unit for siren in field.levels for unit in siren.units]
    assert found == [share * unit for share, unit in zip(of_group, units, strict=True)]
    rates = [group["lr"] * unit for group, unit in zip(shell.parameter_groups(1e-3), found, strict=True)]
    assert rates == pytest.approx(slow, rel=1e-12)


def test_levels_of_all_parts_have_their_pace() -> None:
    field = Union(tapered(), Siren(8, 1), tapered())
    rates = [group["lr"] for group in parameter_groups(field, 5e-4, pace=(1.0, 0.5))]
    pair = [SINE_RATE / 10, OUTPUT_RATE, SINE_RATE / 60, OUTPUT_RATE / 2]
    assert rates == pytest.approx([*pair, SINE_RATE / 30, OUTPUT_RATE, *pair], rel=1e-12)


def test_every_parameter_is_in_one_group() -> None:
    field = Union(tapered(), Sphere(), Siren(8, 1))
    field.register_parameter("weight", nn.Parameter(torch.zeros(1)))
    groups = parameter_groups(field, 1e-3)
    found = [id(parameter) for group in groups for parameter in group["params"]]
    assert sorted(found) == sorted(map(id, field.parameters()))
    assert groups[-1]["lr"] == 1e-3
    torch.optim.Adam(groups)
    assert parameter_groups(Sphere()) == []


def test_lifted_into_space_time_and_sliced_it_stays_the_same() -> None:
    plain = tapered()
    shared = copy.deepcopy(plain)
    rescale_parameters(shared)
    fields = []
    for field in (plain, shared):
        torch.manual_seed(3)
        fields.append(SpaceTimeSDF.from_static(field))
    x = torch.rand(40, 4) - 0.5
    assert torch.equal(fields[0].value(x), fields[1].value(x))
    for siren in fields[1].sdf.levels:
        siren.set_units(0.5, 2.0)
    slices = [field.at(0.25) for field in fields]
    assert torch.equal(slices[0].value(x[:, :3]), slices[1].value(x[:, :3]))
