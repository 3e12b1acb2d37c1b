"""The geometry network of NeuS (Wang et al. 2021; initialised as in SAL, Atzmon and Lipman 2020, and IDR).

Softplus layers with β = 100, weight normalisation, a positional encoding, and the encoded input joined again before the
middle layer. Unlike the published code, the gradient is one sweep back written in matrix products.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrizations

from ..backend.errors import at_least
from ..fields.field import Jet, OneLevelField
from .colors import encode, encoded_size

BETA = 100.0  # of the softplus


class NeusSDF(OneLevelField):
    """A softplus MLP that begins as the signed distance of a sphere.

    Args:
        width: neurons per hidden layer.
        depth: hidden layers; the encoded input is joined again before layer depth // 2.
        frequencies: octaves of the positional encoding.
        num_features: outputs beside the distance; NeuS has as many as neurons.
        radius: of the initial sphere.

    Raises:
        ValueError: an argument is out of range.
    """

    defined_by = ("width", "depth", "frequencies", "num_features")

    def __init__(
        self, width: int = 256, depth: int = 8, *, frequencies: int = 6, num_features: int = 256, radius: float = 0.5
    ) -> None:
        super().__init__()
        inputs = encoded_size(3, frequencies)
        at_least(inputs + 1, width=width)
        at_least(2, depth=depth)
        at_least(0, frequencies=frequencies, num_features=num_features)
        self.width, self.depth, self.frequencies, self.radius = width, depth, frequencies, radius
        self.num_features = num_features
        self.joined = depth // 2
        sizes = [inputs, *[width] * depth, 1 + num_features]
        layers = []
        for index in range(depth + 1):
            # The layer before the joint leaves room for the input beside its outputs.
            outputs = sizes[index + 1] - (inputs if index + 1 == self.joined else 0)
            layers.append(nn.Linear(sizes[index], outputs))
        self._initialise(layers, inputs)
        self.layers = nn.ModuleList(parametrizations.weight_norm(layer) for layer in layers)

    @torch.no_grad()
    def _initialise(self, layers: list[nn.Linear], inputs: int) -> None:
        """Weights with which softplus layers keep |x| on average, and an output of |x| − radius."""
        for index, layer in enumerate(layers):
            if index == len(layers) - 1:
                layer.weight.normal_(math.sqrt(math.pi / layer.in_features), 1e-4)
                layer.bias.fill_(-self.radius)
                continue
            layer.bias.zero_()
            layer.weight.normal_(0, math.sqrt(2 / layer.out_features))
            # Weights of sines and cosines begin at 0: only x itself has the length that the sphere needs.
            if index == 0:
                layer.weight[:, 3:] = 0
            elif index == self.joined:
                layer.weight[:, self.width - inputs + 3 :] = 0

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.resolve_level(level)
        return self._forward(self.check_points(x).reshape(-1, 3))[0][:, 0].reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; one sweep back through the layers."""
        self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, 3)
        output, phases, weights = self._forward(rows)
        g = weights[-1][:1].expand(len(rows), -1)
        inputs = encoded_size(3, self.frequencies)
        encoded = rows.new_zeros(len(rows), inputs)
        for index in range(self.depth - 1, -1, -1):
            g = (g * (BETA * phases[index]).sigmoid()) @ weights[index]
            if index == self.joined:
                g = g / math.sqrt(2)
                g, encoded = g[:, :-inputs], g[:, -inputs:]
        gradient = _through_encoding(rows, g + encoded, self.frequencies)
        shape = x.shape[:-1]
        features = output[:, 1:].reshape(*shape, self.num_features)
        return Jet(output[:, 0].reshape(shape), gradient.reshape(x.shape), features)

    def _forward(self, x: Tensor) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        """Outputs ``(N, 1 + F)``, the pre-activations of the hidden layers, and the weights."""
        encoded = encode(x, self.frequencies)
        h, phases, weights = encoded, [], []
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, nn.Linear)
            if index == self.joined:
                h = torch.cat((h, encoded), dim=1) / math.sqrt(2)
            # Weight normalisation computes the weight on every access.
            weights.append(layer.weight)
            z = torch.addmm(layer.bias, h, weights[-1].t())
            if index == self.depth:
                return z, phases, weights
            phases.append(z)
            # Above βz = 50 softplus is z to the last digit; torch's own 20 would show in float64.
            h = nn.functional.softplus(z, beta=BETA, threshold=50.0)
        raise AssertionError("the last layer has returned")


def _through_encoding(x: Tensor, g: Tensor, frequencies: int) -> Tensor:
    """Pull a cotangent ``(N, 3 (1 + 2 K))`` of `encode` back to x."""
    own, sines, cosines = g.split([3, 3 * frequencies, 3 * frequencies], dim=1)
    octaves = 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)[:, None]
    phases = x[:, None] * octaves  # (N, K, 3)
    shape = (len(x), frequencies, 3)
    back = octaves * (sines.reshape(shape) * phases.cos() - cosines.reshape(shape) * phases.sin())
    return own + back.sum(dim=1)
