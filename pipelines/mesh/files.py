"""Meshes out: PLY, OBJ, STL and GLB, in input coordinates, complete or not at all.

Textured meshes out: GLB with its images in it, or OBJ with MTL and PNG files; all of it or nothing.

GLB, the binary form of glTF 2.0: one mesh, one material and its images in one file; the mesh may move.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets import srgb_to_linear
from ...neural_fields import InputError, Similarity
from ...neural_fields.files import whole_file
from ...neural_fields.meshing import Mesh
from .atlas import Unwrapped, check_unwrap_tools

__all__ = [
    "Motion",
    "check_mesh_path",
    "check_textured_path",
    "glb_origin",
    "needs_doubles",
    "write_glb",
    "write_mesh",
    "write_textured",
]

# float32 rounds a coordinate c by up to 6e-8 |c|. Up to this many scales from the origin that is less than a
# hundredth of a cell at 2048³.
FLOAT32_REACH = 128.0
TEXT_ROWS = 1 << 16


def check_mesh_path(path: str | Path, similarity: Similarity | None = None, *, new_folder: bool = False) -> Path:
    """Whether a mesh can be written to ``path``, to be asked before any long work.

    Args:
        path: the file to be; an existing file would be replaced.
        similarity: that of the field, where it is known already.
        new_folder: whether its folder will be made before the mesh, so that it need not be there yet.

    Raises:
        InputError: the extension is unknown or cannot hold the coordinates, the folder does not exist or may not
            be written, or ``path`` is a folder.
    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        known = ", ".join(_WRITERS)
        raise InputError(f"{path}: unknown mesh format {path.suffix or '(no extension)'!r}; use one of {known}")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file in it")
    if not new_folder and not path.absolute().parent.is_dir():
        raise InputError(f"{path}: the folder {path.absolute().parent} does not exist; make it first")
    if not new_folder and not os.access(path.absolute().parent, os.W_OK):
        raise InputError(f"{path}: the folder {path.absolute().parent} may not be written; choose another")
    if path.suffix.lower() == ".stl" and similarity is not None and needs_doubles(similarity):
        center = ", ".join(f"{c:.0f}" for c in similarity.center)
        raise InputError(f"{path}: STL keeps seven digits, too few so far from the origin ({center}); use .ply or .obj")
    return path


def needs_doubles(similarity: Similarity) -> bool:
    """Whether the coordinates are so far from the origin, as map coordinates are, that float32 would spoil them."""
    return max(abs(c) for c in similarity.center) > FLOAT32_REACH * similarity.scale


def write_mesh(path: str | Path, mesh: Mesh, similarity: Similarity | None = None) -> None:
    """Write ``mesh``, moved to input coordinates by ``similarity``; the extension chooses the format.

    PLY is binary, with double coordinates where float would spoil them (see `needs_doubles`), normals and
    colours; OBJ has normals and colours; STL (binary) neither. Colours are display numbers in PLY and OBJ, linear
    light in GLB. GLB is float32 by its standard: far from the
    origin it holds coordinates relative to ``similarity.center``, which becomes the translation of its node
    and is repeated in the node's ``extras``. The file appears under its name only when it is complete.

    Raises:
        InputError: see `check_mesh_path`; or the disk is full.
    """
    similarity = similarity or Similarity.identity()
    path = check_mesh_path(path, similarity)
    with whole_file(path) as partial:
        _WRITERS[path.suffix.lower()](partial, mesh, similarity)


def _bytes(colors: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)


def _write_ply(path: Path, mesh: Mesh, similarity: Similarity) -> None:
    kind = "<f8" if needs_doubles(similarity) else "<f4"
    columns = [(name, kind, column) for name, column in zip("xyz", similarity.to_input(mesh.vertices).T, strict=True)]
    if mesh.normals is not None:
        columns += [(name, "<f4", n) for name, n in zip(("nx", "ny", "nz"), mesh.normals.T, strict=True)]
    if mesh.colors is not None:
        columns += [(name, "u1", c) for name, c in zip(("red", "green", "blue"), _bytes(mesh.colors).T, strict=True)]
    vertices = np.empty(len(mesh.vertices), [(name, kind) for name, kind, _ in columns])
    for name, _, column in columns:
        vertices[name] = column
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    names = {"<f8": "double", "<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment mplicits", f"element vertex {len(vertices)}"]
    header += [f"property {names[kind]} {name}" for name, kind, _ in columns]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(vertices.data)
        file.write(faces.data)


def _write_obj(path: Path, mesh: Mesh, similarity: Similarity) -> None:
    digits = "%.15g" if needs_doubles(similarity) else "%.9g"
    vertices = similarity.to_input(mesh.vertices)
    line = "v " + " ".join([digits] * 3)
    if mesh.colors is not None:
        vertices = np.concatenate((vertices, mesh.colors), axis=1)
        line += " %.4g %.4g %.4g"
    faces, face = mesh.faces.astype(np.int64) + 1, "f %d %d %d\n"
    if mesh.normals is not None:
        faces, face = np.repeat(faces, 2, axis=1), "f %d//%d %d//%d %d//%d\n"
    with path.open("w", encoding="ascii") as file:
        file.write("# mplicits\n")
        blocks = [(line + "\n", vertices), (face, faces)]
        if mesh.normals is not None:
            blocks.insert(1, ("vn %.5f %.5f %.5f\n", mesh.normals))
        for template, rows in blocks:
            for start in range(0, len(rows), TEXT_ROWS):
                part = rows[start : start + TEXT_ROWS]
                file.write(template * len(part) % tuple(part.ravel().tolist()))


