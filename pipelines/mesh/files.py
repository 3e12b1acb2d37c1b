"""Meshes out, in input coordinates, complete or not at all: PLY, OBJ, STL and GLB; textured; and moving GLB."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError, Mesh, Similarity
from ...neural_fields.backend.arrays import Image
from ...neural_fields.backend.files import whole_file
from ...neural_fields.fields.similarity import Placement
from ...neural_fields.meshing.glb import MATERIAL, Motion
from ...neural_fields.meshing.mesh import (
    check_mesh_path,
    glb_attributes,
    glb_origin,
    write_glb_mesh,
    write_obj,
    write_triangles,
)
from .atlas import check_tools


def placement_of(up: str | None, unit: str | None, center: bool) -> Placement:
    """The `Placement` that flags describe; raises InputError."""
    try:
        return Placement(up, unit, center)
    except ValueError as error:
        raise InputError(f"--{error}") from error


def check_textured_path(path: str | Path, similarity: Similarity | None = None, *, centered: bool = False) -> Path:
    """Raise an InputError before any long work if a textured mesh cannot be made or written; see `check_mesh_path`."""
    path = Path(path)
    if path.suffix.lower() not in (".glb", ".obj"):
        raise InputError(f"{path}: textures are written as .glb or .obj; choose one of them, or leave --texture out")
    check_tools("--texture", "fast_simplification", "xatlas")
    return check_mesh_path(path, similarity, centered=centered)


def write_mesh(
    path: str | Path, mesh: Mesh, similarity: Similarity | None = None, placement: Placement | None = None
) -> None:
    """Write ``mesh``, moved to input coordinates by ``similarity``; the extension chooses the format.

    PLY is binary, with double coordinates where float would spoil them, normals and colours; OBJ has normals and
    colours; STL (binary) neither. Colours are display numbers in PLY and OBJ, linear light in GLB. GLB is float32: far
    from the origin its coordinates are relative to ``similarity.center``, which the node's ``extras`` keep. The file
    appears under its name only when it is complete. A GLB is y-up and in metres, by its node; in other formats the
    coordinates change only as ``placement`` asks: which axis is up in the input, its unit, whether to centre the mesh.

    Raises:
        InputError: see `check_mesh_path`; or the disk is full.
    """
    similarity = similarity or Similarity.identity()
    placed = dataclasses.replace(mesh, vertices=similarity.to_input(mesh.vertices))
    write_triangles(path, placed, similarity, placement)


def write_moving(
    path: Path,
    faces: NDArray[np.integer],
    vertices: Sequence[NDArray[np.floating]],
    normals: Sequence[NDArray[np.floating]],
    *,
    seconds: NDArray[np.floating],
    similarity: Similarity,
    colors: NDArray[np.floating] | None = None,
    placement: Placement | None = None,
) -> None:
    """Write a GLB of one mesh whose vertices move: a morph target for each frame after the first, and an animation.

    ``vertices`` and ``normals`` ``(V, 3)`` of each frame are in unit-sphere coordinates, ``seconds`` ``(T,)`` increase
    from 0, and ``colors`` ``(V, 3)`` stay. The first frame is what ``placement`` centres. Raises an InputError.
    """
    placement = placement or Placement()
    frames = [Mesh(similarity.to_input(rows), faces, across) for rows, across in zip(vertices, normals, strict=True)]
    origin = glb_origin(frames[0].vertices, similarity, placement)
    first, *later = (glb_attributes(frame, origin) for frame in frames)
    targets = [{name: target[name] - first[name] for name in first} for target in later]
    motion = Motion(seconds.astype("<f4"), targets)
    with whole_file(path) as partial:
        write_glb_mesh(partial, dataclasses.replace(frames[0], colors=colors), similarity, placement, motion=motion)


def write_textured(
    path: str | Path,
    mesh: Mesh,
    similarity: Similarity,
    *,
    color: Image | None,
    normal: Image | None,
    placement: Placement | None = None,
) -> None:
    """Write an unwrapped mesh with images ``(H, W, 3)``: display colours, and tangent-space normals, +y upwards.

    ``shape.glb`` is one file, with tangents. Beside ``shape.obj`` there are ``shape.mtl``, ``shape_color.png`` and
    ``shape_normal.png``. They appear under their names when all are complete. Raises an InputError.
    """
    path, placement = check_textured_path(path, similarity), placement or Placement()
    images = {name: _png(image) for name, image in (("color", color), ("normal", normal)) if image is not None}
    triangles = dataclasses.replace(mesh, vertices=similarity.to_input(mesh.vertices))
    if path.suffix.lower() == ".glb":
        with whole_file(path) as partial:
            write_glb_mesh(partial, triangles, similarity, placement, images=images)
        return
    files = {name: path.with_name(f"{path.stem}_{name}.png") for name in images}
    library = path.with_suffix(".mtl")
    placed, double = triangles.placed(".obj", similarity, placement)
    writers: dict[Path, Callable[[Path], object]] = {
        path: lambda file: write_obj(file, placed, double=double, library=library.name),
        library: lambda file: file.write_text(_mtl(files), encoding="utf-8"),
    }
    for name, data in images.items():
        writers[files[name]] = lambda file, data=data: file.write_bytes(data)
    with ExitStack() as stack:  # when all are there, they get their names, and last the first, which refers to them
        for target, write in writers.items():
            write(stack.enter_context(whole_file(target)))


def _png(image: Image) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def _mtl(files: Mapping[str, Path]) -> str:
    lines = ["# mplicits", f"newmtl {MATERIAL}", "Kd 1 1 1", "Ks 0 0 0", "illum 1"]
    if "color" in files:
        lines.append(f"map_Kd {files['color'].name}")
    if "normal" in files:
        # Not map_Bump: most programs take that for heights, and Blender takes its image for display colours.
        lines.append(f"norm {files['normal'].name}")
    return "\n".join(lines) + "\n"
