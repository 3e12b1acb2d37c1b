"""GLTF 2.0 and GLB (Khronos, "glTF 2.0 Specification"): triangles, base colours and textures, placed by the nodes.

Files written by this package are read in the input coordinates that their node holds. trimesh rounds base colours to 8
bits of linear light, and loses the wrapping of textures and KHR_texture_transform. Skins, morph targets and sparse
accessors are refused.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...neural_fields import InputError
from ...neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from ...neural_fields.meshing.glb import GENERATOR
from ..clouds.readers.meshes import strips, triangulate
from .mesh import Float64, Int64, Paint, TexturedMesh, Wrap, decode_texture, pack

_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Extensions that a file may require: those that are read, and those that change the look only.
_KNOWN = ("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_materials_", "KHR_lights_punctual")


class _Piece(NamedTuple):
    """One primitive of one node, in scene coordinates; colours are linear, v points down."""

    vertices: Float64
    faces: Int64
    uv: Float64
    colors: Float64 | None
    paint: int


def read_gltf(path: Path, *, textures: bool = True) -> TexturedMesh:
    """All triangles of the scene of a GLB or glTF file, vertices in the order of the file.

    Without ``textures``, images and base colours are not read.
    """
    try:
        document = _Document.load(path)
        needed = [name for name in document.header.get("extensionsRequired", ()) if not name.startswith(_KNOWN)]
        needed += [name for name in document.header.get("extensionsUsed", ()) if name == "EXT_mesh_gpu_instancing"]
        if needed:
            raise InputError(f"{path}: the extension {needed[0]} is not read; export it without (or uncompressed)")
        materials: dict[str, Paint] = {}
        mesh = _joined(list(_pieces(document, materials, textures=textures)), list(materials.values()), str(path))
    except InputError:
        raise
    except (AttributeError, ValueError, KeyError, IndexError, TypeError, RecursionError, struct.error) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        kind = path.suffix[1:].upper()
        raise InputError(f"{path}: cannot be read as a {kind} mesh ({reason}); export it again") from error
    return mesh


@dataclass(frozen=True)
class _Document:
    """The JSON part of a file, and the binary chunk of a GLB."""

    path: Path
    header: dict[str, Any]
    chunk: bytes

    @classmethod
    def load(cls, path: Path) -> _Document:
        data = path.read_bytes()
        older = InputError(f"{path}: glTF 1 is not read; export it as glTF 2")
        if data[:4] != b"glTF":
            header = json.loads(data)
            if isinstance(header.get("meshes"), dict):  # glTF 2 has a list
                raise older
            return cls(path, header, b"")
        if struct.unpack_from("<I", data, 4)[0] != 2:
            raise older
        whole, length = struct.unpack_from("<I", data, 8)[0], struct.unpack_from("<I", data, 12)[0]
        if len(data) < whole:
            raise InputError(f"{path}: is cut off after {len(data):,} of {whole:,} bytes; copy or export it again")
        return cls(path, json.loads(data[20 : 20 + length]), data[28 + length :])

    def buffer(self, number: int) -> bytes:
        uri = self.header["buffers"][number].get("uri")
        return self.chunk if uri is None else self.resource(uri, f"buffers[{number}]")

    def resource(self, uri: str, what: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        file = self.path.parent / unquote(uri)
        if not file.is_file():
            raise InputError(f"{self.path}: {what}: {file} is not there; put it beside the glTF file, or export a GLB")
        return file.read_bytes()

    def view(self, number: int) -> tuple[bytes, int]:
        """The bytes of a bufferView, and its stride (0: tight)."""
        view = self.header["bufferViews"][number]
        data, start, length = self.buffer(view["buffer"]), _whole(view, "byteOffset"), _whole(view, "byteLength")
        if start + length > len(data):
            raise ValueError(f"bufferViews[{number}] goes beyond the {len(data):,} bytes of its buffer")
        return data[start : start + length], _whole(view, "byteStride")

    def accessor(self, number: int) -> NDArray[Any]:
        """An accessor → ``(count, width)``; normalised integers become fractions."""
        accessor = self.header["accessors"][number]
        if "sparse" in accessor:
            raise InputError(f"{self.path}: accessors[{number}]: sparse accessors are not read; export it without them")
        if "bufferView" not in accessor:
            raise ValueError(f"accessors[{number}] has no numbers; are they compressed?")
        kind, width = np.dtype(_KINDS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        data, stride = self.view(accessor["bufferView"])
        strides = (stride or width * kind.itemsize, kind.itemsize)
        rows = np.ndarray((_whole(accessor, "count"), width), kind, data, _whole(accessor, "byteOffset"), strides)
        if kind.kind == "f" and not np.isfinite(rows).all():
            raise ValueError(f"accessors[{number}] has a number that is not finite")
        if accessor.get("normalized", False):
            return (rows / np.float64(np.iinfo(kind).max)).clip(-1, 1)
        return rows

    def image(self, number: int) -> NDArray[np.float32]:
        image = self.header["images"][number]
        if "bufferView" in image:
            data, _ = self.view(image["bufferView"])
        else:
            data = self.resource(image["uri"], f"images[{number}]")
        try:
            return decode_texture(data)
        except ValueError as error:
            raise InputError(f"{self.path}: images[{number}]: {error}; export it with PNG or JPEG images") from error


def _whole(record: dict[str, Any], name: str) -> int:
    """A number of bytes or rows, by default 0."""
    value = record.get(name, 0)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name}: {value!r} is no whole number")
    return value


def _finite(numbers: object, name: str) -> Float64:
    found = np.array(numbers, np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{name} has a number that is not finite")
    return found


def _pieces(document: _Document, materials: dict[str, Paint], *, textures: bool) -> Iterator[_Piece]:
    """All triangle primitives; their materials are added to ``materials``."""
    header = document.header
    nodes = header.get("nodes", [])
    roots = range(len(nodes))
    if header.get("scenes"):
        roots = header["scenes"][header.get("scene", 0)].get("nodes", [])
    ours = header.get("asset", {}).get("generator") == GENERATOR
    open_nodes = [(root, np.eye(4)) for root in roots]
    places: dict[int, Float64] = {}  # of nodes
    while open_nodes:
        number, parent = open_nodes.pop(0)
        if number in places:
            raise ValueError("a node is its own ancestor, or has two parents")
        places[number] = parent @ _transform(nodes[number], ours=ours)
        open_nodes += [(child, places[number]) for child in nodes[number].get("children", [])]
    for number, placed in places.items():
        node = nodes[number]
        if "mesh" not in node:
            continue
        mesh = header["meshes"][node["mesh"]]
        if "skin" in node or np.any(node.get("weights", mesh.get("weights", []))):
            fix = "apply them, and export the mesh alone"
            raise InputError(f"{document.path}: nodes[{number}]: skins and morph targets are not read; {fix}")
        for primitive in mesh["primitives"]:
            if _TRIANGLES <= primitive.get("mode", _TRIANGLES) <= _FAN and "POSITION" in primitive["attributes"]:
                yield _piece(document, primitive, placed, materials, textures=textures)


def _transform(node: dict[str, Any], *, ours: bool) -> Float64:
    if "matrix" in node:
        return _finite(node["matrix"], "matrix").reshape(4, 4).T
    placed = np.eye(4)
    if ours and "origin" in node.get("extras", {}):  # of the positions, in input coordinates
        placed[:3, 3] = _finite(node["extras"]["origin"], "origin")
        return placed
    turned = Rotation.from_quat(_finite(node.get("rotation", (0, 0, 0, 1)), "rotation")).as_matrix()
    placed[:3, :3] = turned * _finite(node.get("scale", (1, 1, 1)), "scale")
    placed[:3, 3] = _finite(node.get("translation", (0, 0, 0)), "translation")
    return placed


def _piece(
    document: _Document, primitive: dict[str, Any], placed: Float64, materials: dict[str, Paint], *, textures: bool
) -> _Piece:
    attributes = primitive["attributes"]
    vertices = document.accessor(attributes["POSITION"]).astype(np.float64) @ placed[:3, :3].T + placed[:3, 3]
    count = len(vertices)
    order = np.arange(count)
    if "indices" in primitive:
        order = document.accessor(primitive["indices"])[:, 0].astype(np.int64)
    faces = _triangles(order, primitive.get("mode", _TRIANGLES))
    if len(faces) and faces.max() >= count:
        raise ValueError(f"a face names vertex {faces.max()}, but there are only {count}")
    if np.linalg.det(placed[:3, :3]) < 0:  # a mirrored node shows the other side of its triangles
        faces = faces[:, ::-1]
    colors = None
    if "COLOR_0" in attributes:
        colors = document.accessor(attributes["COLOR_0"])[:, :3].astype(np.float64).clip(0, 1)
    uv = np.zeros((count, 2))
    key, paint = "", Paint(np.ones((1, 1, 3), np.float32))
    if textures and "material" in primitive:
        material = _base_color(document.header["materials"][primitive["material"]])
        if (info := material.get("baseColorTexture")) is not None:
            uv = _texture_coordinates(document, attributes, info)
        key = json.dumps([info, material.get("baseColorFactor")])
        paint = materials[key] if key in materials else _paint(document, material)
    materials.setdefault(key, paint)
    return _Piece(vertices, faces, uv, colors, list(materials).index(key))


def _base_color(material: dict[str, Any]) -> dict[str, Any]:
    """Base colour and its texture; of older materials (KHR_materials_pbrSpecularGlossiness), the diffuse ones."""
    older = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if older is None or "pbrMetallicRoughness" in material:
        return material.get("pbrMetallicRoughness", {})
    names = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    return {new: older[old] for old, new in names.items() if old in older}


def _triangles(order: Int64, mode: int) -> Int64:
    if mode == _TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    return (strips if mode == _STRIP else triangulate)(np.array([len(order)]), order)


def _texture_coordinates(document: _Document, attributes: dict[str, int], info: dict[str, Any]) -> Float64:
    """Texture coordinates of the vertices, moved by KHR_texture_transform."""
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{moved.get('texCoord', info.get('texCoord', 0))}"
    if name not in attributes:
        raise ValueError(f"{name} is missing, which its texture needs")
    uv = document.accessor(attributes[name]).astype(np.float64)
    angle = _finite(moved.get("rotation", 0.0), "rotation")
    cos, sin = np.cos(angle), np.sin(angle)
    turned = (uv * _finite(moved.get("scale", (1, 1)), "scale")) @ np.array([[cos, -sin], [sin, cos]])
    return turned + _finite(moved.get("offset", (0, 0)), "offset")


def _paint(document: _Document, material: dict[str, Any]) -> Paint:
    """The base colour of a material: its texture (display) times its factor (linear)."""
    factor = _finite(material.get("baseColorFactor", (1, 1, 1, 1))[:3], "baseColorFactor").astype(np.float32)
    info = material.get("baseColorTexture")
    if info is None and (factor == 1).all():
        return Paint(np.ones((1, 1, 3), np.float32))  # exactly 1, which `_joined` looks for
    if info is None:
        return Paint(linear_to_srgb(factor.reshape(1, 1, 3)))
    texture = document.header["textures"][info["index"]]
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    image = document.image(webp.get("source", texture.get("source")))
    if (factor != 1).any():
        image = linear_to_srgb(srgb_to_linear(image) * factor)
    sampler = document.header["samplers"][texture["sampler"]] if "sampler" in texture else {}
    return Paint(image, (_WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)]))


def _joined(pieces: list[_Piece], paints: list[Paint], source: str) -> TexturedMesh:
    if not sum(len(piece.faces) for piece in pieces):
        raise InputError(f"{source}: meshes: no triangles in it; export a mesh")
    first = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, first, strict=False)])
    uv = np.concatenate([piece.uv[piece.faces] for piece in pieces])
    uv[..., 1] = 1 - uv[..., 1]
    colors = None
    if any(piece.colors is not None for piece in pieces):
        light = [np.ones_like(piece.vertices) if piece.colors is None else piece.colors for piece in pieces]
        colors = linear_to_srgb(np.concatenate(light)).astype(np.float32)
    if all((paint.image == 1).all() for paint in paints):  # white only: no texture
        return TexturedMesh(vertices, faces, None, None, colors, source)
    chosen = np.repeat([piece.paint for piece in pieces], [len(piece.faces) for piece in pieces])
    image, parts = pack(paints, chosen)
    return TexturedMesh(vertices, faces, uv, image, colors, source, parts)
