"""How far a mesh is from a reference: the figures of the paper's tables, and a true volumetric IoU.

Lengths are in units of the REFERENCE's bounding sphere (paper, Sec. 5), between samples uniform by area.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...neural_fields import InputError, Mesh, Similarity
from .raster import Float64, Int64, cover
from .surface import components, is_closed, read_surface, sample_points

ViewCounts = Callable[[Mesh, Float64], Int64]
"""How many photographs see points ``(N, 3)`` of the reference, both in its own coordinates; ``(N,)``."""


@dataclass(frozen=True)
class Distances:
    """Mean unsquared distances in INPUT units, as in DTU's evaluation (Jensen et al. 2014); None if nothing is visible.

    Attributes:
        accuracy: from the mesh to the reference.
        completeness: from the reference to the mesh.
        overall: the mean of both.
    """

    accuracy: float | None
    completeness: float | None
    overall: float | None


@dataclass(frozen=True)
class Visible:
    """Distances where a photograph sees the reference: of its samples there, and of those whose nearest one is there.

    Attributes:
        share: of the reference's area.
        distances: of the mesh.
        floors: of another sampling of the reference.
    """

    share: float
    distances: Distances
    floors: Distances


@dataclass(frozen=True)
class Metrics:
    """Figures of one mesh against one reference; lengths are in units of the reference's bounding sphere.

    Attributes:
        chamfer: mean squared distance mesh → reference plus mean squared distance reference → mesh.
        chamfer_floor: the same between two samplings of the reference, the score of a perfect mesh; None for a cloud.
        accuracy: the first half of ``chamfer``.
        completeness: its second half.
        hausdorff: the largest squared distance, either way.
        f_score: harmonic mean of the shares of samples within ``threshold`` (not squared) of the other surface.
        normal_consistency: mean of |n·n'| between samples and nearest neighbours, both ways; None without normals.
        iou: volume of the intersection over that of the union; None for a cloud, or with too many holes.
        shell_iou: the paper's "IoU": overlap of the sets of voxels, ``voxel`` wide, that hold samples.
        components: connected components of the mesh.
        closed: whether every edge of the mesh has a face on both sides.
        mean_distance: mean unsquared distance over both directions, in INPUT units; ``scale`` of them are one unit.
        samples: on each surface.
        notes: what the reader of the figures should know.
        visible: figures of what photographs see; None if that was not asked for.
    """

    chamfer: float
    chamfer_floor: float | None
    accuracy: float
    completeness: float
    hausdorff: float
    f_score: float
    threshold: float
    normal_consistency: float | None
    iou: float | None
    shell_iou: float
    voxel: float
    components: int
    closed: bool
    vertices: int
    faces: int
    mean_distance: float
    scale: float
    samples: int
    seed: int
    notes: tuple[str, ...]
    visible: Visible | None = None


def evaluate_files(
    mesh: str | Path,
    reference: str | Path,
    *,
    samples: int = 500_000,
    seed: int = 0,
    view_counts: ViewCounts | None = None,
) -> Metrics:
    """`evaluate_surfaces` of two files; the reference may be a point cloud.

    Raises an InputError if a file cannot be read or has no faces: the mesh, or the reference with ``view_counts``.
    """
    surface = read_surface(mesh)
    if not len(surface.faces):
        raise InputError(f"{mesh}: holds points but no faces, so it is no mesh to evaluate; give the mesh first")
    truth = read_surface(reference)
    if view_counts is not None and not len(truth.faces):
        raise InputError(f"{reference}: holds points, whose visibility in photographs is unknown; give a mesh")
    return evaluate_surfaces(surface, truth, samples=samples, seed=seed, view_counts=view_counts)


def evaluate_surfaces(
    mesh: Mesh,
    reference: Mesh,
    *,
    samples: int = 500_000,
    seed: int = 0,
    threshold: float = 0.01,
    voxel: float = 0.01,
    columns: int = 512,
    view_counts: ViewCounts | None = None,
) -> Metrics:
    """Compare a mesh with a reference surface or cloud, both in the same coordinates.

    Args:
        mesh: the surface to judge.
        reference: the truth. Without faces it is a cloud: distances are to its points.
        samples: points drawn on each surface (500 K in the paper).
        seed: of the samples.
        threshold: for the F-score, in units of the reference's bounding sphere.
        voxel: for the shell IoU (0.01 in the paper's code), same units.
        columns: for the volumetric IoU, columns along the longest side.
        view_counts: how many photographs see points of the reference, which then has faces.

    Raises:
        ValueError: ``samples`` is not positive, or photographs are counted of a cloud.
    """
    if samples < 1:
        raise ValueError(f"samples={samples}: expected > 0")
    is_cloud = not len(reference.faces)
    if is_cloud and view_counts is not None:
        raise ValueError("view_counts: points hide nothing; expected a reference with faces")
    given, similarity = reference, Similarity.to_unit_sphere(reference.used_vertices())
    mesh, reference = mesh.moved(similarity), reference.moved(similarity)
    of_mesh, of_reference, of_floor = np.random.default_rng(seed).spawn(3)
    points, normals = sample_points(mesh, samples, of_mesh)
    target, target_normals = sample_points(reference, samples, of_reference)

    ways = _ways(points, target)
    forward, backward = ways.there, ways.back
    consistency = None
    if normals is not None and target_normals is not None:
        there = np.abs((normals * target_normals[ways.nearest]).sum(axis=1)).mean()
        back = np.abs((target_normals * normals[ways.nearest_back]).sum(axis=1)).mean()
        consistency = float(there + back) / 2

    notes, closed = [], is_closed(mesh)
    floor = iou = visible = None
    if is_cloud:
        notes.append("the reference is a point cloud: distances are to its points; no floor, no iou")
    else:
        again = _ways(sample_points(reference, samples, of_floor)[0], target)
        floor = sum(again.squared())
        if view_counts is not None:
            seen = view_counts(given, similarity.to_input(target)) > 0
            visible = Visible(float(seen.mean()), *(w.distances_where(seen, similarity.scale) for w in (ways, again)))
        iou, iou_notes = _iou(mesh, reference, columns, closed=closed)
        notes.extend(iou_notes)
    precision, recall = float((forward < threshold).mean()), float((backward < threshold).mean())
    accuracy, completeness = ways.squared()
    return Metrics(
        chamfer=accuracy + completeness,
        chamfer_floor=floor,
        accuracy=accuracy,
        completeness=completeness,
        hausdorff=float(max(forward.max(), backward.max()) ** 2),
        f_score=2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        threshold=threshold,
        normal_consistency=consistency,
        iou=iou,
        shell_iou=shell_iou(points, target, voxel=voxel),
        voxel=voxel,
        components=components(mesh),
        closed=closed,
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        mean_distance=float(forward.mean() + backward.mean()) / 2 * similarity.scale,
        scale=similarity.scale,
        samples=samples,
        seed=seed,
        notes=tuple(notes),
        visible=visible,
    )


def chamfer(a: Float64, b: Float64) -> tuple[float, float]:
    """Mean squared distances of ``a`` ``(N, 3)`` to ``b`` ``(M, 3)``, and back; the tables give their sum."""
    return _ways(a, b).squared()


class _Ways(NamedTuple):
    """Distances of samples ``(N,)`` to the reference's, and back ``(M,)``, and the indices of the nearest ones."""

    there: Float64
    nearest: Int64
    back: Float64
    nearest_back: Int64

    def squared(self) -> tuple[float, float]:
        """Mean squared distances, both ways."""
        return float((self.there**2).mean()), float((self.back**2).mean())

    def distances_where(self, visible: NDArray[np.bool_], scale: float) -> Distances:
        """Mean distances, times ``scale``, where samples of the reference are ``visible`` ``(M,)``."""
        there, back = self.there[visible[self.nearest]], self.back[visible]
        if not (len(there) and len(back)):
            return Distances(None, None, None)
        accuracy, completeness = scale * float(there.mean()), scale * float(back.mean())
        return Distances(accuracy, completeness, (accuracy + completeness) / 2)


def _ways(a: Float64, b: Float64) -> _Ways:
    """From samples of a surface ``(N, 3)`` to those of the reference ``(M, 3)``, and back."""
    there, nearest = KDTree(b, balanced_tree=False).query(a, workers=-1)
    back, nearest_back = KDTree(a, balanced_tree=False).query(b, workers=-1)
    return _Ways(np.asarray(there), np.asarray(nearest), np.asarray(back), np.asarray(nearest_back))


def shell_iou(a: Float64, b: Float64, *, voxel: float = 0.01) -> float:
    """Overlap of the voxels that hold points of ``a`` ``(N, 3)`` and of ``b`` ``(M, 3)``, on ONE grid.

    The paper's code gives each set its own grid origin, so that equal shapes need not score 1.
    """
    low = np.minimum(a.min(axis=0), b.min(axis=0))
    cells = [np.floor((points - low) / voxel).astype(np.int64) for points in (a, b)]
    shape = np.maximum(cells[0].max(axis=0), cells[1].max(axis=0)) + 1
    keys = [np.unique((c[:, 0] * shape[1] + c[:, 1]) * shape[2] + c[:, 2]) for c in cells]
    common = len(np.intersect1d(*keys, assume_unique=True))
    return common / (len(keys[0]) + len(keys[1]) - common)


def _iou(mesh: Mesh, reference: Mesh, columns: int, *, closed: bool) -> tuple[float | None, list[str]]:
    """Volumetric IoU, with a note where it is approximate or cannot be had."""
    volumes = overlap(mesh, reference, columns=columns)
    both = {"the mesh": closed, "the reference": is_closed(reference)}
    holes = [name for name, whole in both.items() if not whole]
    if not volumes.union > 0 or volumes.broken > 0.1:
        share = f"{volumes.broken:.0%} of the columns enter and leave a different number of times"
        return None, [f"no iou: {' and '.join(holes) or 'a surface'} is not closed ({share})"]
    note = f"not closed: {' and '.join(holes)}; iou leaves out {volumes.broken:.2%} of the columns"
    return volumes.intersection / volumes.union, [note] if holes else []


def format_metrics(metrics: Metrics) -> str:
    """A table for people, one figure a line."""
    m = metrics

    def optional(value: float | None, form: str) -> str:
        return "n/a" if value is None else format(value, form)

    visible = []
    if m.visible is not None:
        visible = [("where a photograph sees the reference", "", f"{m.visible.share:.2%} of the area; in its units")]
        floors = vars(m.visible.floors)
        visible += [
            (f"  {name}", optional(distance, ".4g"), f"sampling floor {optional(floors[name], '.4g')}")
            for name, distance in vars(m.visible.distances).items()
        ]
    lines = [
        ("chamfer (squared L2, both ways)", f"{m.chamfer:.3e}", f"sampling floor {optional(m.chamfer_floor, '.3e')}"),
        ("  mesh → reference", f"{m.accuracy:.3e}", ""),
        ("  reference → mesh", f"{m.completeness:.3e}", ""),
        ("hausdorff (squared)", f"{m.hausdorff:.3e}", ""),
        ("f_score", f"{m.f_score:.4f}", f"within {m.threshold:g}"),
        ("normal_consistency", optional(m.normal_consistency, ".4f"), "mean |n·n'|"),
        ("iou", optional(m.iou, ".4f"), "of volumes"),
        ("shell_iou", f"{m.shell_iou:.4f}", f"of surface voxels of {m.voxel:g}"),
        ("components", f"{m.components}", "closed" if m.closed else "with open edges"),
        ("vertices, faces", f"{m.vertices:,}", f"{m.faces:,}"),
        *visible,
        ("mean distance, input units", f"{m.mean_distance:.4g}", f"1 unit above = {m.scale:.6g} input units"),
    ]
    rows = [f"{name:<32} {value:>10}  {remark}".rstrip() for name, value, remark in lines]
    return "\n".join([*rows, f"{m.samples:,} samples on each surface, seed {m.seed}", *(f"note: {n}" for n in m.notes)])


class Overlap(NamedTuple):
    """Volumes of two meshes, of their intersection and their union, means over the three axes.

    ``broken`` is the share of the columns left out because they enter and leave a surface a different number of times;
    0 for closed, consistently oriented meshes.
    """

    first: float
    second: float
    intersection: float
    union: float
    broken: float


def overlap(first: Mesh, second: Mesh, *, columns: int = 512) -> Overlap:
    """Volumes inside two meshes in the same coordinates, where the winding number is not zero.

    Lengths inside are exact along lines of the three axes; the only discretisation is their number, ``columns`` along
    the longest side of the box around both. Raises a ValueError if that is not positive or a surface has no faces.
    """
    if columns < 1:
        raise ValueError(f"columns={columns}: expected > 0")
    if not (len(first.faces) and len(second.faces)):
        raise ValueError("surfaces: both must have faces")
    first, second = first.merged, second.merged
    both = np.concatenate((first.vertices, second.vertices))
    low, high = both.min(axis=0), both.max(axis=0)
    step = float((high - low).max()) / columns
    volumes = np.zeros(4)
    met = broken = 0
    for axis in range(3):
        # A cyclic change of axes keeps the orientation of the triangles.
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]
        counts = np.maximum(np.ceil((high - low)[order[:2]] / step).astype(int), 1)
        shape = (int(counts[0]), int(counts[1]))
        crossings = [_crossings(mesh, order, low, step, shape) for mesh in (first, second)]
        lengths, met_here, broken_here = _inside_lengths(*crossings, size=shape[0] * shape[1])
        volumes += lengths * step**2 / 3
        met, broken = met + met_here, broken + broken_here
    return Overlap(*map(float, volumes), broken=broken / max(met, 1))


