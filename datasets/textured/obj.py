"""Wavefront OBJ with its materials: faces, texture coordinates of corners, MTL files and their images.

A material's colour is ``map_Kd``, or else ``Kd``; both are display colours. Options of ``map_Kd`` are refused. trimesh
splits vertices at seams.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError
from ..clouds.readers.meshes import ObjText, triangulate
from ..files import decoded
from .mesh import Float64, Paint, TexturedMesh, decode_texture, pack


class _Material(NamedTuple):
    """The colour of a material, or its image."""

    color: tuple[float, ...] = (1.0, 1.0, 1.0)
    image: Path | None = None


def read_textured_obj(path: Path) -> TexturedMesh:
    """The faces of an OBJ file with the images and colours of its materials, or the colours of its vertices."""
    obj = ObjText(path)
    if not len(obj.corners):
        raise InputError(f"{path}: f: no faces in it; a cloud has no texture, so give a mesh")
    points, corners, colors = obj.points, obj.corners, obj.colors
    triangles = triangulate(obj.lengths, np.arange(len(corners)))  # (F, 3) corners
    if not len(triangles):
        raise InputError(f"{path}: f: no face has three corners; export it again")
    faces = corners[triangles]

    names, name_starts = obj.records("usemtl")
    materials = _materials(obj)
    # Vertex colours go before Kd without images, which exporters write as a default.
    if not materials or (colors is not None and not any(material.image for material in materials.values())):
        return TexturedMesh(points, faces, None, None, colors, str(path))
    # The last usemtl before a polygon; faces before the first usemtl have the last entry, which is white.
    used = np.searchsorted(name_starts, obj.used_at[triangles[:, 0]]) - 1
    number = {name: k for k, name in enumerate(materials)}
    if (unknown := next((name for name in names if name not in number), None)) is not None:
        raise InputError(f"{path}: usemtl: no material {unknown!r} in its MTL file; export both again")
    listed = [*materials.values(), _Material()]
    chosen = np.array([*(number[name] for name in names), len(materials)])[used]  # (F,); −1 is the last

    uv = np.zeros((len(corners), 2))
    painted = np.array([material.image is not None for material in listed])[chosen]
    mapped = np.zeros(len(corners), bool)
    mapped[triangles[painted]] = True
    if mapped.any():
        uv[mapped] = _texture_coordinates(obj, mapped)
    some, chosen = np.unique(chosen % len(listed), return_inverse=True)
    image, parts = pack([_paint(listed[k]) for k in some], chosen)
    return TexturedMesh(points, faces, uv[triangles], image, None, str(path), parts)


def _texture_coordinates(obj: ObjText, mapped: NDArray[np.bool_]) -> Float64:
    """Texture coordinates of the corners that need them."""
    table, starts = obj.table("vt", "texture coordinate")
    if not len(starts):
        raise InputError(f"{obj.path}: vt: no texture coordinates, but its materials have images; export it with them")
    if table.shape[1] < 2 or not np.isfinite(table[:, :2]).all():
        raise InputError(f"{obj.path}: vt: expected two finite numbers, u and v; export it again")
    second = [[*word.split("/"), ""][1] for word in obj.words.split()]
    needed = [second[k] for k in np.flatnonzero(mapped)]
    if not all(needed):
        raise InputError(
            f"{obj.path}: f: a corner of a textured face has no vt index; export it with texture coordinates"
        )
    return table[obj.indices(" ".join(needed), starts, obj.used_at[mapped], "vt"), :2]


def _materials(obj: ObjText) -> dict[str, _Material]:
    """All materials of all MTL files that the OBJ names."""
    found: dict[str, _Material] = {}
    path = obj.path
    for name in obj.records("mtllib")[0]:
        # A line may name several files, or one with spaces in its name.
        whole = _beside(path, name)
        for file in [whole] if whole.is_file() else [_beside(path, word) for word in name.split()]:
            if not file.is_file():
                raise InputError(f"{path}: mtllib: {file} is not there; put the MTL file beside the OBJ file")
            found |= _read_mtl(file)
    return found


def _read_mtl(file: Path) -> dict[str, _Material]:
    found: dict[str, _Material] = {}
    name: str | None = None
    for line in decoded(file.read_bytes()).splitlines():
        keyword, rest = [*line.split(maxsplit=1), "", ""][:2]
        rest = rest.split(" #")[0].strip()
        if keyword == "newmtl":
            name = rest
            found[name] = _Material()
        elif name is not None and keyword == "Kd":
            found[name] = found[name]._replace(color=_color(rest, file, name))
        elif name is not None and keyword.lower() == "map_kd":
            if rest.startswith("-"):
                raise InputError(f"{file}: {name}: map_Kd: the option {rest.split()[0]} is not read; export without it")
            image = _beside(file, rest)  # whose name may hold spaces
            if not image.is_file():
                raise InputError(f"{file}: {name}: map_Kd: {image} is not there; put the image beside the MTL file")
            found[name] = found[name]._replace(image=image)
    return found


def _color(words: str, file: Path, name: str) -> tuple[float, ...]:
    try:
        color = tuple(float(word) for word in words.split()[:3])
    except ValueError as error:
        raise InputError(f"{file}: {name}: Kd: expected three numbers, not {words!r}") from error
    if len(color) not in (1, 3) or not np.isfinite(color).all():
        raise InputError(f"{file}: {name}: Kd: expected three numbers, not {words!r}")
    return tuple(min(max(part, 0.0), 1.0) for part in color) * (3 // len(color))


def _beside(file: Path, name: str) -> Path:
    """A file named in another one, at its path or else beside it."""
    name = name.strip().strip('"').replace("\\", "/")
    relative = file.parent / name
    return relative if relative.is_file() else file.parent / name.rsplit("/", 1)[-1]


def _paint(material: _Material) -> Paint:
    if material.image is None:
        return Paint(np.array(material.color, np.float32).reshape(1, 1, 3))
    try:
        return Paint(decode_texture(material.image.read_bytes()))
    except ValueError as error:
        raise InputError(f"{material.image}: {error}; save it as PNG or JPEG") from error
