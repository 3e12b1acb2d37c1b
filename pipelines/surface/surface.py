"""Triangle surfaces as arrays: reading, sampling, and what can be counted on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets import PointCloud, read_cloud, spacing_of
from ...datasets.clouds.point_cloud import Float64, spread_on_faces, unit_rows, voxel_representatives
from ...datasets.clouds.readers.reading import read_mesh
from ...datasets.textured.gltf import read_gltf
from ...neural_fields import InputError, Mesh, Similarity
from ..training.folder import FIELD_FILE, SUPPORT_FILE, load_state, read_record

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")


def read_surface(path: str | Path) -> Mesh:
    """Read a mesh, or any cloud that `read_cloud` knows; raises an InputError for a missing, damaged or empty file."""
    return read_described(path)[0]


def read_described(path: str | Path) -> tuple[Mesh, str]:
    """`read_surface`, and of a cloud one line about what was read; see `PointCloud`."""
    path = Path(path)
    mesh = _load_mesh(path) if path.suffix.lower() in MESH_SUFFIXES else None
    if mesh is not None:
        return mesh, ""
    cloud = read_cloud(path)
    return from_cloud(cloud), cloud.reading


def read_reference(path: str | Path, *, fix: str = "give a mesh") -> Mesh:
    """`read_surface` of something with faces to compare with; the InputError of a file without ends with ``fix``."""
    surface = read_surface(path)
    if not len(surface.faces):
        raise InputError(f"{path}: has no faces, so there is no surface to compare with; {fix}")
    return surface


def from_cloud(cloud: PointCloud) -> Mesh:
    """The finite points of a cloud, as a surface without faces; normals of unit length, or zero."""
    finite = np.isfinite(cloud.points).all(axis=1)
    normals = colors = None
    if cloud.normals is not None:
        normals = unit_rows(np.nan_to_num(cloud.normals[finite].astype(np.float64), posinf=0.0, neginf=0.0))
    if cloud.colors is not None:
        colors = cloud.colors[finite].astype(np.float64)
    return Mesh(cloud.points[finite], np.empty((0, 3), np.int64), normals, colors)


def _load_mesh(path: Path) -> Mesh | None:
    """The triangles of a file; None where it has no faces."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix.lower() in (".glb", ".gltf"):
        mesh = read_gltf(path, textures=False)
        vertices, faces, colors = mesh.vertices, mesh.faces, mesh.vertex_colors
    else:
        cloud, faces = read_mesh(path)
        vertices, colors = cloud.points, cloud.colors
        if not len(faces):
            return None
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise InputError(f"{path}: a vertex has a coordinate that is not a finite number")
    if not np.ptp(vertices[np.unique(faces)], axis=0).any():
        raise InputError(f"{path}: all vertices coincide")
    return Mesh(vertices, faces, None, None if colors is None else colors.astype(np.float64))


def face_normals(mesh: Mesh) -> tuple[Float64, Float64]:
    """Unit normals ``(F, 3)`` (zero for a face without area) and areas ``(F,)``."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return np.divide(cross, length[:, None], out=np.zeros_like(cross), where=length[:, None] > 0), length / 2


def sample_points(surface: Mesh, count: int, rng: np.random.Generator) -> tuple[Float64, NDArray[np.floating] | None]:
    """Points uniform by area ``(count, 3)`` with the normals of their faces; raises ValueError without area.

    Of a cloud, at most ``count`` of its own points, chosen at random, with their own normals.
    """
    if not len(surface.faces):
        chosen = slice(None)
        if len(surface.vertices) > count:
            chosen = rng.permutation(len(surface.vertices))[:count]
        return surface.vertices[chosen], None if surface.normals is None else surface.normals[chosen]
    normals, areas = face_normals(surface)
    face, weights = spread_on_faces(areas, count, rng)
    points = sum(weights[:, k, None] * surface.vertices[surface.faces[face, k]] for k in range(3))
    return np.asarray(points), normals[face]


def components(surface: Mesh) -> int:
    """Connected components of the faces, through shared vertices, equal vertices merged."""
    return int(component_of_faces(surface.merged).max(initial=-1)) + 1


def component_of_vertices(mesh: Mesh) -> NDArray[np.intp]:
    """The number ``(V,)`` from 0 up of each vertex's connected component, through faces; any of one without faces."""
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(size, size)).tocsr()
    number = connected_components(graph, directed=False)[1]
    return np.searchsorted(np.unique(number[a]), number)


