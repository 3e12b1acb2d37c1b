"""``mplicits demo``: a scan in, a mesh and a picture of every level out, and how near the result is."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...datasets import STATUE_PLACEMENT, Camera, PointCloud, Statue, orbit, read_cloud, statue_scan, write_cloud_ply
from ...neural_fields import Field, InputError, Placement, Similarity
from ...neural_fields.meshing import Mesh, NoSurfaceError, extract_mesh
from ..fit.plan import FitPlan
from ..fit.train import Run, fit
from ..mesh.files import write_mesh
from ..mesh.plan import mesh_stage
from ..render.picture import contact_sheet, write_picture
from ..render.rasterise import picture_of
from ..render.shade import ShadeOptions, compose, shade
from ..render.trace import trace_view
from ..run.config import load_config
from ..run.costs import Net, values
from ..run.machine import choose_device, format_table, speed
from ..run.progress import progress_bars
from ..run.schedule import Progress, Schedule, Stage
from ..run.settings import FitConfig
from ..surface.surface import from_cloud, from_mesh
from .common import tell_budget

__all__ = ["demo", "distances_to_surface", "draw_levels", "spread_colors"]

Float64 = NDArray[np.float64]

TRAINING_SECONDS = 150.0  # with what else the demo does, under four minutes on two cores
CHECKED = 3_000  # vertices and points whose exact distance to the statue is worked out
TILE = (480, 640)
# Stages, and what they cost: FLOPs of the scan and of exact distances to the statue, values for each traced pixel.
SCAN, MESHES, PICTURE, FIGURES = "scan", "meshes", "picture", "figures"
SCANNED, JUDGED, DRAWN = 4e11, 5e11, 15


def demo(
    cloud: str | Path | None,
    out: str | Path,
    *,
    config: FitConfig | None = None,
    up: str | None = None,
    resolution: int = 320,
) -> int:
    """Fit a cloud, write its meshes and a picture into ``out``, print figures.

    Args:
        cloud: a point-cloud file; None takes the bundled scan, whose exact distance is known.
        out: directory for scan.ply (the bundled scan), run/, mesh.ply, mesh.glb and picture.png.
        config: of the fit; by default the ``default`` preset within ``TRAINING_SECONDS``.
        up: axis that points up in the picture, "y" or "z".
        resolution: of the meshes.

    Raises:
        InputError: the cloud cannot be used, or ``out`` cannot be made.
    """
    started = time.monotonic()
    config = config or load_config(FitConfig, "default", {"time_budget": TRAINING_SECONDS})
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a directory for the demo")
    said: list[str] = []  # once the bars are gone
    with progress_bars() as report:
        _plan(report, config, resolution, scan=cloud is None)
        # Before anything is made.
        points = statue_scan(progress=_counter(report, SCAN)) if cloud is None else read_cloud(cloud)
        out.mkdir(parents=True, exist_ok=True)
        file = out / "scan.ply" if cloud is None else Path(cloud)
        if cloud is None:
            write_cloud_ply(file, points)
        said.append(f"{file}: {len(points):,} points")
        run = fit(file, config, out=out / "run", progress=report)

        meshes, levels = [], run.field.num_levels
        mesh_count, picture_count = _counter(report, MESHES), _counter(report, PICTURE)
        for level in range(levels):
            mesh_count(level, levels)
            meshes.append(_extract(run.field, level, resolution))
        finest = spread_colors(meshes[-1], points, run.similarity)
        # The mesh in the scan's coordinates, and one for other programs: upright, in metres, at the origin.
        placement = Placement("z", "mm", center=True) if cloud is None else Placement(up, center=True)
        for name in ("mesh.ply", "mesh.glb"):
            write_mesh(out / name, finest, run.similarity, placement if name == "mesh.glb" else None)
        mesh_count(levels, levels)
        up = up or ("z" if cloud is None else "y")
        picture = draw_levels(points, run.field, finest, run.similarity, up=up, progress=picture_count)
        write_picture(out / "picture.png", picture)
        _counter(report, FIGURES)(0, 1)
        said.append(_figures(run, meshes, points))
        if cloud is None:
            said.append(_true_errors(points, meshes, run.similarity))
        _counter(report, FIGURES)(1, 1)
    tell_budget(run.record)
    print("\n".join(said))
    print(f"{out / 'mesh.ply'}, mesh.glb, picture.png, run/: {time.monotonic() - started:.0f} s in all")
    return 0


def _plan(schedule: Schedule, config: FitConfig, resolution: int, *, scan: bool) -> None:
    """Say what the demo will do beside the fit, and about how long that takes."""
    machine = speed(choose_device(config.device))
    nets = [Net.siren(width, depth) for width, depth in zip(config.widths, config.depths, strict=True)]
    levels = [nets[: level + 1] for level in range(config.num_levels)]
    meshed = sum(mesh_stage(each, machine, resolution=resolution).seconds for each in levels)
    drawn = sum(machine.points(values(DRAWN * TILE[0] * TILE[1], each)) for each in levels)
    if scan:
        schedule.plan([Stage(SCAN, "scan", machine.points(SCANNED)), *FitPlan(config, 100_000, machine).levels()])
    after = [Stage(MESHES, "mesh", meshed), Stage(PICTURE, "picture", drawn)]
    schedule.follow([*after, Stage(FIGURES, "figures", machine.points(JUDGED if scan else 0.0))])


def _counter(schedule: Schedule, stage: str) -> Callable[[int, int], None]:
    """Tells that so many parts of a stage are done, and of how many."""
    return lambda done, total: schedule(Progress(stage, done, total, done / total, {}))


def _extract(field: Field, level: int, resolution: int) -> Mesh:
    try:
        return extract_mesh(field, level=level, resolution=resolution)
    except NoSurfaceError as error:
        raise InputError(f"level {level} has no surface ({error}); is the cloud a surface, are its normals?") from error


def spread_colors(mesh: Mesh, cloud: PointCloud, similarity: Similarity, *, neighbors: int = 4) -> Mesh:
    """The mesh with each vertex coloured by the nearest points; as it is, where the cloud has no colours.

    Args:
        mesh: in unit-sphere coordinates.
        cloud: in input coordinates.
        similarity: from one to the other.
        neighbors: how many points share in a vertex (2 or more), by the inverse of their squared distances.
    """
    points = from_cloud(cloud).moved(similarity)
    if points.colors is None:
        return mesh
    distance, index = KDTree(points.vertices).query(mesh.vertices, k=neighbors, workers=-1)
    weights = 1 / np.maximum(distance, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    colors = np.einsum("vk,vkc->vc", weights, points.colors[index])
    return dataclasses.replace(mesh, colors=colors.astype(np.float32))


def draw_levels(
    cloud: PointCloud,
    field: Field,
    mesh: Mesh,
    similarity: Similarity,
    *,
    up: str,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.uint8]:
    """The cloud and each level side by side, all from one camera; with the mesh, where that has colours.

    Args:
        cloud: in input coordinates.
        field: whose levels are traced.
        mesh: of the finest, in unit-sphere coordinates.
        similarity: from input to unit-sphere coordinates.
        up: "y" or "z".
        progress: told how many levels are drawn, and of how many.
    """
    tell, levels = progress or (lambda _done, _total: None), field.num_levels
    tell(0, levels)
    points = from_cloud(cloud).moved(similarity)
    camera = orbit(points.vertices, up=up, width=TILE[0], height=TILE[1])
    pictures = [(f"input: {len(points.vertices):,} points", picture_of(points, camera))]
    for level in range(levels):
        pictures.append((f"level {level}, traced", _traced(field, camera, level)))
        tell(level + 1, levels)
    if mesh.colors is not None:
        pictures.append((f"mesh: {len(mesh.faces):,} faces", picture_of(from_mesh(mesh), camera)))
    return contact_sheet(pictures)


def _traced(field: Field, camera: Camera, level: int) -> NDArray[np.uint8]:
    """One ray per pixel: four would take half a minute, and the sheet is seen smaller than it is."""
    seen = trace_view(field, camera, level=level, device=field.deltas.device)
    light = ShadeOptions(shadows=True, occlusion=True)
    return compose(seen, shade(seen, "lambert", camera=camera, field=field, level=level, options=light))


@torch.inference_mode()
def distances_to_surface(field: Field, points: Float64, *, level: int, batch: int = 1 << 18) -> Float64:
    """First-order distances |f| / |∇f| of ``points`` ``(N, 3)`` to the zero set of a level, in the field's units."""
    parts = []
    for part in torch.from_numpy(points.astype(np.float32)).split(batch):
        jet = field.jet(part, level=level)
        parts.append(jet.value.abs() / jet.gradient.norm(dim=-1).clamp(min=1e-6))
    return torch.cat(parts).double().numpy()


