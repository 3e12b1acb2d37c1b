"""``Mesh``, and its way to PLY, OBJ, STL and GLB files: complete or not at all, in float64 where a format has it.

Colours are display numbers in PLY and OBJ, linear light in GLB. A `Placement` turns and scales coordinates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..backend.arrays import Float64
from ..backend.errors import InputError
from ..backend.files import check_place, whole_file
from ..fields.similarity import Placement, Similarity
from .color_space import srgb_to_linear
from .glb import MATERIAL, Motion, write_glb

Origin = tuple[float, float, float]

FLOAT32_REACH = 128.0  # scales from the origin, up to which float32 rounds by less than a hundredth cell at 2048³


@dataclass(frozen=True)
class MeshStats:
    """Cost of an extraction."""

    points: tuple[int, ...]  # sent to each level (a level may answer some by a coarser one)
    blocks: int  # surviving blocks of 2³ cells
    cells: int  # that the surface crosses


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, or with no faces a cloud of points.

    In the field's own coordinates from `extract_mesh`, in input coordinates from `WorldField.mesh` and from files.

    Attributes:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` integers, counter-clockwise as seen from outside (the positive side).
        normals: ``(V, 3)`` unit vectors, outward; or None.
        colors: ``(V, 3)`` display RGB in [0, 1]; or None.
        uv: ``(V, 2)`` texture coordinates, v upwards; vertices on seams are repeated, once per chart. Or None.
        tangents: ``(V, 4)`` as in glTF; or None.
        stats: of `extract_mesh`; or None.
    """

    vertices: Float64
    faces: NDArray[np.integer]
    normals: NDArray[np.floating] | None = None
    colors: NDArray[np.floating] | None = None
    uv: NDArray[np.floating] | None = None
    tangents: NDArray[np.floating] | None = None
    stats: MeshStats | None = None

    def used_vertices(self) -> Float64:
        """The vertices of faces; all vertices where there are no faces."""
        return self.vertices[np.unique(self.faces)] if len(self.faces) else self.vertices

    @cached_property
    def merged(self) -> Mesh:
        """Vertices and faces alone, equal vertices made one; faces that collapse by it are dropped."""
        first, index = weld(self.vertices)
        faces = index[self.faces]
        whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        return Mesh(self.vertices[first], faces[whole])

    def moved(self, similarity: Similarity) -> Mesh:
        """The same mesh in unit-sphere coordinates."""
        return dataclasses.replace(self, vertices=similarity.to_unit(self.vertices))

    def placed(self, suffix: str, home: Similarity, placement: Placement) -> tuple[Mesh, bool]:
        """The mesh as a file with this ``suffix`` has it by ``placement``, and whether it needs doubles there.

        ``home`` is the place and size of the mesh in input coordinates.
        """
        place = placement.into(suffix, self.vertices)
        if not place.changes:
            return self, needs_doubles(home)
        normals = None if self.normals is None else place.directions(self.normals)
        placed = dataclasses.replace(self, vertices=place.points(self.vertices), normals=normals)
        return placed, needs_doubles(place.home(home))

    def to_trimesh(self) -> Any:
        """The mesh as a ``trimesh.Trimesh``: the same vertices in float64, with normals, and colours in 8 bits.

        Example:
            >>> from mplicits.neural_fields import Sphere, extract_mesh
            >>> ball = extract_mesh(Sphere(radius=0.5), resolution=32).to_trimesh()
            >>> ball.is_watertight, round(float(ball.volume), 2)
            (True, 0.52)
        """
        import trimesh

        colors = None
        if self.colors is not None:
            colors = np.full((len(self.colors), 4), 255, np.uint8)
            colors[:, :3] = np.rint(np.clip(self.colors, 0, 1) * 255)
        # process=False: it would merge vertices and drop faces.
        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=colors, process=False
        )

    def export(self, path: str | Path, *, up: str | None = None, unit: str | None = None, center: bool = False) -> None:
        """Write the mesh as PLY, OBJ, STL or GLB, by the extension, as ``mplicits mesh`` does.

        Normals and colours are written where the format has them. Coordinates are doubles in PLY and OBJ where floats
        would spoil them; a GLB keeps its offset from the origin in float64.

        Args:
            path: the file; it has its name only when it is complete.
            up: the axis that points up in the mesh, "y" or "z". A GLB is y-up, and z is turned up there; the others are
                turned (OBJ to y-up, PLY and STL to z-up) if it is given.
            unit: of the coordinates, "mm", "cm", "m", … (`Placement`). A GLB is in metres, by its node; the others are
                scaled (to millimetres in STL, else to metres) if it is given.
            center: whether the middle of the bounding box goes to the origin.

        Raises:
            InputError: the extension is unknown, the file cannot be written, or STL has too few digits so far from the
                origin.
            ValueError: there is no such axis or unit, or the mesh has no faces.
        """
        if not len(self.faces):
            raise ValueError("the mesh has no faces, so there is nothing to write")
        placement = Placement(up, unit, center)
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        x, y, z = ((low + high) / 2).tolist()
        home = Similarity((x, y, z), float(np.linalg.norm(high - low)) / 2 or 1.0)
        write_triangles(path, self, home, placement)


