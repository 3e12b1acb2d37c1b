"""Textured meshes out: GLB with its images in it, or OBJ with MTL and PNG files; all of it or nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError, Similarity
from ..neural_fields.files import whole_file
from .glb import write_glb
from .mesh_files import TEXT_ROWS, check_mesh_path, glb_origin, needs_doubles
from .unwrap import Unwrapped, check_unwrap_tools

__all__ = ["check_textured_path", "write_textured"]

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
        _write_together({path: lambda file: _write_glb(file, mesh, similarity, images)})
        return
    files = {name: path.with_name(f"{path.stem}_{name}.png") for name in images}
    library = path.with_suffix(".mtl")
    writers: dict[Path, Callable[[Path], object]] = {
        path: lambda file: _write_obj(file, mesh, similarity, library.name),
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


def _write_glb(path: Path, mesh: Unwrapped, similarity: Similarity, images: Mapping[str, Image]) -> None:
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


def _write_obj(path: Path, mesh: Unwrapped, similarity: Similarity, library: str) -> None:
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
