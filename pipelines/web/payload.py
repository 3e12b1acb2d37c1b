"""What the page carries of a run: one block of bytes and a description of what is where in it."""

from __future__ import annotations

import copy
import dataclasses
import math
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import Field, Siren
from ...neural_fields.networks.multiscale import levels_of

TURN = 2 * math.pi


@dataclass(frozen=True)
class Layer:
    """One layer of a network, as the page gets it.

    Attributes:
        weight: ``(out, in)``; of a sine layer in turns, as ``bias`` ``(out,)``.
        codes: ``(out, in)`` in [−2^(bits−1) + 1, 2^(bits−1) − 1] if the weights are rounded, else None.
        scale: ``(out,)``; a rounded weight is its code times the scale of its row.
        rate: ``(out,)`` of the first layer of a network that moves: growth of its bias with time.
    """

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    codes: NDArray[np.int32] | None = None
    scale: NDArray[np.float32] | None = None
    rate: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Rounding:
    """The most that rounding has changed on a surface: distances in units of the field, normals in degrees."""

    value: float
    angle: float


def shader_levels(field: Field) -> list[Siren] | None:
    """The networks of a field's levels, coarse to fine; None if a level is no SIREN, which no shader traces."""
    levels = levels_of(field)
    networks = [level for level in levels if isinstance(level, Siren)]
    return networks if len(networks) == len(levels) else None


def network_layers(network: Siren, bits: int | None, *, channels: int = 1) -> list[Layer]:
    """The layers of a network, sine layers in turns; the output, with ``channels`` rows kept, is last.

    Weights between sine layers, nearly all there are, are rounded to ``bits`` bits (None: not at all): code times the
    scale of its row. First layer, output and biases stay. In space and time, weights of time become `Layer.rate`.
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


# What may stand in a block of data in a page: printable, and without " & <. A pair says 13 bits, as 91² > 2¹³.
LETTERS = np.array([code for code in range(33, 127) if chr(code) not in '"&<'], np.uint8)
PAIR, SINGLE = 13, 6  # bits


@dataclass
class Payload:
    """Named arrays one behind the other, each beginning at a multiple of four bytes, little-endian.

    ``blocks``: name → kind ("f4", "u2", "u4", or "i" or "d" and a number of bits), number of numbers, first byte.
    """

    blocks: dict[str, list[Any]] = field(default_factory=dict)
    parts: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, name: str, numbers: NDArray[Any], kind: str) -> None:
        """Append an array, without its shape, as "f4", "u2", "u4", or e.g. "i13": signed codes of 13 bits."""
        flat = np.ascontiguousarray(numbers).reshape(-1)
        data = pack_codes(flat, int(kind[1:])) if kind[0] == "i" else flat.astype(f"<{kind}").tobytes()
        data += b"\0" * (-len(data) % 4)
        self.blocks[name] = [kind, len(flat), self.size]
        self.parts.append(data)
        self.size += len(data)

    def add_steps(self, name: str, numbers: NDArray[Any]) -> None:
        """Append whole numbers by how each differs from the one before; the first from 0."""
        steps = np.diff(np.asarray(numbers).reshape(-1).astype(np.int64), prepend=0)
        bits = max(2, int(np.abs(steps).max(initial=0)).bit_length() + 1)
        self.add(name, steps, f"i{bits}")
        self.blocks[name][0] = f"d{bits}"

    def add_network(self, name: str, layers: list[Layer]) -> dict[str, Any]:
        """Append the layers of a network; returns what the page has to know: its name, width and depth."""
        for index, layer in enumerate(layers):
            key = f"{name}.{index}"
            self.add(f"{key}.bias", layer.bias, "f4")
            if layer.rate is not None:
                self.add(f"{key}.rate", layer.rate, "f4")
            if layer.codes is None or layer.scale is None:
                self.add(f"{key}.weight", layer.weight, "f4")
            else:
                bits = max(2, int(np.abs(layer.codes).max()).bit_length() + 1)
                self.add(f"{key}.scale", layer.scale, "f4")
                self.add(f"{key}.weight", layer.codes, f"i{bits}")
        return {"name": name, "width": layers[0].weight.shape[0], "depth": len(layers) - 1}

    def content(self) -> tuple[bytes, dict[str, Any]]:
        """All bytes, deflated; and for the header: the blocks, how many bytes there were, and their CRC-32."""
        data = b"".join(self.parts)
        return deflated(data), {"blocks": self.blocks, "bytes": len(data), "crc32": zlib.crc32(data)}


def deflated(data: bytes) -> bytes:
    """Bytes as a browser's ``DecompressionStream("deflate-raw")`` takes them."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def text_of(data: bytes) -> str:
    """Bytes as letters of a page: 16 for 13 bytes, where base64 takes 16 for 12.

    Groups of 13 bits, lowest first, become two of the 91 letters, the lower digit first. The last group is one letter
    if it has 6 bits or fewer, so the number of letters gives the number of bytes.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").astype(np.int64)
    rest = len(bits) % PAIR
    groups = np.pad(bits, (0, -len(bits) % PAIR)).reshape(-1, PAIR) @ (1 << np.arange(PAIR))
    digits = np.stack((groups % len(LETTERS), groups // len(LETTERS)), axis=1).reshape(-1)
    return LETTERS[digits[:-1] if 0 < rest <= SINGLE else digits].tobytes().decode("ascii")


def pack_codes(codes: NDArray[np.integer], bits: int) -> bytes:
    """Signed numbers ``(N,)`` in two's complement of ``bits`` bits, in two parts that deflate better than one.

    First the upper eight bits of each, or fewer if there are no more, then the lower ones, lowest bit first, without
    gaps.
    """
    whole = codes.astype(np.int64) & (2**bits - 1)
    low = max(0, bits - 8)
    places = (whole[:, None] >> np.arange(low)) & 1
    upper = (whole >> low).astype(np.uint8)
    return upper.tobytes() + np.packbits(places.astype(np.uint8).reshape(-1), bitorder="little").tobytes()
