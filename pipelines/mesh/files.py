"""Meshes out, in input coordinates, complete or not at all: PLY, OBJ, STL and GLB; with textures; and moving, as GLB.

`write_mesh` has colours at the vertices, `write_textured` in images (in a GLB, or beside an OBJ with its MTL), and
`write_moving` a mesh whose vertices move. All OBJ files are written by one function, and all GLB files by `write_glb`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...datasets import srgb_to_linear
from ...neural_fields import InputError, Similarity
from ...neural_fields.files import check_place, whole_file
from ...neural_fields.meshing import Mesh
from .atlas import Unwrapped, check_unwrap_tools
from .glb import MATERIAL, Motion, write_glb

__all__ = [
    "check_mesh_path",
    "check_textured_path",
    "needs_doubles",
    "write_mesh",
    "write_moving",
    "write_textured",
]

Image = NDArray[np.uint8]

# float32 rounds a coordinate c by up to 6e-8 |c|. Up to this many scales from the origin that is less than a
# hundredth of a cell at 2048³.
FLOAT32_REACH = 128.0
TEXT_ROWS = 1 << 16


def check_mesh_path(path: str | Path, similarity: Similarity | None = None) -> Path:
    """Whether a mesh can be written to ``path``, to be asked before any long work.

    Args:
        path: the file to be; an existing file would be replaced.
        similarity: that of the field, where it is known already.

    Raises:
        InputError: the extension is unknown or cannot hold the coordinates, ``path`` is a folder, or a file cannot
            come to be there (`check_place`).
    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        known = ", ".join(_WRITERS)
        raise InputError(f"{path}: unknown mesh format {path.suffix or '(no extension)'!r}; use one of {known}")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file in it")
    check_place(path)
    if path.suffix.lower() == ".stl" and similarity is not None and needs_doubles(similarity):
        center = ", ".join(f"{c:.0f}" for c in similarity.center)
        raise InputError(f"{path}: STL keeps seven digits, too few so far from the origin ({center}); use .ply or .obj")
    return path


def needs_doubles(similarity: Similarity) -> bool:
    """Whether the coordinates are so far from the origin, as map coordinates are, that float32 would spoil them."""
    return max(abs(c) for c in similarity.center) > FLOAT32_REACH * similarity.scale


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


def write_moving(
    path: Path,
    faces: NDArray[np.integer],
    vertices: Sequence[NDArray[np.floating]],
    normals: Sequence[NDArray[np.floating]],
    *,
    seconds: NDArray[np.floating],
    similarity: Similarity,
    colors: NDArray[np.floating] | None = None,
) -> None:
    """Write a GLB of one mesh whose vertices move: morph targets, one for each frame after the first, and an animation.

    Args:
        path: the .glb file; it appears under its name only when it is complete.
        faces: ``(F, 3)``, the same in all frames.
        vertices: ``(V, 3)`` in each of the T frames, in unit-sphere coordinates; in between they are interpolated.
        normals: ``(V, 3)`` likewise.
        seconds: ``(T,)`` when the frames are, increasing from 0.
        similarity: from unit-sphere to input coordinates.
        colors: ``(V, 3)`` display RGB in [0, 1], which stay.

    Raises:
        InputError: the disk is full.
    """
    first, *later = (
        _attributes(similarity, rows, normals=across) for rows, across in zip(vertices, normals, strict=True)
    )
    targets = [{name: target[name] - first[name] for name in first} for target in later]
    if colors is not None:
        first["COLOR_0"] = _linear_colors(colors)
    with whole_file(path) as partial:
        write_glb(partial, faces, first, origin=_glb_origin(similarity), motion=Motion(seconds.astype("<f4"), targets))


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
    images = {name: _png(image) for name, image in (("color", color), ("normal", normal)) if image is not None}
    if path.suffix.lower() == ".glb":
        attributes = _attributes(similarity, mesh.vertices, normals=mesh.normals, tangents=mesh.tangents, uv=mesh.uv)
        origin = _glb_origin(similarity)
        with whole_file(path) as partial:
            write_glb(partial, mesh.faces, attributes, images=images, origin=origin)
        return
    files = {name: path.with_name(f"{path.stem}_{name}.png") for name in images}
    library = path.with_suffix(".mtl")
    writers: dict[Path, Callable[[Path], object]] = {
        path: lambda file: _write_obj(
            file, similarity, mesh.vertices, mesh.faces, normals=mesh.normals, uv=mesh.uv, library=library.name
        ),
        library: lambda file: file.write_text(_mtl(files), encoding="utf-8"),
    }
    for name, data in images.items():
        writers[files[name]] = lambda file, data=data: file.write_bytes(data)
    with ExitStack() as stack:  # when all are there, they get their names, and last the first, which refers to them
        for target, write in writers.items():
            write(stack.enter_context(whole_file(target)))


