"""A surface in cubes of lattices: as one PLY, or as 3D Tiles 1.1, coarse to fine, a tree of GLBs for web viewers."""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ...datasets import spacing_of
from ...datasets.clouds.point_cloud import unit_rows
from ...neural_fields import Field, InputError, Mesh, Similarity
from ...neural_fields.backend.files import check_place, files_in, json_bytes, remove, rename, whole_file, write_json
from ...neural_fields.fields.similarity import Placement
from ...neural_fields.meshing._cells import CORNERS, Bounds
from ...neural_fields.meshing.extract import DEFAULT_BOUNDS, NoSurfaceError, surface_needed
from ...neural_fields.meshing.mesh import check_mesh_path, ply_faces, ply_header, ply_vertices
from ...neural_fields.meshing.parts import Border, Place, extract_parts
from ..fit.cloud import file_facts
from ..surface.surface import (
    Footing,
    Support,
    component_of_vertices,
    footing,
    in_sphere,
    joined,
    keep_faces,
    read_support,
)
from ..texture.transport import Colors, colors_of_run
from ..training.folder import chosen_level, find_field, load_still, locked
from ..training.progress import Report, counted, silent
from .atlas import deviation
from .earth import Float64, Stand, on_globe, upright
from .extract import SurfaceOptions, chosen_resolution, evaluated
from .files import placement_of

SCENE_FILE = "tileset.json"
SEEN = 10_000  # points of each mesh at which errors are measured: of the Armadillo, 50,000 find the same
TILES = "tiles"  # folder of the GLB files
PARTS = "parts"  # folder of the meshes, while a scene is written


@dataclass(frozen=True)
class SceneOptions(SurfaceOptions):
    """How a run becomes 3D Tiles; ``level`` is that of the finest tiles, those of twice the size have the one before.

    Attributes:
        crs: coordinate reference system of the input, as pyproj takes it; None is that of the cloud's file, if any.
        cells: cells along each edge of a tile, a power of two.
    """

    crs: str | None = None
    cells: int = 128


class Scene(NamedTuple):
    """What was written: tiles, steps of detail, triangles of the finest one, the coarsest one's error in metres."""

    tiles: int
    steps: int
    faces: int
    error: float


def scene_of_run(
    run: str | Path,
    out: str | Path,
    options: SceneOptions | None = None,
    *,
    say: Callable[[str], None] | None = None,
    report: Report | None = None,
) -> Scene:
    """Write the surface of a run as 3D Tiles 1.1 into the folder ``out``: ``tileset.json`` and a GLB for each tile.

    Tiles are cubes of a lattice, `extract_parts`; each has up to eight of half the size that replace it. The geometric
    error of a tile is its largest distance to those, both ways, plus theirs. Tiles of one size meet without gaps.
    Memory is that of nine tiles, and of the support. The same call after an interruption goes on, see `_workplace`.

    Raises:
        InputError: there is no such run or level, it has no surface, the folder holds something else, or the coordinate
            system is unknown.
    """
    options, out, say = options or SceneOptions(), Path(out), say or (lambda _: None)
    placement = placement_of(options.up, options.unit, False)
    check_place(out)
    inside = {path.name for path in out.iterdir()} if out.is_dir() else {"a file"} if out.exists() else set()
    if SCENE_FILE not in inside and inside - {TILES}:
        raise InputError(f"{out}: holds something that is no 3D Tiles scene; name another folder")
    source = _Source.of(run, options, say)
    stand = _stand(options, placement, source.similarity, source.record, source.file)
    say(f"coordinates: {stand.line}")
    with _workplace(out, source, options) as folder:
        for step in range(source.steps):
            source.extract(folder / PARTS / str(step), options, step=step, report=report)
        shutil.rmtree(folder / TILES, ignore_errors=True)  # of a scene that was not finished
        show, total = counted(report or silent, "writing tiles"), sum(1 for _ in (folder / PARTS).rglob("*.npz"))
        writer = _Writer(folder, stand, source.similarity, source.colors, show, total)
        root = writer.tile(source.steps - 1, (0, 0, 0))
        if root is None:
            raise InputError(f"{source.file}: no surface in the region of interest; train it longer (--steps)")
        low, high = _corners(root)
        root["transform"] = stand.transform.T.ravel().tolist()  # column by column
        root["refine"] = "REPLACE"
        error = max(float(np.linalg.norm(high - low)), root["geometricError"])
        scene = {"asset": {"version": "1.1"}, "geometricError": error, "root": root}
        out.mkdir(parents=True, exist_ok=True)
        remove(out / SCENE_FILE)  # of an older scene
        shutil.rmtree(out / TILES, ignore_errors=True)
        rename(folder / TILES, out / TILES)
        write_json(out / SCENE_FILE, scene)
    return Scene(writer.tiles, source.steps, writer.faces, root["geometricError"])


