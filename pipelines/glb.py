"""GLB, the binary form of glTF 2.0: one mesh, one material and its images in one file."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["write_glb"]

_COMPONENTS = {"<u2": 5123, "<u4": 5125, "<f4": 5126}
_SHAPES = ("SCALAR", "SCALAR", "VEC2", "VEC3", "VEC4")
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
# Trilinear filtering; beyond its sides a texture repeats its border.
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}


def write_glb(
    path: Path,
    faces: NDArray[np.integer],
    attributes: Mapping[str, NDArray[Any]],
    *,
    material: Mapping[str, Any],
    images: Sequence[bytes] = (),
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write a JSON chunk that describes the arrays of a second, binary chunk.

    Args:
        path: the file; replaced.
        faces: ``(F, 3)``.
        attributes: by glTF's names, POSITION among them, ``(V, 2 | 3 | 4)`` float32 each, or uint16 that stands for
            fractions of 65535.
        material: as glTF writes it; texture k is image k.
        images: PNG files.
        origin: translation of the node, repeated in its ``extras``: positions are relative to it.
    """
    arrays = [faces.astype("<u4").reshape(-1), *attributes.values()]
    chunks = [*(array.tobytes() for array in arrays), *images]
    sizes = np.array([len(chunk) for chunk in chunks])
    ends = np.cumsum((sizes + 3) // 4 * 4)  # each array starts at a multiple of four bytes
    starts = [0, *ends[:-1].tolist()]
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": int(size)} for start, size in zip(starts, sizes, strict=True)
    ]
    for number, view in enumerate(views[: len(arrays)]):
        view["target"] = _VERTEX_BUFFER if number else _INDEX_BUFFER
    place = {"translation": list(origin), "extras": {"origin": list(origin)}}
    primitive = {"attributes": {name: k for k, name in enumerate(attributes, start=1)}, "indices": 0, "material": 0}
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "mplicits"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "mesh", "mesh": 0, **place}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "buffers": [{"byteLength": int(ends[-1])}],
        "bufferViews": views,
        "accessors": [_accessor(k, array) for k, array in enumerate(arrays)],
    }
    positions = attributes["POSITION"]
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    header["accessors"][1 + list(attributes).index("POSITION")] |= bounds
    if images:
        header["images"] = [{"bufferView": len(arrays) + k, "mimeType": "image/png"} for k in range(len(images))]
        header["samplers"] = [_SAMPLER]
        header["textures"] = [{"source": k, "sampler": 0} for k in range(len(images))]
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + int(ends[-1])))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", int(ends[-1]), b"BIN\0"))
        for chunk in chunks:
            file.write(chunk + bytes(-len(chunk) % 4))


def _accessor(view: int, array: NDArray[Any]) -> dict[str, Any]:
    kind = array.dtype.newbyteorder("<").str
    shape = _SHAPES[array.shape[1] if array.ndim == 2 else 1]
    accessor = {"bufferView": view, "componentType": _COMPONENTS[kind], "count": len(array), "type": shape}
    return accessor | ({"normalized": True} if kind == "<u2" else {})
