"""From a field to the numbers that the page's shaders want, and to what rounding them has cost.

The page counts phases in turns: with W and b divided by 2π a sine layer is sin 2π(W h + b), and whole turns, which
change nothing, are taken off before any sine. So it does not matter how good a GPU's own sine is far from 0.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import Field, MultiscaleSDF, Siren
from ...neural_fields.networks.multiscale import levels_of

__all__ = [
    "Layer",
    "Rounding",
    "network_layers",
    "rounded_field",
    "rounding_error",
    "shader_levels",
    "taper_of",
]

TURN = 2 * math.pi


@dataclass(frozen=True)
class Layer:
    """One layer of a network, as the page gets it.

    Attributes:
        weight: ``(out, in)`` float32; of a sine layer in turns.
        bias: ``(out,)`` float32, likewise.
        codes: ``(out, in)`` int32 in [−2^(bits−1) + 1, 2^(bits−1) − 1] if the weights are rounded, else None.
        scale: ``(out,)`` float32; a rounded weight is its code times the scale of its row.
        rate: ``(out,)`` float32, of the first layer of a network that moves: how fast its bias grows with time.
    """

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    codes: NDArray[np.int32] | None = None
    scale: NDArray[np.float32] | None = None
    rate: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Rounding:
    """What rounding the weights has changed at the points of a surface, of one level.

    Attributes:
        value: greatest change of the distance, in units of the field.
        angle: greatest turn of a normal, in degrees.
    """

    value: float
    angle: float


def shader_levels(field: Field) -> list[Siren] | None:
    """The networks of a field's levels, coarse to fine; None if a level is no SIREN, which no shader traces."""
    levels = levels_of(field)
    networks = [level for level in levels if isinstance(level, Siren)]
    return networks if len(networks) == len(levels) else None


def network_layers(network: Siren, bits: int | None, *, channels: int = 1) -> list[Layer]:
    """The layers of a network, sine layers in turns, the output last.

    Weights between sine layers, nearly all there are, are rounded to ``bits`` bits: code times the scale of its row.
    First layer, output and biases stay as they are.

    Args:
        network: which; of one in space and time, the first layer's weights of time become its `Layer.rate`.
        bits: of a rounded weight; None rounds none.
        channels: outputs that the page asks for.
    """
    numbers = [part.detach().cpu().double().numpy() for part in network.folded()]
    pairs = list(zip(numbers[0::2], numbers[1::2], strict=True))
    layers: list[Layer] = []
    for index, (weight, bias) in enumerate(pairs[:-1]):
        turns = weight / TURN
        if not index and network.in_dim == 4:
            first = _layer(turns[:, :3], bias / TURN, None)
            layers.append(dataclasses.replace(first, rate=turns[:, 3].astype(np.float32)))
        else:
            layers.append(_layer(turns, bias / TURN, bits if index else None))
    weight, bias = pairs[-1]
    return [*layers, _layer(weight[:channels], bias[:channels], None)]


def _layer(weight: NDArray[np.float64], bias: NDArray[np.float64], bits: int | None) -> Layer:
    if bits is None:
        return Layer(weight.astype(np.float32), bias.astype(np.float32))
    most = 2 ** (bits - 1) - 1
    scale = (np.abs(weight).max(axis=1) / most).astype(np.float32)
    scale[scale == 0] = 1
    codes = np.rint(weight / scale[:, None]).clip(-most, most).astype(np.int32)
    return Layer((codes * scale[:, None]).astype(np.float32), bias.astype(np.float32), codes, scale)


@torch.no_grad()
def rounded_field(field: Field, bits: int) -> Field:
    """A copy of a field with the weights that a page of ``bits`` bits has; on its device, in its precision."""
    rounded = copy.deepcopy(field)
    for network in shader_levels(rounded) or []:
        frequency = network.omega * network.units[0] / TURN
        for linear, layer in zip(network.layers, network_layers(network, bits), strict=False):
            assert isinstance(linear, torch.nn.Linear)
            if layer.codes is not None:
                linear.weight.copy_(torch.from_numpy(layer.weight) / frequency)
    return rounded


@torch.no_grad()
def rounding_error(field: Field, bits: int, points: NDArray[np.floating]) -> list[Rounding]:
    """What rounding to ``bits`` bits changes at ``points`` ``(N, 3)``, for each level."""
    rounded = rounded_field(field, bits)
    x = torch.from_numpy(np.asarray(points)).to(field.like)
    found = []
    for level in range(field.num_levels):
        before, after = field.jet(x, level=level), rounded.jet(x, level=level)
        normals = [torch.nn.functional.normalize(jet.gradient.double(), dim=-1) for jet in (before, after)]
        chord = (normals[0] - normals[1]).norm(dim=-1).max() / 2
        angle = math.degrees(2 * math.asin(min(1.0, float(chord))))
        found.append(Rounding(float((before.value - after.value).abs().max()), angle))
    return found


def taper_of(field: Field) -> float:
    """The share of a band over which its gate closes; 0 for a field without bands."""
    return field.taper if isinstance(field, MultiscaleSDF) else 0.0