def _crossings(
    mesh: Mesh, order: list[int], low: Float64, step: float, shape: tuple[int, int]
) -> tuple[Int64, Float64, NDArray[np.int8]]:
    """Column, height and sign of every crossing, each ``(K,)``."""
    placed = mesh.vertices[:, order]
    # Columns do not stand in the middle of their cells: models like to have their edges there.
    xy = (placed[:, :2] - low[order[:2]]) / step - (0.5 + 0.0372036, 0.5 - 0.0618034)
    column, height, sign = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0, np.int8)]
    for found in cover(xy, mesh.faces, shape):
        column.append(found.column)
        height.append((found.weights * placed[mesh.faces[found.face], 2]).sum(axis=1))
        sign.append(found.sign)
    return np.concatenate(column), np.concatenate(height), np.concatenate(sign)


def _inside_lengths(
    first: tuple[Int64, Float64, NDArray[np.int8]], second: tuple[Int64, Float64, NDArray[np.int8]], *, size: int
) -> tuple[Float64, int, int]:
    """Total lengths inside first, second, both, either; columns met; columns broken (and left out)."""
    sums = [np.bincount(c, weights=s, minlength=size) for c, _, s in (first, second)]
    met = np.bincount(np.concatenate((first[0], second[0])), minlength=size) > 0
    broken = (sums[0] != 0) | (sums[1] != 0)
    column = np.concatenate((first[0], second[0]))
    height = np.concatenate((first[1], second[1]))
    turns = np.zeros((len(column), 2), np.int64)  # winding of each mesh, changed by each crossing
    turns[: len(first[0]), 0] = first[2]
    turns[len(first[0]) :, 1] = second[2]
    kept = np.flatnonzero(~broken[column])
    kept = kept[np.lexsort((height[kept], column[kept]))]
    # Windings return to zero at the end of each column, so one running sum serves all of them.
    inside = np.cumsum(turns[kept], axis=0)[:-1] != 0
    gap = np.where(np.diff(column[kept]) == 0, np.diff(height[kept]), 0.0)
    a, b = inside[:, 0], inside[:, 1]
    lengths = np.array([gap[a].sum(), gap[b].sum(), gap[a & b].sum(), gap[a | b].sum()])
    return lengths, int(met.sum()), int(broken.sum())