def ply_of_run(
    run: str | Path,
    out: str | Path,
    options: SceneOptions | None = None,
    *,
    say: Callable[[str], None] | None = None,
    report: Report | None = None,
) -> tuple[int, int]:
    """Write the surface of a run as one PLY in input coordinates, cube by cube → the numbers of vertices and faces.

    Cubes share the vertices on their sides. Memory is that of a cube, of those vertices, and of the support. The same
    call after an interruption goes on, see `_workplace`. Raises an InputError, as `export_run` does.
    """
    options, out, say = options or SceneOptions(), Path(out), say or (lambda _: None)
    placement = placement_of(options.up, options.unit, False)
    if check_mesh_path(out).suffix.lower() != ".ply":
        raise InputError(f"{out}: --in-parts writes .ply only")
    source = _Source.of(run, options, say)
    if "region" in source.record:
        raise InputError(f"--in-parts: {source.file} is cut to a region, which takes the whole mesh; leave it out")
    if (line := placement.describe(".ply")) is not None:
        say(f"coordinates: {line}")
    with _workplace(out, source, options) as folder:
        source.extract(folder / PARTS, options, report=report)
        paths = _files(folder / PARTS)
        total, faces, sides = 0, 0, [np.empty(0, np.int64)]
        for mesh, _, edges in map(_kept, paths):
            total, faces = total + len(mesh.vertices), faces + len(mesh.faces)
            sides.append(edges)
        # The first cube of those that share a vertex writes it.
        _, first, number = np.unique(np.concatenate(sides), return_index=True, return_inverse=True)
        again = np.ones(len(number), bool)
        again[first] = False
        total -= int(again.sum())
        known, starts = np.empty(len(first), np.int64), np.cumsum([0, *map(len, sides[1:])])
        show = counted(report or silent, "writing the file")
        with whole_file(out) as partial, partial.open("wb") as file:
            written = vertices_at = faces_at = 0
            for k, path in enumerate(paths):
                mesh, shared, _ = _kept(path)
                own, ahead = number[starts[k] : starts[k + 1]], again[starts[k] : starts[k + 1]]
                new = np.ones(len(mesh.vertices), bool)
                new[shared[ahead]] = False
                row = written + np.cumsum(new) - 1
                known[own[~ahead]] = row[shared[~ahead]]
                row[shared] = known[own]
                colors = None if source.colors is None else evaluated(source.colors, mesh.vertices[new])
                mesh = dataclasses.replace(mesh, vertices=source.similarity.to_input(mesh.vertices))
                placed, double = mesh.placed(".ply", source.similarity, placement)
                assert placed.normals is not None
                vertices = ply_vertices(placed.vertices[new], placed.normals[new], colors, double=double)
                if k == 0:
                    vertices_at = file.write(ply_header(vertices.dtype, total, faces))
                    faces_at = vertices_at + total * vertices.itemsize
                file.seek(vertices_at + written * vertices.itemsize)
                file.write(vertices.data)
                file.seek(faces_at)
                faces_at += file.write(ply_faces(row[mesh.faces]).data)
                written += len(vertices)
                show(k + 1, len(paths))
    return total, faces


class _Source(NamedTuple):
    """What is extracted: the field of a run, and a lattice.

    Attributes:
        resolution: cells along the longest side of the lattice, at the finest step of ``steps``.
    """

    file: Path
    field: Field
    similarity: Similarity
    record: dict[str, Any]
    level: int
    support: Support | None
    colors: Colors | None
    bounds: Bounds
    resolution: int
    steps: int

    @classmethod
    def of(cls, run: str | Path, options: SceneOptions, say: Callable[[str], None]) -> _Source:
        """Load a run."""
        file = find_field(run)
        field, similarity, metadata = load_still(file, options.time)
        record = metadata.get("run", {})
        level = chosen_level(field, file, options.level)
        support = None if options.time is not None else read_support(file, record, level)
        lattice = _lattice(support, chosen_resolution(field, options.resolution, support, level, say), options.cells)
        colors = colors_of_run(file, field, options.time) if options.colors else None
        return cls(file, field, similarity, record, level, support, colors, *lattice)

    def extract(self, folder: Path, options: SceneOptions, *, step: int = 0, report: Report | None = None) -> None:
        """Keep the cubes of a step in a ``folder``; each step after the first has the level before, down to 0.

        Those that an interrupted command has left there stay.
        """
        folder.mkdir(parents=True, exist_ok=True)
        size = self.resolution // 2**step
        show = counted(report or silent, f"tiles of {size} cells per side")
        # Coarse cells may miss all of a thin surface.
        with surface_needed(f"{self.file}: no surface to mesh") if step == 0 else suppress(NoSurfaceError):
            for part in extract_parts(
                self.field,
                resolution=size,
                cells=options.cells,
                level=max(0, self.level - step),
                bounds=self.bounds,
                known=dict(map(_border, _files(folder))),
                progress=lambda _, done, total: show(done, total),
            ):
                arrays = {name: getattr(part.mesh, name) for name in ("vertices", "faces", "normals")}
                arrays |= {"shared": part.shared} | {f"border_{name}": x for name, x in part.border._asdict().items()}
                path = folder / f"{_name(part.place)}.npz"
                if "region" in self.record:
                    _cut(path, in_sphere(part.mesh))
                with whole_file(path) as partial:
                    np.savez(partial, allow_pickle=False, **arrays)
        if self.support is not None and not self.support.visible and not options.keep_unsupported:
            _drop_unsupported(folder, self.support)


