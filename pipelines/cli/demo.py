"""``mplicits demo``: a scan in, a mesh and a picture of every level out, and how near the result is."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...datasets import STATUE_PLACEMENT, Camera, PointCloud, Statue, orbit, read_cloud, statue_scan, write_cloud_ply
from ...datasets.synthetic.samples import feet_and_normals
from ...neural_fields import Field, InputError, Similarity
from ...neural_fields.backend.files import check_place
from ...neural_fields.fields.similarity import Placement
from ...neural_fields.meshing.extract import Mesh, extract_mesh, surface_needed
from ..fit.train import Run, fit
from ..mesh.files import write_mesh
from ..render.picture import Image, contact_sheet, write_picture
from ..render.rasterise import picture_of
from ..render.shade import ShadeOptions, compose, shade
from ..render.trace import trace_view
from ..surface.surface import from_cloud
from ..training.progress import counted, format_table, progress_bars, reported
from ..training.settings import FitConfig
from .common import tell_budget

Float64 = NDArray[np.float64]

TILE = (480, 640)


def demo(
    cloud: str | Path | None, out: str | Path, *, config: FitConfig, up: str | None = None, resolution: int = 320
) -> int:
    """Fit a cloud, write its meshes and a picture into ``out``, and print figures.

    Without a cloud, the bundled scan is fitted and compared with its exact surface. ``up`` is "y" or "z". Raises an
    InputError if the cloud cannot be used or ``out`` cannot be made.
    """
    started = time.monotonic()
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a directory for the demo")
    check_place(out)
    asked_up, up = up, up or ("z" if cloud is None else "y")
    picture = out / "picture.png"
    drawn: list[tuple[str, Image]] = []  # what the picture shows side by side, with titles
    said: list[str] = []  # once the bars are gone
    with progress_bars() as report:
        # Before anything is made.
        points = statue_scan(progress=counted(report, "scan")) if cloud is None else read_cloud(cloud)
        out.mkdir(parents=True, exist_ok=True)
        file = out / "scan.ply" if cloud is None else Path(cloud)
        if cloud is None:
            write_cloud_ply(file, points)
        said.append(f"{file}: {len(points):,} points")

        def show(field: Field, similarity: Similarity) -> None:
            """Draw the level that is finished beside those before, so that there is something to look at meanwhile."""
            level, near = field.num_levels - 1, from_cloud(points).moved(similarity)
            camera = view_of(near, up)
            with reported(report, f"level {level}: picture"):
                if not drawn:
                    drawn.append((f"input: {len(near.vertices):,} points", picture_of(near, camera)))
                drawn.append((f"level {level}, traced", _traced(field, camera, level)))
                write_picture(picture, contact_sheet(drawn))
            print(f"{picture}: drawn up to level {level}", flush=True)

        run = fit(file, config, out=out / "run", progress=report, level_done=show)

        meshes, levels = [], run.field.num_levels
        mesh_count = counted(report, "meshes")
        for level in range(levels):
            mesh_count(level, levels)
            with surface_needed(f"level {level} has no surface; is the cloud a surface, are its normals?"):
                meshes.append(extract_mesh(run.field, level=level, resolution=resolution))
        finest = spread_colors(meshes[-1], points, run.similarity)
        # The mesh in the scan's coordinates, and one for other programs: upright, in metres, at the origin.
        placement = Placement("z", "mm", center=True) if cloud is None else Placement(asked_up, center=True)
        for name in ("mesh.ply", "mesh.glb"):
            write_mesh(out / name, finest, run.similarity, placement if name == "mesh.glb" else None)
        mesh_count(levels, levels)
        if finest.colors is not None:
            camera = view_of(from_cloud(points).moved(run.similarity), up)
            drawn.append((f"mesh: {len(finest.faces):,} faces", picture_of(finest, camera)))
            write_picture(picture, contact_sheet(drawn))
        with reported(report, "figures"):
            said.append(_figures(run, meshes, points))
            if cloud is None:
                said.append(_true_errors(points, run.field, run.similarity))
    tell_budget(run.record)
    print("\n".join(said))
    print(f"{out / 'mesh.ply'}, mesh.glb, picture.png, run/: {time.monotonic() - started:.0f} s in all")
    return 0


def spread_colors(mesh: Mesh, cloud: PointCloud, similarity: Similarity) -> Mesh:
    """The mesh with colours at its vertices: means of the nearest points, weighted by 1 / distance².

    The mesh is in unit-sphere coordinates, the cloud in input coordinates. Without colours the mesh stays unchanged.
    """
    points = from_cloud(cloud).moved(similarity)
    if points.colors is None:
        return mesh
    distance, index = KDTree(points.vertices).query(mesh.vertices, k=4, workers=-1)
    weights = 1 / np.maximum(distance, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    colors = np.einsum("vk,vkc->vc", weights, points.colors[index])
    return dataclasses.replace(mesh, colors=colors.astype(np.float32))


def view_of(points: Mesh, up: str) -> Camera:
    """The camera of all pictures, in the coordinates of the points."""
    return orbit(points.vertices, up=up, width=TILE[0], height=TILE[1])


def _traced(field: Field, camera: Camera, level: int) -> Image:
    """One ray per pixel: four would take half a minute, and the sheet is seen smaller than it is."""
    seen = trace_view(field, camera, level=level, device=field.deltas.device)
    light = ShadeOptions(shadows=True, occlusion=True)
    return compose(seen, shade(seen, "lambert", camera=camera, field=field, level=level, options=light))


@torch.inference_mode()
def distances_to_surface(field: Field, points: Float64, *, level: int) -> Float64:
    """First-order distances |f| / |∇f| of ``points`` ``(N, 3)`` to the zero set of a level, in the field's units."""
    parts = []
    for part in torch.from_numpy(points.astype(np.float32)).split(1 << 18):
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


def _true_errors(cloud: PointCloud, field: Field, similarity: Similarity) -> str:
    """How far the scan and each level are from the statue itself, at the feet of the scan's points, in input units."""
    scan = STATUE_PLACEMENT.to_unit(cloud.points)
    feet = feet_and_normals(Statue(), scan)[0]
    unit = similarity.to_unit(STATUE_PLACEMENT.to_input(feet))
    away = {"the scan's points themselves": np.linalg.norm(scan - feet, axis=1) * STATUE_PLACEMENT.scale}
    for level in range(field.num_levels):
        away[f"level {level}, at the scan's points"] = distances_to_surface(field, unit, level=level) * similarity.scale
    rows = [
        [name, *(f"{figure:.3f}" for figure in (np.sqrt((far**2).mean()), *np.quantile(far, (0.5, 0.95))))]
        for name, far in away.items()
    ]
    return format_table(["off the statue, mm", "rms", "median", "95 %"], rows)
