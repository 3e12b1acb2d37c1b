"""What the page carries of a run: one block of bytes and a description of what is where in it."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .networks import Layer

__all__ = ["Payload", "deflated", "pack_codes", "text_of"]

# What may stand in a block of data in a page: printable, and without " & <. A pair says 13 bits, as 91² > 2¹³.
LETTERS = np.array([code for code in range(33, 127) if chr(code) not in '"&<'], np.uint8)
PAIR, SINGLE = 13, 6  # bits


@dataclass
class Payload:
    """Named arrays one behind the other, each beginning at a multiple of four bytes, little-endian.

    Attributes:
        blocks: name → kind ("f4", "u2", "u4" or "i" or "d" and a number of bits), count of its numbers and first byte.
        parts: the bytes.
    """

    blocks: dict[str, list[Any]] = field(default_factory=dict)
    parts: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, name: str, numbers: NDArray[Any], kind: str) -> None:
        """Append an array; its shape is not kept.

        Args:
            name: of the block.
            numbers: any shape.
            kind: "f4", "u2", "u4", or e.g. "i13": signed codes of 13 bits, see `pack_codes`.
        """
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
        """Append the layers of a network.

        Returns:
            What the page has to know of it: its name, width and depth.
        """
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
    """Bytes as letters of a page: 16 in 13 bytes, where base64 takes 16 for 12.

    The bits, lowest of each byte first, go in groups of 13 into two of the 91 letters, the lower digit first. The last
    group is one letter if it has 6 bits or fewer, so that the number of letters tells the number of bytes.
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little").astype(np.int64)
    rest = len(bits) % PAIR
    groups = np.pad(bits, (0, -len(bits) % PAIR)).reshape(-1, PAIR) @ (1 << np.arange(PAIR))
    digits = np.stack((groups % len(LETTERS), groups // len(LETTERS)), axis=1).reshape(-1)
    return LETTERS[digits[:-1] if 0 < rest <= SINGLE else digits].tobytes().decode("ascii")


def pack_codes(codes: NDArray[np.integer], bits: int) -> bytes:
    """Signed numbers ``(N,)`` in two's complement of ``bits`` bits, in two parts that deflate better than one.

    First the upper eight bits of each, fewer if there are no more: small numbers are frequent, and these bits tell.
    Then the lower ones, lowest bit first, without gaps.
    """
    whole = codes.astype(np.int64) & (2**bits - 1)
    low = max(0, bits - 8)
    places = (whole[:, None] >> np.arange(low)) & 1
    upper = (whole >> low).astype(np.uint8)
    return upper.tobytes() + np.packbits(places.astype(np.uint8).reshape(-1), bitorder="little").tobytes()
