"""How far a mesh is from a reference: the figures of the paper's tables, and a true volumetric IoU.

Both shapes are moved by the similarity that puts the REFERENCE into the unit sphere (paper, Sec. 5); distances are
between area-weighted uniform samples of the two surfaces. Volumes are summed over columns, lines along one axis: sorted
along one, the crossings of an oriented closed surface give the winding number between them, so that lengths inside are
exact, and only the choice of columns is a discretisation.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...neural_fields import InputError, Similarity
from ...neural_fields.backend.files import write_json
from .raster import cover
from .roughness import feet_among, roughness
from .surface import Surface, components, is_closed, read_surface, sample_points
from .witnessed import Seen, Ways, Witnesses, seen_figures, seen_lines

__all__ = [
    "Metrics",
    "Overlap",
    "chamfer",
    "evaluate_files",
    "evaluate_surfaces",
    "format_metrics",
    "overlap",
    "write_metrics",
]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

# Where a column stands in its cell. Not the middle: models like to have their edges there.
OFFSET = (0.5 + 0.0372036, 0.5 - 0.0618034)

# Samples of the mesh that may be the foot of one of the reference.
FEET = 4


@dataclass(frozen=True)
class Metrics:
    """Figures of one mesh against one reference; lengths are in units of the reference's bounding sphere.

    Attributes:
        chamfer: mean squared distance mesh → reference plus mean squared distance reference → mesh.
        chamfer_floor: the same between two independent samplings of the reference: what a perfect mesh
            would score. None for a point cloud.
        accuracy: the first half of ``chamfer``, mesh → reference.
        completeness: its second half, reference → mesh.
        hausdorff: the largest squared distance, either way.
        f_score: harmonic mean of the shares of samples within ``threshold`` of the other surface.
        threshold: distance (not squared) for ``f_score``.
        normal_consistency: mean of |n·n'| between samples and their nearest neighbours, over both
            directions. None for a reference without normals.
        iou: volume of the intersection over volume of the union. None when the reference is a point
            cloud, or when a surface has so many holes that inside cannot be told.
        shell_iou: the paper's "IoU": overlap of the sets of voxels that hold samples.
        voxel: size of the voxels of ``shell_iou``.
        components: connected components of the mesh.
        closed: whether every edge of the mesh has a face on both sides.
        vertices: vertices of the mesh.
        faces: faces of the mesh.
        mean_distance: mean unsquared distance over both directions, in INPUT units.
        scale: input units per unit.
        samples: samples on each surface.
        seed: seed of the samples.
        notes: what the reader of the figures should know.
        flat_share: share of the reference's area that is flat; see `roughness` for this and all that follow. None for
            a cloud.
        flat_angle: median angle, in degrees, between the normals on flat places, both without their low frequencies:
            orange peel. None where no place is flat.
        flat_angle_90: what nine tenths of those angles are below.
        edge_angle: the median near the reference's sharp edges. None where there are none.
        edge_angle_90: what nine tenths of those are below.
        ripple: the residual noise: median height of the waves on flat places.
        seen: the same distances by how many photographs see the place; None if nobody asked.
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
    flat_share: float | None = None
    flat_angle: float | None = None
    flat_angle_90: float | None = None
    edge_angle: float | None = None
    edge_angle_90: float | None = None
    ripple: float | None = None
    seen: Seen | None = None


def evaluate_files(
    mesh: str | Path,
    reference: str | Path,
    *,
    samples: int = 500_000,
    seed: int = 0,
    witnesses: Witnesses | None = None,
) -> Metrics:
    """``evaluate_surfaces`` on two files; the reference may be a point cloud.

    Args:
        mesh: the file to judge.
        reference: that of the truth.
        samples: see `evaluate_surfaces`.
        seed: of the samples.
        witnesses: see `evaluate_surfaces`.

    Raises:
        InputError: a file cannot be read, or the first one holds no faces; or the second, where there are witnesses.
    """
    surface = read_surface(mesh)
    if not len(surface.faces):
        raise InputError(f"{mesh}: holds points but no faces, so it is no mesh to evaluate; give the mesh first")
    truth = read_surface(reference)
    if witnesses is not None and not len(truth.faces):
        raise InputError(f"{reference}: points hide nothing, so nobody knows what photographs see of them; give a mesh")
    return evaluate_surfaces(surface, truth, samples=samples, seed=seed, witnesses=witnesses)