def _write_stl(path: Path, mesh: Mesh, similarity: Similarity) -> None:
    corners = similarity.to_input(mesh.vertices)[mesh.faces]  # (F, 3, 3)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(facing, axis=1, keepdims=True)
    faces = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    faces["normal"] = np.divide(facing, length, out=np.zeros_like(facing), where=length > 0)
    faces["corners"] = corners
    with path.open("wb") as file:
        file.write(b"mplicits".ljust(80) + len(faces).to_bytes(4, "little"))
        file.write(faces.data)


def _write_glb(path: Path, mesh: Mesh, similarity: Similarity) -> None:
    origin = glb_origin(similarity)
    attributes: dict[str, NDArray[Any]] = {"POSITION": (similarity.to_input(mesh.vertices) - origin).astype("<f4")}
    if mesh.normals is not None:
        attributes["NORMAL"] = mesh.normals.astype("<f4")
    if mesh.colors is not None:
        # COLOR_0 is linear by the standard; in 8 bits that would merge dark shades.
        opaque = np.full((len(mesh.colors), 4), 65535, "<u2")  # four channels keep rows aligned to four bytes
        opaque[:, :3] = np.rint(srgb_to_linear(np.clip(mesh.colors, 0, 1)) * 65535)
        attributes["COLOR_0"] = opaque
    material = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}
    write_glb(path, mesh.faces, attributes, material=material, origin=origin)


def glb_origin(similarity: Similarity) -> tuple[float, float, float]:
    """What the positions of a GLB file are relative to: far away, the centre, so that float32 suffices for them."""
    return similarity.center if needs_doubles(similarity) else (0.0, 0.0, 0.0)


_WRITERS: dict[str, Callable[[Path, Mesh, Similarity], None]] = {
    ".ply": _write_ply,
    ".obj": _write_obj,
    ".stl": _write_stl,
    ".glb": _write_glb,
}


Image = NDArray[np.uint8]

ROUGHNESS = 0.8


def check_textured_path(path: str | Path, similarity: Similarity | None = None) -> Path:
    """Whether a textured mesh can be made and written to ``path``, to be asked before any long work.

    Raises:
        InputError: the format holds no texture, the place may not be written, or ``mplicits[texture]`` is missing.
    """
    path = Path(path)
    if path.suffix.lower() not in (".glb", ".obj"):
        raise InputError(f"{path}: textures are written as .glb or .obj; choose one of them, or leave --texture out")
    check_unwrap_tools()
    return check_mesh_path(path, similarity)


def write_textured(
    path: str | Path, mesh: Unwrapped, similarity: Similarity, *, color: Image | None, normal: Image | None
) -> None:
    """Write ``mesh``, moved to input coordinates by ``similarity``, with its images.

    ``shape.glb`` is one file, with tangents. Beside ``shape.obj`` there are ``shape.mtl``, ``shape_color.png`` and
    ``shape_normal.png``. The files appear under their names only when all of them are complete.

    Args:
        path: the .glb or .obj file.
        mesh: in unit-sphere coordinates.
        similarity: from there to input coordinates. Far from the origin, positions in a GLB are relative to its
            centre, which becomes the translation of the node.
        color: ``(H, W, 3)`` display RGB, or None.
        normal: ``(H, W, 3)`` tangent-space normals, +y upwards, or None.

    Raises:
        InputError: see `check_textured_path`; or the disk is full.
    """
    path = check_textured_path(path, similarity)
    images = {name: image for name, image in (("color", color), ("normal", normal)) if image is not None}
    if path.suffix.lower() == ".glb":
        _write_together({path: lambda file: _write_textured_glb(file, mesh, similarity, images)})
        return
    files = {name: path.with_name(f"{path.stem}_{name}.png") for name in images}
    library = path.with_suffix(".mtl")
    writers: dict[Path, Callable[[Path], object]] = {
        path: lambda file: _write_textured_obj(file, mesh, similarity, library.name),
        library: lambda file: file.write_text(_mtl(files), encoding="utf-8"),
    }
    for name, image in images.items():
        writers[files[name]] = lambda file, image=image: file.write_bytes(_png(image))
    _write_together(writers)


def _write_together(writers: Mapping[Path, Callable[[Path], object]]) -> None:
    """Write temporary files; when all are there, they get their names, and last the first, which refers to them."""
    with ExitStack() as stack:
        for path, write in writers.items():
            write(stack.enter_context(whole_file(path)))


