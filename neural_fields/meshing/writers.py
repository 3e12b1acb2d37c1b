"""Triangles → PLY, OBJ, STL and GLB files, complete or not at all, in float64 where a format has it.

All mesh files are written here: those of `Mesh.export` and those of the commands, with textures and moving ones too.
Colours are display numbers in PLY and OBJ, linear light in GLB. How coordinates are turned and scaled for other
programs says a `Placement`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.errors import InputError
from ..backend.files import check_place, whole_file
from ..fields.similarity import Similarity
from .color_space import srgb_to_linear
from .glb import MATERIAL, Motion, write_glb
from .placement import Placement

__all__ = [
    "Triangles",
    "check_mesh_path",
    "glb_attributes",
    "glb_origin",
    "needs_doubles",
    "write_glb_mesh",
    "write_obj",
    "write_triangles",
]

Float64 = NDArray[np.float64]
Origin = tuple[float, float, float]

# float32 rounds a coordinate c by up to 6e-8 |c|. Up to this many scales from the origin that is less than a
# hundredth of a cell at 2048³.
FLOAT32_REACH = 128.0


class Triangles(NamedTuple):
    """What a mesh file is made of.

    Attributes:
        vertices: ``(V, 3)`` float64, in input coordinates, or in those of the file.
        faces: ``(F, 3)``.
        normals: ``(V, 3)`` unit normals.
        colors: ``(V, 3)`` display RGB in [0, 1].
        uv: ``(V, 2)`` texture coordinates, v upwards; normals belong to them.
        tangents: ``(V, 4)`` as glTF has them.
    """

    vertices: Float64
    faces: NDArray[np.integer]
    normals: NDArray[np.floating] | None = None
    colors: NDArray[np.floating] | None = None
    uv: NDArray[np.floating] | None = None
    tangents: NDArray[np.floating] | None = None

    def placed(self, suffix: str, home: Similarity, placement: Placement) -> tuple[Triangles, bool]:
        """The same, turned and scaled as ``placement`` asks of a file, and whether doubles are needed there.

        Args:
            suffix: of the file.
            home: where in input coordinates the mesh is, and how large.
            placement: what is asked for.
        """
        place = placement.into(suffix, self.vertices)
        if not place.changes:
            return self, needs_doubles(home)
        normals = None if self.normals is None else place.directions(self.normals)
        placed = self._replace(vertices=place.points(self.vertices), normals=normals)
        return placed, needs_doubles(place.home(home))


def check_mesh_path(path: str | Path, similarity: Similarity | None = None, *, centered: bool = False) -> Path:
    """Whether a mesh can be written to ``path``, to be asked before any long work.

    Args:
        path: the file to be; an existing file would be replaced.
        similarity: that of the field, where it is known already.
        centered: whether the mesh will be centred at the origin.

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
    if path.suffix.lower() == ".stl" and similarity is not None and not centered and needs_doubles(similarity):
        center = ", ".join(f"{c:.0f}" for c in similarity.center)
        raise InputError(
            f"{path}: STL keeps seven digits, too few so far from the origin ({center}); centre it (--center), "
            "or use .ply or .obj"
        )
    return path


def needs_doubles(similarity: Similarity) -> bool:
    """Whether the coordinates are so far from the origin, as map coordinates are, that float32 would spoil them."""
    return max(abs(c) for c in similarity.center) > FLOAT32_REACH * similarity.scale


def write_triangles(path: str | Path, mesh: Triangles, home: Similarity, placement: Placement | None = None) -> None:
    """Write a mesh; the extension chooses the format, and the file has its name only when it is complete.

    PLY is binary, with double coordinates where float would spoil them (see `needs_doubles`), normals and colours;
    OBJ has normals and colours; STL (binary) neither. GLB is float32 by its standard, with the map into the scene in
    its node; see `write_glb_mesh`.

    Args:
        path: the file.
        mesh: in input coordinates.
        home: where in them it is, and how large.
        placement: what is known of the input's coordinates; by default nothing.

    Raises:
        InputError: see `check_mesh_path`; or the disk is full.
    """
    placement = placement or Placement()
    path = check_mesh_path(path, home, centered=placement.center)
    with whole_file(path) as partial:
        _WRITERS[path.suffix.lower()](partial, mesh, home, placement)


def write_glb_mesh(
    path: Path,
    mesh: Triangles,
    home: Similarity,
    placement: Placement,
    *,
    images: Mapping[str, bytes] | None = None,
    motion: Motion | None = None,
) -> None:
    """Write a GLB whose positions are the input's, less an origin, and whose node turns them y-up and into metres.

    The ``extras`` of the node keep that origin, and the unit and the axis where they were given: positions plus origin
    are input coordinates, whatever the node does.

    Args:
        path: the file; replaced.
        mesh: in input coordinates.
        home: where in them it is, and how large.
        placement: what is known of the input's coordinates.
        images: see `write_glb`.
        motion: see `write_glb`; of attributes from `glb_attributes`.
    """
    origin = glb_origin(mesh.vertices, home, placement)
    known = {"up": placement.up, "unit": placement.unit}
    extras = {"origin": list(origin), **{name: word for name, word in known.items() if word is not None}}
    node = {**placement.into(".glb", mesh.vertices).node(origin), "extras": extras}
    write_glb(path, mesh.faces, glb_attributes(mesh, origin), images=images, node=node, motion=motion)


