"""Meshes out: PLY, OBJ, STL and GLB, in input coordinates, complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import srgb_to_linear
from ..neural_fields import InputError, Similarity
from ..neural_fields.files import whole_file
from ..neural_fields.meshing import Mesh
from .glb import write_glb

__all__ = ["check_mesh_path", "glb_origin", "needs_doubles", "write_mesh"]

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