def component_of_faces(mesh: Mesh) -> NDArray[np.intp]:
    """The same of each face ``(F,)``."""
    return component_of_vertices(mesh)[mesh.faces[:, 0]]


def joined(parts: Sequence[Mesh]) -> Mesh:
    """One mesh of several, whose vertices stay apart; with colours if all have some."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    colors = [part.colors for part in parts if part.colors is not None]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(faces).astype(np.int32),
        colors=np.concatenate(colors).astype(np.float32) if len(colors) == len(parts) else None,
    )


def is_closed(surface: Mesh) -> bool:
    """Whether each edge is run through as often in one direction as in the other, equal vertices merged."""
    whole = surface.merged
    if not len(whole.faces):
        return False
    a = whole.faces.reshape(-1)
    b = whole.faces[:, [1, 2, 0]].reshape(-1)
    size = len(whole.vertices)
    there, back = np.sort(a * size + b), np.sort(b * size + a)
    return bool((there == back).all())


def volume(mesh: Mesh) -> float:
    """Volume inside a closed mesh: the sum of signed tetrahedra from its middle."""
    vertices = mesh.vertices - mesh.vertices.mean(axis=0)
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


# Voxels of this size, in the unit sphere, keep one point each: some 60,000 of a surface of area 4, in half precision
# (off by 0.0003 at most) 400 KB.
SUPPORT_VOXEL = 1 / 128


def keep_faces(mesh: Mesh, kept: NDArray[np.bool_]) -> Mesh:
    """The mesh with only the faces where ``kept`` ``(F,)`` is true, and the vertices they use."""
    faces = mesh.faces[kept]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=mesh.faces.dtype) - 1
    return dataclasses.replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=number[faces].astype(mesh.faces.dtype),
        normals=None if mesh.normals is None else mesh.normals[used],
        colors=None if mesh.colors is None else mesh.colors[used],
    )


def keep_largest(mesh: Mesh) -> Mesh:
    """Keep the connected component (through shared vertices) with the largest area."""
    component = component_of_faces(mesh)
    return keep_faces(mesh, component == np.bincount(component, weights=face_normals(mesh)[1]).argmax())


class Supported(NamedTuple):
    """The components that rest on points, the number of others, and their area as a share of the whole."""

    mesh: Mesh
    dropped: int
    area: float


def drop_unsupported(
    mesh: Mesh, points: NDArray[np.floating], *, radius: float | None = None, least: float = 0.05
) -> Supported:
    """Drop the connected components that no input points ``(N, 3)`` support: blobs, where nothing was measured.

    A component is kept on two conditions. At least the share ``least`` of its area has its corners within ``radius``
    (by default `support_radius`) of some point. At least three points are nearest to it, or half of those that an area
    of this size has elsewhere. If none is kept, all stay: mesh and points do not belong together.

    A part that was measured has nearly all of its area near points, an open scan that the fit closed behind a third; a
    blob has none, or what a stray point or a neighbouring part touches. Raises a ValueError without points or radius.
    """
    if len(points) == 0:
        raise ValueError("points: there are none to support anything")
    reach = support_radius(points) if radius is None else radius
    if not reach > 0:
        raise ValueError(f"radius={reach}: expected > 0")
    component = component_of_vertices(mesh)
    found = footing(mesh, component, KDTree(points), reach)
    kept = found.stands(spacing_of(np.asarray(points, np.float64)), least=least)
    if kept.all() or not kept.any():
        return Supported(mesh, 0, 0.0)
    return Supported(
        keep_faces(mesh, kept[component[mesh.faces[:, 0]]]),
        int((~kept).sum()),
        float(found.area[~kept].sum() / found.area.sum()),
    )


class Footing(NamedTuple):
    """Of each component ``(C,)``: its area, how much of it is near points, and how many points are nearest to it."""

    area: Float64
    near: Float64
    points: Float64

    def stands(self, spacing: float, *, least: float = 0.05) -> NDArray[np.bool_]:
        """Which components rest on points with this spacing, see `drop_unsupported`."""
        kept = (self.near >= least * self.area) & (self.near > 0)
        if kept.sum() > 1:
            # Around one or two strays a fit may close a bubble as small as their spacing.
            kept &= self.points >= np.minimum(3, self.area / max(spacing, 1e-300) ** 2 / 2)
        return kept


def footing(mesh: Mesh, component: NDArray[np.integer], tree: KDTree, reach: float) -> Footing:
    """The `Footing` of a mesh, with the ``component`` ``(V,)`` of its vertices, on the points of a tree."""
    number = component[mesh.faces[:, 0]]
    count = int(number.max()) + 1
    share = np.isfinite(tree.query(mesh.vertices, distance_upper_bound=reach, workers=-1)[0])[mesh.faces].mean(axis=1)
    areas = face_normals(mesh)[1]
    used = np.unique(mesh.faces)
    corners = mesh.vertices[used]
    around = ((tree.data >= corners.min(axis=0) - reach) & (tree.data <= corners.max(axis=0) + reach)).all(axis=1)
    near, whose = KDTree(corners).query(tree.data[around], distance_upper_bound=reach, workers=-1)
    own = component[used[np.asarray(whose)[np.isfinite(near)]]]
    area, near_area, points = (
        np.bincount(which, weights, count).astype(np.float64)
        for which, weights in ((number, areas), (number, areas * share), (own, np.ones(len(own))))
    )
    return Footing(area, near_area, points)


def without_blobs(
    mesh: Mesh, points: NDArray[np.floating], radius: float, say: Callable[[str], None] | None = None
) -> Mesh:
    """What `drop_unsupported` leaves of a mesh; ``say`` is called with a line about what it drops."""
    left = drop_unsupported(mesh, points, radius=radius)
    if left.dropped and say is not None:
        parts = f"{left.dropped:,} component{'s' * (left.dropped > 1)}"
        say(f"removed {parts} that no points support ({left.area:.2g} of the area); --keep-unsupported keeps them")
    return left.mesh


def support_radius(points: NDArray[np.floating], *, error: float = 0.0) -> float:
    """How near its points ``(N, 3)`` a measured surface passes: 3 √(spacing² + error²), of its rms error there."""
    return 3 * float(np.hypot(spacing_of(np.asarray(points, np.float64)), error))


def without_voids(mesh: Mesh) -> Mesh:
    """Drop closed components that are turned inside out: walls of voids, which no camera outside can see."""
    component = component_of_faces(mesh)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    volume = np.bincount(component, weights=(np.cross(a, b) * c).sum(axis=1))
    starts, ends = mesh.faces.ravel().astype(np.int64), np.roll(mesh.faces, -1, axis=1).ravel().astype(np.int64)
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    _, edge, uses = np.unique(low * len(mesh.vertices) + high, return_inverse=True, return_counts=True)
    is_open = np.zeros(len(volume), bool)
    is_open[np.repeat(component, 3)[uses[edge] == 1]] = True
    return keep_faces(mesh, (is_open | (volume >= 0))[component])


def in_region(mesh: Mesh) -> Mesh | None:
    """The part of a mesh in the unit sphere, without walls of voids; None if there is none.

    Outside, no ray is ever sampled, so that a network may have any sign there.
    """
    kept = in_sphere(mesh)
    return without_voids(keep_faces(mesh, kept)) if kept.any() else None


def in_sphere(mesh: Mesh) -> NDArray[np.bool_]:
    """Which faces ``(F,)`` have all corners in the unit sphere."""
    return ((mesh.vertices**2).sum(axis=1) <= 1)[mesh.faces].all(axis=1)


def trim_distance(mesh: Mesh, points: NDArray[np.floating], distance: float) -> Mesh:
    """Keep the faces whose corners are all within ``distance`` of some of ``points`` ``(N, 3)``.

    Raises a ValueError for a distance that is not positive, and an InputError if no face is left.
    """
    if not distance > 0:
        raise ValueError(f"distance={distance}: expected > 0")
    limit = np.nextafter(distance, np.inf)  # the tree's bound is exclusive
    nearest = KDTree(points).query(mesh.vertices, distance_upper_bound=limit)[0]
    kept = (nearest <= distance)[mesh.faces].all(axis=1)
    if not kept.any():
        raise InputError(
            f"--trim-distance: none of {len(mesh.faces)} faces is within {distance:.4g} of the points; raise it"
        )
    return keep_faces(mesh, kept)


class Support(NamedTuple):
    """Points ``(N, 3)`` of the unit sphere that support a surface, and how near some of them it passes.

    ``visible``: the points are those visible in the training views, so that parts further away are unobserved.
    """

    points: NDArray[np.float64]
    radius: float
    visible: bool = False


def thinned(points: NDArray[np.floating], *, visible_within: float | None = None) -> dict[str, Tensor]:
    """The tensors of `SUPPORT_FILE` for unit-sphere points ``(N, 3)``, of a fit or visible in views: one per voxel.

    ``visible_within``: distance from some point up to which the surface counts as visible.
    """
    kept = points[voxel_representatives(np.asarray(points, np.float64), SUPPORT_VOXEL)]
    reach = None if visible_within is None else torch.tensor(float(np.hypot(visible_within, SUPPORT_VOXEL)))
    return {"points": torch.from_numpy(kept).half()} | ({} if reach is None else {"seen_within": reach})


def visible_part(mesh: Mesh, support: Support) -> tuple[Mesh | None, float]:
    """The faces visible in the training views, or None without any, and the share of area that is not visible."""
    near = KDTree(support.points).query(mesh.vertices, distance_upper_bound=support.radius, workers=-1)[0]
    kept = np.isfinite(near)[mesh.faces].all(axis=1)
    areas = face_normals(mesh)[1]
    return (keep_faces(mesh, kept) if kept.any() else None), float(areas[~kept].sum() / max(areas.sum(), 1e-300))


def read_support(field: Path, record: dict[str, Any], level: int) -> Support | None:
    """The support of a level of the field in a file; None if it is no run's, or that level is still in training.

    ``record`` is what ``run.json`` holds. Raises an InputError if the points are damaged or of another run.
    """
    if "tiles" in record:
        runs = [field.parent / tile["run"] for tile in record["tiles"]]
        return support_of_tiles(runs, Similarity(**record["similarity"]), level)
    path = field.with_name(SUPPORT_FILE)
    stages = record.get("stages", [])
    photographed = "region" in record
    if field.name != FIELD_FILE or not path.is_file() or not (photographed or level < len(stages)):
        return None
    tensors, about = load_state(field.parent, name=SUPPORT_FILE)
    if about.get("generation") != record.get("generation"):
        raise InputError(f"{path}: is not of the run of {field}; bring back both, or fit again")
    if "points" not in tensors or tensors["points"].ndim != 2 or tensors["points"].shape[1] != 3:
        raise InputError(f"{path}: damaged (no points); remove it, or fit again")
    points = tensors["points"].double().numpy()
    if photographed:
        if "seen_within" not in tensors or not 0 < float(tensors["seen_within"]) < np.inf:
            raise InputError(f"{path}: damaged (no length); remove it, or reconstruct again")
        return Support(points, float(tensors["seen_within"]), visible=True) if len(points) else None
    error = stages[level]["rms_at_points"] / record["similarity"]["scale"]
    return Support(points, support_radius(points, error=error))


def support_of_tiles(runs: Sequence[Path], home: Similarity, level: int) -> Support | None:
    """The supports of the ``runs`` of tiles, in the coordinates of ``home``; None if one of them has none."""
    found: list[Support] = []
    for run in runs:
        own = read_record(run)
        support = read_support(run / FIELD_FILE, own, min(level, len(own["stages"]) - 1))
        if support is None:
            return None
        placed = Similarity(**own["similarity"]).within(home)
        found.append(Support(placed.to_input(support.points), support.radius * placed.scale))
    return Support(np.concatenate([part.points for part in found]), max(part.radius for part in found))
