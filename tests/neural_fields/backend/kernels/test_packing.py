"""Packed weights: the halves hold what float32 holds, and follow the parameters; and the sine of phases in turns."""

import math

import pytest
import torch
import triton
import triton.language as tl
from bounds import assert_within, unit_roundoff
from mplicits.neural_fields import Siren
from mplicits.neural_fields.backend.kernels.packing import LARGEST_WEIGHT, SINES, pack, packed
from mplicits.neural_fields.backend.kernels.tensor_tiles import cosine, sine

from benchmarks.costs.rounding import COSINE_ERROR, SINE_ERROR

U = unit_roundoff(torch.float32)


@triton.jit
def evaluate_sines(turns, sines, cosines, COUNT: tl.constexpr, FACTOR: tl.constexpr):
    index = tl.arange(0, COUNT)
    t = tl.load(turns + index)
    tl.store(sines + index, sine(t, FACTOR))
    tl.store(cosines + index, cosine(t, FACTOR))


@pytest.mark.parametrize("reach", [0.5, 40.0, 1e4, 2.0**20])
@pytest.mark.parametrize("factor", [1.0, SINES])
def test_sines_of_phases_in_turns(reach: float, factor: float, place: torch.device) -> None:
    """Within the error that the analysis of rounding takes, for any phase that float32 tells from the next turn."""
    turns = torch.cat((reach * (2 * torch.rand((1 << 16) - 9) - 1), torch.arange(-4, 5) / 4)).to(place)
    sines, cosines = torch.empty_like(turns), torch.empty_like(turns)
    evaluate_sines[(1,)](turns, sines, cosines, COUNT=1 << 16, FACTOR=factor)
    phase = 2 * math.pi * torch.remainder(turns.double(), 1)  # exact but for float64
    assert_within(sines / factor, phase.sin(), SINE_ERROR * U)
    assert_within(cosines / factor, phase.cos(), COSINE_ERROR * U)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_halves_hold_what_float32_holds(scale: float) -> None:
    network = Siren(40, 3, omega=30.0).requires_grad_(False)
    network.layers[1].weight.mul_(scale)
    own = pack(network.raw(), 30.0, 1.0)
    for index, weight in enumerate((network.layers[1].weight, network.layers[2].weight)):
        exact = 30.0 / (2 * math.pi) * weight.double().t()
        factor = SINES * float(own.floats[(3 + 3 + 2) * own.shape.width + 2 + index])  # 1 / S, a power of two
        assert math.frexp(factor)[0] == 0.5
        high, low = (half.double()[:40, :40] * factor for half in own.halves[index])
        assert LARGEST_WEIGHT / 2 < float((exact / factor).abs().max()) <= LARGEST_WEIGHT
        assert_within(high + low, exact, (4 * U * exact.abs()).clamp(min=2.0**-25 * factor))
        assert not bool(own.halves[index][:, 40:].any())


def test_weights_are_packed_again_when_they_change() -> None:
    """Into the same memory, which graphs read; and only then."""
    network = Siren(16, 2)
    first = packed(network)
    before = first.floats.clone()
    assert packed(network) is first
    with torch.no_grad():
        network.layers[0].weight.mul_(2)
    second = packed(network)
    assert second.floats.data_ptr() == first.floats.data_ptr()
    assert not torch.equal(second.floats, before)
    network.set_units(sines=0.5)
    third = packed(network).floats.clone()
    assert torch.equal(third, second.floats)  # other numbers, the same function
    with torch.inference_mode():
        network.output.weight.mul_(2)
        assert not torch.equal(packed(network).floats, third)


def test_weights_made_in_inference_mode_are_packed_each_time() -> None:
    with torch.inference_mode():
        network = Siren(16, 2)
        before = packed(network).floats.clone()
        network.layers[0].weight.mul_(2)
        assert not torch.equal(packed(network).floats, before)