@contextmanager
def _workplace(out: Path, source: _Source, options: SceneOptions) -> Iterator[Path]:
    """A hidden folder beside ``out`` for what it is made of, which an interruption leaves for the same command."""
    folder = out.with_name(f".{out.name}.{PARTS}")
    about = {**file_facts(source.file), "options": dataclasses.asdict(options), "bounds": source.bounds}
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        known = folder / "about.json"
        if not known.is_file() or known.read_bytes() != json_bytes(about):
            shutil.rmtree(folder / PARTS, ignore_errors=True)
            write_json(known, about)
        try:
            yield folder
        except InputError as error:
            if not isinstance(error.__cause__, OSError):  # as of a full disk
                shutil.rmtree(folder, ignore_errors=True)
            raise
    shutil.rmtree(folder, ignore_errors=True)


def _stand(
    options: SceneOptions, placement: Placement, similarity: Similarity, record: dict[str, Any], file: Path
) -> Stand:
    crs = options.crs or record.get("crs")
    if crs is None:
        return upright(placement, similarity.center)
    if options.up == "y" or options.unit is not None:
        flag = "--unit" if options.unit else "--up y"
        raise InputError(f"{flag}: {file} has coordinates on the globe, whose axes and units are known; leave it out")
    return on_globe(crs, similarity.center)


def _lattice(support: Support | None, resolution: int, cells: int) -> tuple[Bounds, int, int]:
    """The box of a scene, cells along its longest side, and steps of detail until one tile holds all."""
    low, high = np.array(DEFAULT_BOUNDS)
    edge = float((high - low).max()) / resolution
    if support is not None:
        least, most = support.points.min(axis=0), support.points.max(axis=0)
        room = support.radius + 0.05 * float((most - least).max())  # a surface bulges where nothing was measured
        low, high = np.maximum(low, least - room), np.minimum(high, most + room)
    along = np.maximum(2, np.ceil((high - low) / edge))
    steps = 1 + max(0, math.ceil(math.log2(along.max() / cells)))
    multiple = 2 ** (steps - 1)
    along = np.ceil(along / multiple) * multiple  # cells of all steps end at the same places
    x, y, z = low.tolist()
    i, j, k = (low + along * edge).tolist()
    return ((x, y, z), (i, j, k)), int(along.max()), steps


def _name(place: Place) -> str:
    return "_".join(map(str, place))


def _files(folder: Path) -> list[Path]:
    """The files of the cubes in a folder, in the order of their places."""
    return files_in(folder, (".npz",))


def _border(path: Path) -> tuple[Place, Border]:
    """The place of a cube, and what its neighbours need of it."""
    x, y, z = map(int, path.stem.split("_"))
    with np.load(path) as stored:
        return (x, y, z), Border(*(stored[f"border_{name}"] for name in Border._fields))


def _cut(path: Path, kept: NDArray[np.bool_]) -> None:
    """Have `_kept` return these faces ``(F,)`` of a cube; its file stays whole, for an extraction that goes on."""
    with whole_file(path.with_suffix(".npy")) as partial:
        np.save(partial, kept)


def _kept(path: Path, *, whole: bool = False) -> tuple[Mesh, NDArray[Any], NDArray[Any]]:
    """The mesh of a cube, and of its vertices that are shared with others the rows and the lattice edges.

    What `_cut` leaves out is there if it is wanted ``whole``.
    """
    with np.load(path) as stored:
        mesh = Mesh(stored["vertices"], stored["faces"], stored["normals"])
        shared, edges = stored["shared"], stored["border_edges"]
    if whole or not (cut := path.with_suffix(".npy")).is_file():
        return mesh, shared, edges
    kept = np.load(cut)
    used = np.unique(mesh.faces[kept])
    stay = np.isin(shared, used)
    return keep_faces(mesh, kept), np.searchsorted(used, shared[stay]), edges[stay]


