"""Colour that depends on the direction of view, and a background field outside the unit sphere (NeuS, NeRF++)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..backend.errors import at_least
from ..fields.field import Jet
from .hash_encoding import HashEncoding


def encode(x: Tensor, frequencies: int) -> Tensor:
    """Positional encoding: x, sin 2ᵏx, cos 2ᵏx for k < K frequencies; ``(..., d)`` → ``(..., d (1 + 2 K))``."""
    phases = (x[..., None, :] * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)[:, None]).flatten(-2)
    return torch.cat((x, phases.sin(), phases.cos()), dim=-1)


def encoded_size(dim: int, frequencies: int) -> int:
    """Number of outputs of `encode` for ``dim`` inputs."""
    return dim * (1 + 2 * frequencies)


class ViewColor(nn.Module):
    """Colour of a surface point as seen along a direction: NeuS's c(x, v, ∇f/|∇f|, features).

    The geometry enters only through its `Jet`, so any field, at any level, will do.

    Args:
        num_features: of the jet.
        width: neurons per hidden layer.
        depth: hidden layers.
        view_frequencies: octaves of the direction's encoding.
        point_frequencies: octaves of the position's encoding; 0 in NeuS.
        grid: a learnt encoding of the position beside it, or None.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Siren, ViewColor
        >>> jet = Siren(32, 2, num_features=8).jet(torch.zeros(5, 3))
        >>> ViewColor(8, width=64)(torch.zeros(5, 3), torch.ones(5, 3), jet).shape
        torch.Size([5, 3])
    """

    def __init__(
        self,
        num_features: int,
        *,
        width: int = 256,
        depth: int = 4,
        view_frequencies: int = 4,
        point_frequencies: int = 0,
        grid: HashEncoding | None = None,
    ) -> None:
        super().__init__()
        at_least(1, width=width, depth=depth)
        at_least(0, num_features=num_features, view_frequencies=view_frequencies, point_frequencies=point_frequencies)
        self.num_features, self.width, self.depth = num_features, width, depth
        self.view_frequencies, self.point_frequencies = view_frequencies, point_frequencies
        self.grid = grid
        inputs = encoded_size(3, point_frequencies) + encoded_size(3, view_frequencies) + 3 + num_features
        inputs += 0 if grid is None else grid.size
        self.layers = nn.ModuleList(_relu_layers([inputs, *[width] * depth, 3]))

    def forward(self, x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
        """Colours ``(..., 3)`` in [0, 1].

        Args:
            x: ``(..., 3)`` points.
            direction: ``(..., 3)`` unit vectors, from the eye to the points.
            jet: of the geometry there, with ``num_features`` features; ValueError otherwise.
        """
        if jet.features.shape[-1] != self.num_features:
            raise ValueError(f"jet.features: {jet.features.shape[-1]} of them; expected {self.num_features}")
        normal = nn.functional.normalize(jet.gradient, dim=-1)
        inputs = [encode(x, self.point_frequencies), encode(direction, self.view_frequencies), normal, jet.features]
        if self.grid is not None:
            inputs.append(self.grid(x))
        return _relu_network(torch.cat(inputs, dim=-1), self.layers).sigmoid()


class Outside(nn.Module):
    """Density and colour outside the unit sphere, over (x/r, 1/r): the outer network of NeRF++.

    Args:
        width: neurons per hidden layer.
        depth: hidden layers.
        point_frequencies: octaves of the encoding of (x/r, 1/r).
        view_frequencies: octaves of the encoding of the direction.
        grid: a learnt encoding beside it, or None; evaluated at (2 − 1/r) x/r, the contraction of mip-NeRF 360.
    """

    def __init__(
        self,
        *,
        width: int = 128,
        depth: int = 4,
        point_frequencies: int = 8,
        view_frequencies: int = 4,
        grid: HashEncoding | None = None,
    ) -> None:
        super().__init__()
        self.width, self.depth = width, depth
        self.point_frequencies, self.view_frequencies = point_frequencies, view_frequencies
        self.grid = grid
        inputs = encoded_size(4, point_frequencies) + (0 if grid is None else grid.size)
        self.trunk = nn.ModuleList(_relu_layers([inputs, *[width] * depth, 1 + width]))
        self.head = nn.ModuleList(_relu_layers([width + encoded_size(3, view_frequencies), width // 2, 3]))

    def forward(self, inverted: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``(...,)`` ≥ 0 per unit of length, and colour ``(..., 3)`` in [0, 1].

        ``inverted`` ``(..., 4)`` is from `volume.weights.invert_outside`; ``direction`` ``(..., 3)`` are unit vectors.
        """
        inputs = encode(inverted, self.point_frequencies)
        if self.grid is not None:
            contracted = (2 - inverted[..., 3:]) * inverted[..., :3]
            inputs = torch.cat((inputs, self.grid(contracted)), dim=-1)
        hidden = _relu_network(inputs, self.trunk)
        density = nn.functional.softplus(hidden[..., 0] - 1)
        seen = _relu_network(torch.cat((hidden[..., 1:], encode(direction, self.view_frequencies)), dim=-1), self.head)
        return density, seen.sigmoid()


@dataclass(frozen=True, eq=False)
class Radiance:
    """All that `render_volume` needs beside a geometry."""

    color: ViewColor  # of the surface, by direction
    outside: Outside | None  # field outside the unit sphere, or None
    background: Tensor  # (3,) display RGB in [0, 1] behind everything
    inv_std: float  # s of NeuS; 1/s is the uncertainty of the surface


def _relu_layers(sizes: list[int]) -> list[nn.Linear]:
    """Layers initialised for ReLU (He et al. 2015), biases 0; the last one small, so that colours begin grey."""
    layers = [nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
    with torch.no_grad():
        for layer in layers:
            layer.weight.normal_(0, math.sqrt(2 / layer.in_features))
            layer.bias.zero_()
        layers[-1].weight.mul_(0.1)
    return layers


def _relu_network(h: Tensor, layers: nn.ModuleList) -> Tensor:
    *hidden, last = layers
    for layer in hidden:
        h = layer(h).relu_()
    return last(h)
