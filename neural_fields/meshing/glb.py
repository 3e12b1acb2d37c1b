"""GLB, the binary form of glTF 2.0: one mesh, one material and its images in one file; the mesh may move."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

GENERATOR = "mplicits"

MATERIAL, ROUGHNESS = "baked", 0.8
_COMPONENTS = {"<u2": 5123, "<u4": 5125, "<f4": 5126}
_SHAPES = ("SCALAR", "SCALAR", "VEC2", "VEC3", "VEC4")
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
# Trilinear filtering; beyond its sides a texture repeats its border.
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}


class Motion(NamedTuple):
    """Times ``(T,)`` in seconds, and for each of the ``T − 1`` later frames its difference from the first."""

    times: NDArray[np.floating]
    targets: Sequence[Mapping[str, NDArray[Any]]]


# Not trimesh's writer: its COLOR_0 has 8 bits, it does not make colours linear, and it knows neither tangents nor morph
# targets, nor how a texture is filtered.
def write_glb(
    path: Path,
    faces: NDArray[np.integer],
    attributes: Mapping[str, NDArray[Any]],
    *,
    images: Mapping[str, bytes] | None = None,
    node: Mapping[str, Any] | None = None,
    motion: Motion | None = None,
) -> None:
    """Write a JSON chunk that describes the arrays of a second, binary chunk.

    Args:
        path: the file; replaced.
        faces: ``(F, 3)``.
        attributes: by glTF's names, POSITION among them, ``(V, 2 | 3 | 4)`` float32, or uint16 as fractions of 65535.
        images: PNG files of "color" and "normal", if any.
        node: placement of the mesh by glTF's names: translation, rotation, scale, extras.
        motion: of the attributes, played by an animation.
    """
    images = images or {}
    arrays = [faces.astype("<u4").reshape(-1), *attributes.values()]
    still = len(arrays)
    if motion is not None:
        arrays += [array for target in motion.targets for array in target.values()]
    shaped = len(arrays)
    if motion is not None:
        arrays += [motion.times, np.eye(len(motion.times), dtype="<f4")[:, 1:].reshape(-1)]
    chunks = [*(array.tobytes() for array in arrays), *images.values()]
    sizes = np.array([len(chunk) for chunk in chunks])
    ends = np.cumsum((sizes + 3) // 4 * 4)  # each array starts at a multiple of four bytes
    starts = [0, *ends[:-1].tolist()]
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": int(size)} for start, size in zip(starts, sizes, strict=True)
    ]
    for number, view in enumerate(views[:shaped]):
        view["target"] = _VERTEX_BUFFER if number else _INDEX_BUFFER
    primitive = {"attributes": {name: k for k, name in enumerate(attributes, start=1)}, "indices": 0, "material": 0}
    header: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "mesh", "mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(images)],
        "buffers": [{"byteLength": int(ends[-1])}],
        "bufferViews": views,
        "accessors": [_accessor(k, array) for k, array in enumerate(arrays)],
    }
    header["accessors"][1 + list(attributes).index("POSITION")] |= _bounds(attributes["POSITION"])
    if motion is not None:
        _add_motion(header, motion, still, shaped)
    if images:
        count = len(images)
        header["images"] = [{"bufferView": len(arrays) + k, "mimeType": "image/png"} for k in range(count)]
        header["samplers"] = [_SAMPLER]
        header["textures"] = [{"source": k, "sampler": 0} for k in range(count)]
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + int(ends[-1])))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", int(ends[-1]), b"BIN\0"))
        for chunk in chunks:
            file.write(chunk + bytes(-len(chunk) % 4))


def _add_motion(header: dict[str, Any], motion: Motion, first: int, times: int) -> None:
    """Describe a motion whose arrays begin at accessor ``first``, and whose times are accessor ``times``."""
    described, accessor = [], first
    for target in motion.targets:
        described.append({name: accessor + k for k, name in enumerate(target)})
        header["accessors"][described[-1]["POSITION"]] |= _bounds(target["POSITION"])
        accessor += len(target)
    header["accessors"][times] |= _bounds(motion.times[:, None])
    header["meshes"][0]["primitives"][0]["targets"] = described
    header["meshes"][0]["weights"] = [0.0] * len(motion.targets)
    sampler = {"input": times, "interpolation": "LINEAR", "output": times + 1}
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    header["animations"] = [{"name": "motion", "samplers": [sampler], "channels": [channel]}]


def _bounds(rows: NDArray[Any]) -> dict[str, list[float]]:
    return {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}


def _accessor(view: int, array: NDArray[Any]) -> dict[str, Any]:
    kind = array.dtype.newbyteorder("<").str
    shape = _SHAPES[array.shape[1] if array.ndim == 2 else 1]
    accessor = {"bufferView": view, "componentType": _COMPONENTS[kind], "count": len(array), "type": shape}
    return accessor | ({"normalized": True} if kind == "<u2" else {})


def _material(images: Mapping[str, bytes]) -> dict[str, Any]:
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": ROUGHNESS}
    material: dict[str, Any] = ({"name": MATERIAL} if images else {}) | {"pbrMetallicRoughness": surface}
    for number, name in enumerate(images):
        where = surface if name == "color" else material
        where["baseColorTexture" if name == "color" else "normalTexture"] = {"index": number}
    return material
