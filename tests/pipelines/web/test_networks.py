"""Numbers for the shaders: turns, rounding and packing, against exact arithmetic."""

import math

import numpy as np
import pytest
import torch
from fields import small_multiscale
from mplicits.neural_fields import Siren
from mplicits.pipelines.web.payload import network_layers, pack_codes, rounded_field, rounding_error


def evaluate(layers, points):
    """The network in float64, from what the page is given."""
    h = points
    for layer in layers[:-1]:
        turns = h @ layer.weight.astype(np.float64).T + layer.bias
        h = np.sin(2 * math.pi * (turns - np.rint(turns)))
    return h @ layers[-1].weight.astype(np.float64).T + layers[-1].bias


def test_layers_in_turns_are_the_network():
    torch.manual_seed(0)
    network = Siren(24, 3, omega=20.0, num_features=2).double()
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    expected, features = network.value_features(torch.from_numpy(points))
    found = evaluate(network_layers(network, None, channels=3), points)
    # Weights are rounded to float32: each of 24 terms of a phase by 2⁻²⁴ of some 20, through three layers.
    bound = 24 * 20 * 2**-24 * 3
    np.testing.assert_allclose(found[:, 0], expected.detach().numpy(), atol=bound)
    np.testing.assert_allclose(found[:, 1:], features.detach().numpy(), atol=bound)


def test_rounded_weights_are_within_half_a_step_of_their_row():
    torch.manual_seed(1)
    network = Siren(16, 2, omega=30.0)
    exact, rounded = network_layers(network, None), network_layers(network, 16)
    codes, scale = rounded[1].codes, rounded[1].scale
    assert np.abs(codes).max() == 2**15 - 1
    step = np.abs(exact[1].weight).max(axis=1) / (2**15 - 1)
    np.testing.assert_allclose(scale, step, rtol=1e-6)
    # Half a step, and the rounding of the product to float32.
    assert (np.abs(rounded[1].weight - exact[1].weight) <= step[:, None] * 0.5 * (1 + 1e-3) + 2e-7).all()


def test_the_error_that_is_stated_is_that_of_the_rounded_field():
    torch.manual_seed(2)
    field = small_multiscale(0.4).requires_grad_(False)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3)).astype(np.float32)
    x = torch.from_numpy(points)
    rough = rounding_error(field, 6, points)
    for level, part in enumerate(rough):
        change = (rounded_field(field, 6).value(x, level=level) - field.value(x, level=level)).abs().max()
        assert part.value == pytest.approx(float(change), rel=1e-4)
        assert part.value > 0
        assert part.angle > 0
    fine = rounding_error(field, 12, points)
    assert all(after.value < before.value for before, after in zip(rough, fine, strict=True))


@pytest.mark.parametrize("bits", [2, 5, 8, 13, 16, 24])
def test_packed_codes_come_back(bits):
    most = 2 ** (bits - 1) - 1
    codes = np.random.default_rng(0).integers(-most, most + 1, 101)
    codes[:2] = -most, most
    data = pack_codes(codes, bits)
    low = max(0, bits - 8)
    assert len(data) == 101 + math.ceil(101 * low / 8)
    number = int.from_bytes(data[101:], "little")
    found = [(upper << low) + ((number >> (low * i)) & (2**low - 1)) for i, upper in enumerate(data[:101])]
    assert [code - 2**bits if code >> (bits - 1) else code for code in found] == codes.tolist()
