"""Binary glTF files, read without any library."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

KINDS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def read_glb(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The header, and the array ``(count, width)`` of every accessor, within the bounds that the file states."""
    header, body = glb_parts(path)
    arrays = []
    for accessor in header["accessors"]:
        part = view_of(header, body, accessor["bufferView"])
        array = np.frombuffer(part, KINDS[accessor["componentType"]])
        arrays.append(array.reshape(accessor["count"], WIDTHS[accessor["type"]]))
        for bound, of in (("min", np.min), ("max", np.max)):
            if bound in accessor:
                np.testing.assert_array_equal(accessor[bound], of(arrays[-1], axis=0))
    return header, arrays


def glb_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The header, and the bytes that its buffer views are of."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    (length,) = struct.unpack("<I", data[12:16])
    assert length % 4 == 0
    header, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert header["buffers"][0]["byteLength"] == len(body)
    assert all(view["byteOffset"] % 4 == 0 for view in header["bufferViews"])
    return header, body


def view_of(header: dict[str, Any], body: bytes, index: int) -> bytes:
    view = header["bufferViews"][index]
    return body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def attribute(path: Path, name: str) -> np.ndarray:
    """An attribute of the vertices of the only mesh, as it stands in the file."""
    header, arrays = read_glb(path)
    return arrays[header["meshes"][0]["primitives"][0]["attributes"][name]]