def evaluate_surfaces(
    mesh: Surface,
    reference: Surface,
    *,
    samples: int = 500_000,
    seed: int = 0,
    threshold: float = 0.01,
    voxel: float = 0.01,
    columns: int = 512,
    witnesses: Witnesses | None = None,
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
        witnesses: who says how many photographs see points of the reference, which then has faces; None asks nobody.

    Raises:
        ValueError: ``samples`` is not positive, or there are witnesses of a cloud.
    """
    if samples < 1:
        raise ValueError(f"samples={samples}: expected > 0")
    is_cloud = not len(reference.faces)
    if is_cloud and witnesses is not None:
        raise ValueError("witnesses: points hide nothing; expected a reference with faces")
    given, similarity = reference, Similarity.to_unit_sphere(reference.used_vertices())
    mesh, reference = mesh.moved(similarity), reference.moved(similarity)
    of_mesh, of_reference, of_floor = np.random.default_rng(seed).spawn(3)
    points, normals = sample_points(mesh, samples, of_mesh)
    target, target_normals = sample_points(reference, samples, of_reference)

    forward, nearest = KDTree(target, balanced_tree=False).query(points, workers=-1)
    reach, candidates = KDTree(points, balanced_tree=False).query(target, k=min(FEET, len(points)), workers=-1)
    candidates = np.asarray(candidates).reshape(len(target), -1)
    backward, nearest_back = np.asarray(reach).reshape(len(target), -1)[:, 0], candidates[:, 0]
    consistency = None
    if normals is not None and target_normals is not None:
        there = np.abs((normals * target_normals[nearest]).sum(axis=1)).mean()
        back = np.abs((target_normals * normals[nearest_back]).sum(axis=1)).mean()
        consistency = float(there + back) / 2

    notes, closed = [], is_closed(mesh)
    floor = iou = rough = seen = None
    if is_cloud:
        notes.append("the reference is a point cloud: distances are to its points; no floor, no iou, no roughness")
    else:
        again = _ways(sample_points(reference, samples, of_floor)[0], target)
        floor = float(again.there.mean() + again.back.mean())
        if witnesses is not None:
            counts = witnesses(given, similarity.to_input(target))
            seen = seen_figures(counts, Ways(forward**2, np.asarray(nearest), backward**2), again)
        iou, iou_notes = _iou(mesh, reference, columns, closed=closed)
        notes.extend(iou_notes)
        if normals is not None and target_normals is not None:
            feet = feet_among(target, points, normals, candidates)
            rough = roughness(target, target_normals, points[feet], normals[feet], reference)
    precision, recall = float((forward < threshold).mean()), float((backward < threshold).mean())
    accuracy, completeness = float((forward**2).mean()), float((backward**2).mean())
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
        seen=seen,
        **({} if rough is None else rough._asdict()),
    )


def chamfer(a: Float64, b: Float64) -> tuple[float, float]:
    """The two halves of the squared-L2 Chamfer distance of point sets ``(N, 3)`` and ``(M, 3)``.

    ``mean_a min_b |a − b|²`` and ``mean_b min_a |a − b|²``; the tables give their sum.
    """
    ways = _ways(a, b)
    return float(ways.there.mean()), float(ways.back.mean())


def _ways(a: Float64, b: Float64) -> Ways:
    """From samples of a surface ``(N, 3)`` to those of the reference ``(M, 3)``, and back."""
    forward, nearest = KDTree(b, balanced_tree=False).query(a, workers=-1)
    backward, _ = KDTree(a, balanced_tree=False).query(b, workers=-1)
    return Ways(np.asarray(forward) ** 2, np.asarray(nearest), np.asarray(backward) ** 2)


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


def _iou(mesh: Surface, reference: Surface, columns: int, *, closed: bool) -> tuple[float | None, list[str]]:
    """Volumetric IoU, with a note where it is approximate or cannot be had."""
    volumes = overlap(mesh, reference, columns=columns)
    both = {"the mesh": closed, "the reference": is_closed(reference)}
    holes = [name for name, whole in both.items() if not whole]
    if not volumes.union > 0 or volumes.broken > 0.1:
        share = f"{volumes.broken:.0%} of the columns enter and leave a different number of times"
        return None, [f"no iou: {' and '.join(holes) or 'a surface'} is not closed ({share})"]
    note = f"{' and '.join(holes)} not closed: iou leaves out {volumes.broken:.2%} of the columns"
    return volumes.intersection / volumes.union, [note] if holes else []


def format_metrics(metrics: Metrics) -> str:
    """A table for people, one figure a line."""
    m = metrics

    def optional(value: float | None, form: str) -> str:
        return "n/a" if value is None else format(value, form)

    def below(median: float | None, most: float | None, where: str) -> tuple[str, str]:
        return optional(median, ".2f"), where if most is None else f"{where}, degrees; nine tenths below {most:.2f}"

    flat = "flat places" if m.flat_share is None else f"flat places ({m.flat_share:.0%})"
    lines = [
        ("chamfer (squared L2, both ways)", f"{m.chamfer:.3e}", f"sampling floor {optional(m.chamfer_floor, '.3e')}"),
        ("  mesh → reference", f"{m.accuracy:.3e}", ""),
        ("  reference → mesh", f"{m.completeness:.3e}", ""),
        ("hausdorff (squared)", f"{m.hausdorff:.3e}", ""),
        ("f_score", f"{m.f_score:.4f}", f"within {m.threshold:g}"),
        ("normal_consistency", optional(m.normal_consistency, ".4f"), "mean |n·n'|"),
        ("high-frequency normal error", *below(m.flat_angle, m.flat_angle_90, flat)),
        ("", *below(m.edge_angle, m.edge_angle_90, "near sharp edges")),
        ("ripple", optional(m.ripple, ".2e"), "height of the waves on flat places"),
        ("iou", optional(m.iou, ".4f"), "of volumes"),
        ("shell_iou", f"{m.shell_iou:.4f}", f"of surface voxels of {m.voxel:g}"),
        ("components", f"{m.components}", "closed" if m.closed else "with open edges"),
        ("vertices, faces", f"{m.vertices:,}", f"{m.faces:,}"),
        *(() if m.seen is None else seen_lines(m.seen)),
        ("mean distance, input units", f"{m.mean_distance:.4g}", f"1 unit above = {m.scale:.6g} input units"),
    ]
    rows = [f"{name:<32} {value:>10}  {remark}".rstrip() for name, value, remark in lines]
    return "\n".join([*rows, f"{m.samples:,} samples on each surface, seed {m.seed}", *(f"note: {n}" for n in m.notes)])


def write_metrics(path: str | Path, metrics: Metrics) -> None:
    """Write the figures as JSON, through a temporary file beside the target."""
    write_json(path, dataclasses.asdict(metrics))


class Overlap(NamedTuple):
    """Volumes, averaged over the three axes, and the share of columns that had to be left out.

    Attributes:
        first: volume of the first mesh.
        second: volume of the second.
        intersection: volume inside both.
        union: volume inside either.
        broken: share of the columns that meet a surface but enter and leave it a different number of
            times; 0 for closed, consistently oriented meshes.
    """

    first: float
    second: float
    intersection: float
    union: float
    broken: float


def overlap(first: Surface, second: Surface, *, columns: int = 512) -> Overlap:
    """Measure two meshes; inside is where the winding number is not zero.

    Args:
        first: a mesh.
        second: another, in the same coordinates.
        columns: along the longest side of the box around both.

    Raises:
        ValueError: ``columns`` is not positive, or a surface has no faces.
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
    mesh: Surface, order: list[int], low: Float64, step: float, shape: tuple[int, int]
) -> tuple[Int64, Float64, NDArray[np.int8]]:
    """Column, height and sign of every crossing, each ``(K,)``."""
    placed = mesh.vertices[:, order]
    xy = (placed[:, :2] - low[order[:2]]) / step - OFFSET
    column, height, sign = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0, np.int8)]
    for found in cover(xy, mesh.faces, shape):
        column.append(found.column)
        height.append((found.weights * placed[mesh.faces[found.face], 2]).sum(axis=1))
        sign.append(found.sign)
    return np.concatenate(column), np.concatenate(height), np.concatenate(sign)


def _inside_lengths(
    first: tuple[Int64, Float64, NDArray[np.int8]],
    second: tuple[Int64, Float64, NDArray[np.int8]],
    *,
    size: int,
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