def _drop_unsupported(folder: Path, support: Support) -> None:
    """Drop the components, followed from part to part, that no points support; see `drop_unsupported`."""
    paths = _files(folder)
    if not paths:
        return
    tree, total = KDTree(support.points), 0
    numbers: list[NDArray[np.intp]] = []
    edges, owners, found = [], [], []
    for path in paths:
        mesh, shared, lattice_edges = _kept(path, whole=True)
        component = component_of_vertices(mesh)
        edges.append(lattice_edges)
        owners.append(component[shared] + total)
        numbers.append(component[mesh.faces[:, 0]] + total)
        found.append(footing(mesh, component, tree, support.radius))
        total += len(found[-1].area)
    order = np.argsort(edge := np.concatenate(edges), kind="stable")
    owner = np.concatenate(owners)[order]
    met = edge[order][1:] == edge[order][:-1]
    graph = coo_array((np.ones(met.sum(), np.int8), (owner[:-1][met], owner[1:][met])), shape=(total, total))
    whole = connected_components(graph, directed=False)[1]
    area, near, points = (
        np.bincount(whole, np.concatenate(each)).astype(np.float64) for each in zip(*found, strict=True)
    )
    sums = Footing(area, near, points)
    stands = sums.stands(spacing_of(support.points))
    if not stands.any():
        return
    for path, number in zip(paths, numbers, strict=True):
        _cut(path, stands[whole[number]])


def _corners(entry: Mapping[str, Any]) -> tuple[Float64, Float64]:
    """The lowest and the highest corner of the box of a tile."""
    middle, half = np.split(np.array(entry["boundingVolume"]["box"])[[0, 1, 2, 3, 7, 11]], 2)
    return middle - half, middle + half


@dataclass
class _Writer:
    """Writes tiles from the finest up, and counts them."""

    out: Path
    stand: Stand
    similarity: Similarity
    colors: Colors | None
    show: Callable[[int, int], None]
    total: int
    tiles: int = 0
    faces: int = 0  # of the finest

    def tile(self, step: int, place: Place) -> dict[str, Any] | None:
        """The entry of a tile in the tree, with those below it; None where there is nothing."""
        below: list[Place] = [tuple(each) for each in (2 * np.array(place) + CORNERS).tolist()] if step else []
        children = [tile for each in below if (tile := self.tile(step - 1, each)) is not None]
        mesh = self._mesh(step, place)
        if mesh is None and not children:
            return None
        boxes = [_corners(child) for child in children]
        entry: dict[str, Any] = {}
        if mesh is not None:
            placed = self._placed(mesh)
            boxes.append((placed.vertices.min(axis=0), placed.vertices.max(axis=0)))
            entry["content"] = {"uri": self._write(step, place, placed)}
        low, high = (pick([box[k] for box in boxes], axis=0) for k, pick in enumerate((np.min, np.max)))
        middle, half = (low + high) / 2, (high - low) / 2
        volume = {"boundingVolume": {"box": [*middle.tolist(), *np.diag(half).ravel().tolist()]}}
        error = 0.0
        if step:
            finer = [each for each in (self._mesh(step - 1, under) for under in below) if each is not None]
            apart = float(np.linalg.norm(high - low))  # if only one of the two has a surface
            if mesh is not None and finer:
                apart = deviation(joined(finer), mesh, probes=SEEN)[0] * self.similarity.scale * self.stand.metres
            error = apart + max((child["geometricError"] for child in children), default=0.0)
            # A surface at the side of a cube may be in its neighbour at the next step: nothing is there in its place.
            entry["children"] = children or [volume | {"geometricError": 0.0}]
        return volume | {"geometricError": error} | entry

    def _mesh(self, step: int, place: Place) -> Mesh | None:
        """The surface in a cube; None where there is none."""
        path = self.out / PARTS / str(step) / f"{_name(place)}.npz"
        mesh = _kept(path)[0] if path.is_file() else None
        return mesh if mesh is not None and len(mesh.faces) else None

    def _placed(self, mesh: Mesh) -> Mesh:
        assert mesh.normals is not None
        colors = None if self.colors is None else evaluated(self.colors, mesh.vertices)
        vertices = self.stand.points(self.similarity.to_input(mesh.vertices))
        normals = unit_rows(mesh.normals @ self.stand.turn.T).astype(np.float32)
        return dataclasses.replace(mesh, vertices=vertices, normals=normals, colors=colors)

    def _write(self, step: int, place: Place, mesh: Mesh) -> str:
        name = f"{TILES}/{step}/{_name(place)}.glb"
        mesh.export(self.out / name, up="z", unit="m")
        self.tiles += 1
        self.faces += len(mesh.faces) if step == 0 else 0
        self.show(self.tiles, self.total)
        return name