def check_mesh_path(path: str | Path, similarity: Similarity | None = None, *, centered: bool = False) -> Path:
    """``path`` as a Path; InputError if no mesh can be written there, to be called before any long work.

    ``similarity`` is that of the field, if known already; ``centered`` whether the mesh will be centred at the origin.
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
    """Whether float32 would spoil the coordinates, so far from the origin as map coordinates are."""
    return max(abs(c) for c in similarity.center) > FLOAT32_REACH * similarity.scale


def write_triangles(path: str | Path, mesh: Mesh, home: Similarity, placement: Placement | None = None) -> None:
    """Write a mesh in input coordinates, in the format of the extension; it has its name only when it is complete.

    PLY is binary, with doubles where needed (`needs_doubles`), normals and colours; OBJ has normals and colours; STL
    (binary) neither; for GLB see `write_glb_mesh`. ``home`` is the place and size of the mesh. Errors are those of
    `check_mesh_path`.
    """
    placement = placement or Placement()
    path = check_mesh_path(path, home, centered=placement.center)
    with whole_file(path) as partial:
        _WRITERS[path.suffix.lower()](partial, mesh, home, placement)


def write_glb_mesh(
    path: Path,
    mesh: Mesh,
    home: Similarity,
    placement: Placement,
    *,
    images: Mapping[str, bytes] | None = None,
    motion: Motion | None = None,
) -> None:
    """Write a GLB whose positions are the input's, less an origin, and whose node turns them y-up and into metres.

    The ``extras`` of the node keep that origin, and unit and axis if given: positions plus origin are input
    coordinates. ``images`` and ``motion`` (of attributes from `glb_attributes`) are those of `write_glb`.
    """
    origin = glb_origin(mesh.vertices, home, placement)
    known = {"up": placement.up, "unit": placement.unit}
    extras = {"origin": list(origin), **{name: word for name, word in known.items() if word is not None}}
    node = {**placement.into(".glb", mesh.vertices).node(origin), "extras": extras}
    write_glb(path, mesh.faces, glb_attributes(mesh, origin), images=images, node=node, motion=motion)


def glb_origin(vertices: Float64, home: Similarity, placement: Placement) -> Origin:
    """The origin of a GLB's positions: the middle where they are far away or centred, so that float32 suffices."""
    if placement.center:
        x, y, z = placement.into(".glb", vertices).middle.tolist()
        return x, y, z
    return home.center if needs_doubles(home) else (0.0, 0.0, 0.0)


def glb_attributes(mesh: Mesh, origin: Origin) -> dict[str, NDArray[Any]]:
    """Vertex attributes of a mesh in input coordinates, as glTF names and stores them."""
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


def write_obj(path: Path, mesh: Mesh, *, double: bool, library: str | None = None) -> None:
    """Write an OBJ file, with fifteen digits if ``double``, and the name ``library`` of an MTL file beside it."""
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


def weld(vertices: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first of each set of equal rows of ``vertices`` ``(N, K)``: indices ``(M,)``, rows in ascending order.

    The second result is the place of each old row among them ``(N,)``.
    """
    order = np.lexsort((vertices + 0.0).T)  # stable: among equals the first comes first; + 0.0: minus zero is zero
    ordered = vertices[order]
    first = np.ones(len(vertices), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    index = np.empty(len(vertices), np.int64)
    index[order] = np.cumsum(first) - 1
    return order[first], index


def ply_vertices(
    points: NDArray[Any], normals: NDArray[Any] | None, colors: NDArray[Any] | None, *, double: bool
) -> NDArray[Any]:
    """The rows of a PLY of points, and of normals and colours, ``(N, 3)``."""
    kind = "<f8" if double else "<f4"
    columns: list[tuple[str, str, NDArray[Any]]] = [(name, kind, c) for name, c in zip("xyz", points.T, strict=True)]
    if normals is not None:
        columns += [(name, "<f4", n) for name, n in zip(("nx", "ny", "nz"), normals.T, strict=True)]
    if colors is not None:
        shades = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
        columns += [(name, "u1", c) for name, c in zip(("red", "green", "blue"), shades.T, strict=True)]
    rows = np.empty(len(points), [(name, kind) for name, kind, _ in columns])
    for name, _, column in columns:
        rows[name] = column
    return rows


def ply_faces(faces: NDArray[np.integer]) -> NDArray[Any]:
    """The rows of a PLY of triangles ``(F, 3)``."""
    rows = np.empty(len(faces), [("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    return rows


def ply_header(row: np.dtype[Any], vertices: int, faces: int | None = None) -> bytes:
    """The header of a binary PLY of so many rows of `ply_vertices`, each a ``row``, and of `ply_faces`, if any."""
    kinds = {"<f8": "double", "<f4": "float", "|u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", "comment mplicits", f"element vertex {vertices}"]
    lines += [f"property {kinds[row[name].str]} {name}" for name in row.names or ()]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header\n"]).encode()


def _write_ply(path: Path, mesh: Mesh, home: Similarity, placement: Placement) -> None:
    mesh, double = mesh.placed(".ply", home, placement)
    vertices = ply_vertices(mesh.vertices, mesh.normals, mesh.colors, double=double)
    with path.open("wb") as file:
        file.write(ply_header(vertices.dtype, len(vertices), len(mesh.faces)))
        file.write(vertices.data)
        file.write(ply_faces(mesh.faces).data)


def _write_stl(path: Path, mesh: Mesh, home: Similarity, placement: Placement) -> None:
    mesh.placed(".stl", home, placement)[0].to_trimesh().export(path, file_type="stl")


def _write_obj_mesh(path: Path, mesh: Mesh, home: Similarity, placement: Placement) -> None:
    placed, double = mesh.placed(".obj", home, placement)
    write_obj(path, placed, double=double)


_WRITERS: dict[str, Callable[[Path, Mesh, Similarity, Placement], None]] = {
    ".ply": _write_ply,
    ".obj": _write_obj_mesh,
    ".stl": _write_stl,
    ".glb": write_glb_mesh,
}
