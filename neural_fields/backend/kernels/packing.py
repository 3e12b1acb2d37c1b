"""Weights of a SIREN as tensor cores take them, packed once for each change of the weights.

Phases are counted in turns: with M_i = (ω₀/2π) W_iᵀ and b_i likewise, layer i is h_i = sin 2π(h_{i−1} M_i + b_i). Every
hidden matrix is kept as the sum of two float16 matrices,

    S_i M_i ≈ H + L,   H = fp16(S_i M_i),   L = fp16(S_i M_i − H),

with S_i a power of two that brings its largest entry near `LARGEST_WEIGHT`. The factor is exact in both formats, and
keeps L above the smallest numbers of float16: |S_i M_i − H − L| ≤ max(2⁻²² |S_i M_i|, 2⁻²⁵).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

SINES = 1024.0  # factor of sines before they are split, a power of two: their low halves are normal numbers
LARGEST_WEIGHT = 16.0  # the largest entry of a scaled matrix lies in (LARGEST_WEIGHT / 2, LARGEST_WEIGHT]


class Shape(NamedTuple):
    """Compile-time shape of a network."""

    width: int  # units of a sine layer, padded with zeros to a multiple of an accumulator
    depth: int  # sine layers
    columns: int  # units of an accumulator, a power of two in 16 to 256
    piece: int  # inner units of one product, a power of two in 16 to 64
    rows: int  # points of a tile
    kept: bool  # whether a program that evaluates values keeps the hidden weights in shared memory

    @classmethod
    def of(cls, width: int, depth: int, *, hopper: bool = True) -> Shape:
        """One accumulator up to 128 units, or on Hopper 256; accumulators of 128 beyond.

        Only Hopper's products take their second operand from shared memory, and leave registers for 256 units. Above
        128 units the weights of a level do not stay in shared memory; twice as many points share them.
        """
        kept_width = 128  # two halves of such a matrix, 64 KiB, fit the shared memory of a program
        columns = max(16, 1 << (width - 1).bit_length())
        if columns > kept_width:
            columns = 256 if hopper and columns == 256 else 128
        padded = -(-width // columns) * columns
        rows = 128 if hopper and padded > kept_width else 64
        piece = 32 if columns == 256 else min(64, columns)
        return cls(padded, depth, columns, piece, rows, hopper and depth == 2 and padded <= kept_width)

    @property
    def direct(self) -> bool:
        """Whether no layer has to be kept in scratch."""
        return self.depth == 1 or (self.depth == 2 and self.width == self.columns)

    def scratch(self, rows: int, *, jet: bool) -> int:
        """Float16 numbers in a program's scratch for a tile of ``rows`` points."""
        if self.direct:
            return 0
        return 2 * rows * self.width * (2 + max(0, self.depth - 2) * jet)


class Packed(NamedTuple):
    """A SIREN for the kernels.

    ``floats`` are float32, in rows of ``shape.width``: of the first layer one for each coordinate and one of biases;
    the biases of the other sine layers; the output's weights, and these scaled for the sweep back. Then numbers: the
    output's bias, (2π)^depth, and of each hidden layer the factors of its products, there and back. Phases are in
    turns, the output's gain is included. ``halves``, float16 ``(depth − 1, 2, width, width)``, are H and L of each
    hidden layer; rows are inner units.
    """

    floats: Tensor
    halves: Tensor
    shape: Shape


@torch.no_grad()
def pack(parameters: Sequence[Tensor], omega: float, gain: float) -> Packed:
    """Pack a SIREN by a few dozen small operations on its device, without waiting.

    ``omega`` is ω₀ times the unit of the sine layers' parameters, ``gain`` the factor of the output.
    """
    turns = omega / (2 * math.pi)
    width = len(parameters[0])
    depth = len(parameters) // 2 - 1
    shape = Shape.of(width, depth, hopper=is_hopper(parameters[0].device))
    weights = [turns * weight.double().t() for weight in parameters[0:-2:2]]
    biases = [turns * bias.double() for bias in parameters[1:-2:2]]
    last = gain * parameters[-2][0].double()
    hidden = weights[1:]
    scales = [power_of_two(LARGEST_WEIGHT, matrix) for matrix in hidden]

    # The sweep back: s_d = w cos, s_i = (s_{i+1} M_{i+1}ᵀ) cos, each scaled by a bound on its largest entry.
    largest = 1024.0  # of a number of the sweep back, which is split as sines are
    bound, outer = last.abs(), power_of_two(largest, last)
    rows, back = [*weights[0], *biases, last, last * outer], []
    for index in range(depth - 2, -1, -1):
        factor = 1 / (scales[index] * outer)
        if index > 0:  # below the first hidden layer the gradient is summed in float32
            bound = hidden[index].abs() @ bound
            outer = power_of_two(largest, bound)
            factor = factor * outer
        back.insert(0, factor)
    numbers = [gain * parameters[-1][0].double(), last.new_full((), (2 * math.pi) ** depth)]
    numbers += [1 / (SINES * scale) for scale in scales] + back
    table = torch.zeros(len(rows), shape.width, dtype=torch.float64, device=last.device)
    table[:, :width] = torch.stack(rows)
    halves = torch.zeros(max(1, depth - 1), 2, shape.width, shape.width, dtype=torch.float16, device=last.device)
    for target, matrix, scale in zip(halves, hidden, scales, strict=False):
        scaled = matrix * scale
        high = scaled.half()
        target[0, :width, :width], target[1, :width, :width] = high, scaled - high.double()
    return Packed(torch.cat((table.flatten(), torch.stack(numbers))).float(), halves, shape)


@functools.cache
def is_hopper(device: torch.device) -> bool:
    """Whether a device has compute capability 9; true for the interpreter."""
    return device.type != "cuda" or torch.cuda.get_device_capability(device)[0] == 9


def power_of_two(target: float, like: Tensor) -> Tensor:
    """The power of two, as a tensor, that brings the largest |entry| of ``like`` to (target / 2, target]."""
    exponent = torch.floor(torch.log2(target / like.abs().max().clamp(min=1e-30)))
    return torch.exp2(exponent)


class Weights(Protocol):
    """Interface of a `Siren`: its parameters and their units."""

    omega: float
    units: tuple[float, float]

    def raw(self) -> list[Tensor]:
        """(W₁, b₁, …, W_out, b_out)."""
        ...


_kept: WeakKeyDictionary[Weights, tuple[tuple[object, ...], Packed]] = WeakKeyDictionary()


def state_of(network: Weights) -> tuple[object, ...]:
    """A key that differs whenever the weights may have changed."""
    parameters = network.raw()
    if any(parameter.is_inference() for parameter in parameters):  # nothing counts their changes
        return (object(),)
    return (network.omega, network.units, *((each.data_ptr(), each._version, each.device) for each in parameters))


def packed(network: Weights) -> Packed:
    """A SIREN's weights for the kernels; packed again, into the same memory, when they have changed.

    Changes are known by PyTorch's version counters. After changes through ``.data`` or CUDA graphs, call
    ``torch.autograd.graph.increment_version(parameters)``.
    """
    state, before = state_of(network), _kept.get(network)
    if before is not None and before[0] == state:
        return before[1]
    with torch.inference_mode(False):  # else the copies below would be refused outside of it
        made = pack(network.raw(), network.omega * network.units[0], network.units[1])
        if before is not None and before[1].shape == made.shape and before[1].floats.device == made.floats.device:
            before[1].floats.copy_(made.floats)
            before[1].halves.copy_(made.halves)
            made = before[1]
    _kept[network] = (state, made)
    return made