def _png(image: Image) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


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


def _write_obj(
    path: Path,
    similarity: Similarity,
    vertices: NDArray[np.float64],
    faces: NDArray[np.integer],
    *,
    normals: NDArray[np.floating] | None = None,
    colors: NDArray[np.floating] | None = None,
    uv: NDArray[np.floating] | None = None,
    library: str | None = None,
) -> None:
    """The lines of an OBJ file; all that a vertex has, has its number. With ``uv`` there must be ``normals``."""
    line, rows = "v " + " ".join(["%.15g" if needs_doubles(similarity) else "%.9g"] * 3), similarity.to_input(vertices)
    if colors is not None:
        line, rows = line + " %.4g %.4g %.4g", np.concatenate((rows, colors), axis=1)
    blocks: list[tuple[str, NDArray[Any]]] = [(line, rows)]
    corner = "%d"
    if uv is not None:
        blocks.append(("vt %.7f %.7f", uv))
    if normals is not None:
        blocks.append(("vn %.5f %.5f %.5f", normals))
        corner = "%d//%d" if uv is None else "%d/%d/%d"
    numbers = np.repeat(faces.astype(np.int64) + 1, corner.count("%d"), axis=1)
    blocks.append((f"f {corner} {corner} {corner}", numbers))
    with path.open("w", encoding="utf-8") as file:
        file.write("# mplicits\n")
        if library is not None:
            file.write(f"mtllib {library}\nusemtl {MATERIAL}\n")
        for template, rows in blocks:
            for start in range(0, len(rows), TEXT_ROWS):
                part = rows[start : start + TEXT_ROWS]
                file.write((template + "\n") * len(part) % tuple(part.ravel().tolist()))


def _mtl(files: Mapping[str, Path]) -> str:
    lines = ["# mplicits", f"newmtl {MATERIAL}", "Kd 1 1 1", "Ks 0 0 0", "illum 1"]
    if "color" in files:
        lines.append(f"map_Kd {files['color'].name}")
    if "normal" in files:
        # Not map_Bump: most programs take that for heights, and Blender takes its image for display colours.
        lines.append(f"norm {files['normal'].name}")
    return "\n".join(lines) + "\n"


def _attributes(
    similarity: Similarity,
    vertices: NDArray[np.floating],
    *,
    normals: NDArray[np.floating] | None = None,
    tangents: NDArray[np.floating] | None = None,
    uv: NDArray[np.floating] | None = None,
    colors: NDArray[np.floating] | None = None,
) -> dict[str, NDArray[Any]]:
    """What a mesh in unit-sphere coordinates has at its vertices, as glTF names and stores it."""
    attributes: dict[str, NDArray[Any]] = {
        "POSITION": (similarity.to_input(vertices) - _glb_origin(similarity)).astype("<f4")
    }
    if normals is not None:
        attributes["NORMAL"] = normals.astype("<f4")
    if tangents is not None:
        attributes["TANGENT"] = tangents.astype("<f4")
    if uv is not None:
        attributes["TEXCOORD_0"] = (uv * (1, -1) + (0, 1)).astype("<f4")  # v runs down in glTF
    if colors is not None:
        attributes["COLOR_0"] = _linear_colors(colors)
    return attributes


def _linear_colors(colors: NDArray[np.floating]) -> NDArray[np.uint16]:
    """COLOR_0 ``(V, 4)``: linear by the standard; in 8 bits that would merge dark shades."""
    opaque = np.full((len(colors), 4), 65535, "<u2")  # four channels keep rows aligned to four bytes
    opaque[:, :3] = np.rint(srgb_to_linear(np.clip(colors, 0, 1)) * 65535)
    return opaque


def _glb_origin(similarity: Similarity) -> tuple[float, float, float]:
    """What the positions of a GLB file are relative to: far away, the centre, so that float32 suffices for them."""
    return similarity.center if needs_doubles(similarity) else (0.0, 0.0, 0.0)


def _write_colored_obj(path: Path, mesh: Mesh, similarity: Similarity) -> None:
    _write_obj(path, similarity, mesh.vertices, mesh.faces, normals=mesh.normals, colors=mesh.colors)


def _write_colored_glb(path: Path, mesh: Mesh, similarity: Similarity) -> None:
    attributes = _attributes(similarity, mesh.vertices, normals=mesh.normals, colors=mesh.colors)
    write_glb(path, mesh.faces, attributes, origin=_glb_origin(similarity))


_WRITERS: dict[str, Callable[[Path, Mesh, Similarity], None]] = {
    ".ply": _write_ply,
    ".obj": _write_colored_obj,
    ".stl": _write_stl,
    ".glb": _write_colored_glb,
}