def _figures(run: Run, meshes: Sequence[Mesh], cloud: PointCloud) -> str:
    """Per level: what it cost, and how far the input points are from its surface."""
    scale = run.similarity.scale
    points = run.similarity.to_unit(from_cloud(cloud).vertices)
    rows = []
    for stage, mesh in zip(run.record["stages"], meshes, strict=True):
        level = stage["level"]
        away = distances_to_surface(run.field, points, level=level) * scale
        delta = f"{float(run.field.deltas[level]) * scale:.4g}" if level < len(run.field.deltas) else "-"
        seconds = stage["sampling_seconds"] + stage["training_seconds"]
        figures = [f"{np.sqrt((away**2).mean()):.4g}", f"{np.median(away):.4g}", f"{len(mesh.faces):,}"]
        rows.append([f"level {level}", f"{stage['parameters']:,}", f"{seconds:.0f} s", delta, *figures])
    header = ["", "parameters", "training", "band δ", "points off: rms", "median", "faces"]
    return f"lengths in input units\n{format_table(header, rows)}"


def _true_errors(cloud: PointCloud, meshes: Sequence[Mesh], similarity: Similarity) -> str:
    """Exact distances to the statue, of the scan's points and of each level's vertices, in input units.

    No scanner saw all of it (under the plinth, behind the staff): what was made up there says nothing about
    the fit, so levels are compared where there are points, and the finest is given in full as well.
    """
    statue, tree = Statue(), KDTree(cloud.points)
    spacing = tree.query(cloud.points, k=2, workers=-1)[0][:, 1]
    reach = 3 * float(np.quantile(spacing, 0.95))
    shapes = [("scan points (noise)", cloud.points)]
    for level, mesh in enumerate(meshes):
        vertices = similarity.to_input(mesh.vertices)
        seen = tree.query(vertices, distance_upper_bound=reach, workers=-1)[0] < reach
        shapes.append((f"level {level}, where scanned", vertices[seen]))
    shapes.append((f"level {len(meshes) - 1}, all of it", similarity.to_input(meshes[-1].vertices)))
    random = np.random.default_rng(0)
    rows = []
    for name, points in shapes:
        chosen = points[random.permutation(len(points))[:CHECKED]]
        error = np.abs(statue.exact_distance(STATUE_PLACEMENT.to_unit(chosen))) * STATUE_PLACEMENT.scale
        figures = (error.mean(), np.sqrt((error**2).mean()), *np.quantile(error, (0.5, 0.95)), error.max())
        rows.append([name, *(f"{figure:.3f}" for figure in figures)])
    return format_table(["true error, mm", "mean", "rms", "median", "95 %", "max"], rows)