def _png(image: Image) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def _write_textured_glb(path: Path, mesh: Unwrapped, similarity: Similarity, images: Mapping[str, Image]) -> None:
    origin = glb_origin(similarity)
    attributes = {
        "POSITION": (similarity.to_input(mesh.vertices) - origin).astype("<f4"),
        "NORMAL": mesh.normals.astype("<f4"),
        "TANGENT": mesh.tangents.astype("<f4"),
        "TEXCOORD_0": (mesh.uv * (1, -1) + (0, 1)).astype("<f4"),  # v runs down in glTF
    }
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": ROUGHNESS}
    material: dict[str, Any] = {"name": "baked", "pbrMetallicRoughness": surface}
    texture = {name: {"index": number} for number, name in enumerate(images)}
    if "color" in texture:
        surface["baseColorTexture"] = texture["color"]
    if "normal" in texture:
        material["normalTexture"] = texture["normal"]
    data = [_png(image) for image in images.values()]
    write_glb(path, mesh.faces, attributes, material=material, images=data, origin=origin)


def _mtl(files: Mapping[str, Path]) -> str:
    lines = ["# mplicits", "newmtl baked", "Kd 1 1 1", "Ks 0 0 0", "illum 1"]
    if "color" in files:
        lines.append(f"map_Kd {files['color'].name}")
    if "normal" in files:
        # Not map_Bump: most programs take that for heights, and Blender takes its image for display colours.
        lines.append(f"norm {files['normal'].name}")
    return "\n".join(lines) + "\n"


def _write_textured_obj(path: Path, mesh: Unwrapped, similarity: Similarity, library: str) -> None:
    digits = "%.15g" if needs_doubles(similarity) else "%.9g"
    corners = np.repeat(mesh.faces + 1, 3, axis=1)  # the same index for v, vt and vn
    blocks = [
        ("v " + " ".join([digits] * 3), similarity.to_input(mesh.vertices)),
        ("vt %.7f %.7f", mesh.uv),
        ("vn %.5f %.5f %.5f", mesh.normals),
        ("f %d/%d/%d %d/%d/%d %d/%d/%d", corners),
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write(f"# mplicits\nmtllib {library}\nusemtl baked\n")
        for template, rows in blocks:
            for start in range(0, len(rows), TEXT_ROWS):
                part = rows[start : start + TEXT_ROWS]
                file.write((template + "\n") * len(part) % tuple(part.ravel().tolist()))


_COMPONENTS = {"<u2": 5123, "<u4": 5125, "<f4": 5126}
_SHAPES = ("SCALAR", "SCALAR", "VEC2", "VEC3", "VEC4")
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
# Trilinear filtering; beyond its sides a texture repeats its border.
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}


@dataclass(frozen=True, eq=False)
class Motion:
    """How a mesh moves: morph targets, one for each frame after the first, faded into one another.

    Attributes:
        times: ``(T,)`` seconds, increasing from 0.
        targets: ``T − 1`` frames, each with the same names of attributes: by how much they differ from the mesh.
    """

    times: NDArray[np.floating]
    targets: Sequence[Mapping[str, NDArray[Any]]]

    def weights(self) -> NDArray[np.float32]:
        """``(T, T − 1)``: at each time, how much of each target; in between they are interpolated."""
        return np.eye(len(self.times), dtype="<f4")[:, 1:]


def write_glb(
    path: Path,
    faces: NDArray[np.integer],
    attributes: Mapping[str, NDArray[Any]],
    *,
    material: Mapping[str, Any],
    images: Sequence[bytes] = (),
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    motion: Motion | None = None,
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
        motion: of the attributes, played by an animation.
    """
    arrays = [faces.astype("<u4").reshape(-1), *attributes.values()]
    still = len(arrays)
    if motion is not None:
        arrays += [array for target in motion.targets for array in target.values()]
    shaped = len(arrays)
    if motion is not None:
        arrays += [motion.times.astype("<f4"), motion.weights().reshape(-1)]
    chunks = [*(array.tobytes() for array in arrays), *images]
    sizes = np.array([len(chunk) for chunk in chunks])
    ends = np.cumsum((sizes + 3) // 4 * 4)  # each array starts at a multiple of four bytes
    starts = [0, *ends[:-1].tolist()]
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": int(size)} for start, size in zip(starts, sizes, strict=True)
    ]
    for number, view in enumerate(views[:shaped]):
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
    header["accessors"][1 + list(attributes).index("POSITION")] |= _bounds(attributes["POSITION"])
    if motion is not None:
        _add_motion(header, motion, still, shaped)
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


def _add_motion(header: dict[str, Any], motion: Motion, first: int, times: int) -> None:
    """Describe a motion whose arrays begin at the accessor ``first``, and whose times are the accessor ``times``."""
    described, accessor = [], first
    for target in motion.targets:
        described.append({name: accessor + k for k, name in enumerate(target)})
        header["accessors"][described[-1]["POSITION"]] |= _bounds(target["POSITION"])
        accessor += len(target)
    header["accessors"][times] |= _bounds(motion.times.astype("<f4")[:, None])
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