def glb_origin(vertices: Float64, home: Similarity, placement: Placement) -> Origin:
    """What the positions of a GLB are relative to: far away or centred, the middle, so that float32 suffices for them.

    Args:
        vertices: ``(V, 3)`` in input coordinates.
        home: where in them they are, and how large their shape is.
        placement: see `write_glb_mesh`.
    """
    if placement.center:
        x, y, z = placement.into(".glb", vertices).middle.tolist()
        return x, y, z
    return home.center if needs_doubles(home) else (0.0, 0.0, 0.0)


def glb_attributes(mesh: Triangles, origin: Origin) -> dict[str, NDArray[Any]]:
    """What a mesh in input coordinates has at its vertices, as glTF names and stores it."""
    attributes: dict[str, NDArray[Any]] = {"POSITION": (mesh.vertices - origin).astype("<f4")}
    if mesh.normals is not None:
        attributes["NORMAL"] = mesh.normals.astype("<f4")
    if mesh.tangents is not None:
        attributes["TANGENT"] = mesh.tangents.astype("<f4")
    if mesh.uv is not None:
        attributes["TEXCOORD_0"] = (mesh.uv * (1, -1) + (0, 1)).astype("<f4")  # v runs down in glTF
    if mesh.colors is not None:
        # Linear by the standard; in 8 bits that would merge dark shades. Four channels keep rows aligned to four bytes.
        opaque = np.full((len(mesh.colors), 4), 65535, "<u2")
        opaque[:, :3] = np.rint(srgb_to_linear(np.clip(mesh.colors, 0, 1)) * 65535)
        attributes["COLOR_0"] = opaque
    return attributes


def write_obj(path: Path, mesh: Triangles, *, double: bool, library: str | None = None) -> None:
    """The lines of an OBJ file; all that a vertex has, has its number.

    Args:
        path: the file; replaced.
        mesh: in the coordinates of the file.
        double: whether coordinates need more digits than float32 has.
        library: name of the MTL file beside it.
    """
    line, rows = "v " + " ".join(["%.15g" if double else "%.9g"] * 3), mesh.vertices
    if mesh.colors is not None:
        line, rows = line + " %.4g %.4g %.4g", np.concatenate((rows, mesh.colors), axis=1)
    blocks: list[tuple[str, NDArray[Any]]] = [(line, rows)]
    corner = "%d"
    if mesh.uv is not None:
        blocks.append(("vt %.7f %.7f", mesh.uv))
    if mesh.normals is not None:
        blocks.append(("vn %.5f %.5f %.5f", mesh.normals))
        corner = "%d//%d" if mesh.uv is None else "%d/%d/%d"
    numbers = np.repeat(mesh.faces.astype(np.int64) + 1, corner.count("%d"), axis=1)
    blocks.append((f"f {corner} {corner} {corner}", numbers))
    with path.open("w", encoding="utf-8") as file:
        file.write("# mplicits\n")
        if library is not None:
            file.write(f"mtllib {library}\nusemtl {MATERIAL}\n")
        for template, rows in blocks:
            for start in range(0, len(rows), 1 << 16):
                part = rows[start : start + (1 << 16)]
                file.write((template + "\n") * len(part) % tuple(part.ravel().tolist()))


def _write_ply(path: Path, mesh: Triangles, home: Similarity, placement: Placement) -> None:
    mesh, double = mesh.placed(".ply", home, placement)
    kind = "<f8" if double else "<f4"
    columns: list[tuple[str, str, NDArray[Any]]] = [
        (name, kind, column) for name, column in zip("xyz", mesh.vertices.T, strict=True)
    ]
    if mesh.normals is not None:
        columns += [(name, "<f4", n) for name, n in zip(("nx", "ny", "nz"), mesh.normals.T, strict=True)]
    if mesh.colors is not None:
        shades = np.rint(np.clip(mesh.colors, 0, 1) * 255).astype(np.uint8)
        columns += [(name, "u1", c) for name, c in zip(("red", "green", "blue"), shades.T, strict=True)]
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


def _write_stl(path: Path, mesh: Triangles, home: Similarity, placement: Placement) -> None:
    mesh, _ = mesh.placed(".stl", home, placement)
    corners = mesh.vertices[mesh.faces]  # (F, 3, 3)
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(facing, axis=1, keepdims=True)
    faces = np.zeros(len(mesh.faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    faces["normal"] = np.divide(facing, length, out=np.zeros_like(facing), where=length > 0)
    faces["corners"] = corners
    with path.open("wb") as file:
        file.write(b"mplicits".ljust(80) + len(faces).to_bytes(4, "little"))
        file.write(faces.data)


def _write_obj_mesh(path: Path, mesh: Triangles, home: Similarity, placement: Placement) -> None:
    placed, double = mesh.placed(".obj", home, placement)
    write_obj(path, placed, double=double)


_WRITERS: dict[str, Callable[[Path, Triangles, Similarity, Placement], None]] = {
    ".ply": _write_ply,
    ".obj": _write_obj_mesh,
    ".stl": _write_stl,
    ".glb": write_glb_mesh,
}
