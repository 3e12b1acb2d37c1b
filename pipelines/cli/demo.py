"""``mplicits demo``: a scan in, a mesh and a picture of every level out."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ...datasets import Camera, PointCloud, orbit, read_cloud, statue_scan, write_cloud_ply
from ...neural_fields import Field, InputError, Similarity
from ...neural_fields.backend.files import check_place
from ...neural_fields.fields.similarity import Placement
from ...neural_fields.meshing.extract import Mesh, extract_mesh, surface_needed
from ..fit.train import fit
from ..mesh.files import write_mesh
from ..render.picture import Image, contact_sheet, write_picture
from ..render.rasterise import picture_of
from ..render.shade import ShadeOptions, compose, shade
from ..render.trace import trace_view
from ..surface.surface import from_cloud
from ..training.progress import counted, progress_bars, reported
from ..training.settings import FitConfig
from .common import tell_budget
from .fit import describe

TILE = (480, 640)


def demo(
    cloud: str | Path | None, out: str | Path, *, config: FitConfig, up: str | None = None, resolution: int = 320
) -> int:
    """Fit a cloud, or the bundled scan, write its mesh and a picture into ``out``, and print what `describe` says.

    ``up`` is "y" or "z". Raises an InputError if the cloud cannot be used or ``out`` cannot be made.
    """
    started = time.monotonic()
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a directory for the demo")
    check_place(out)
    asked_up, up = up, up or ("z" if cloud is None else "y")
    picture = out / "picture.png"
    drawn: list[tuple[str, Image]] = []  # what the picture shows side by side, with titles
    with progress_bars() as report:
        # Before anything is made.
        points = statue_scan(progress=counted(report, "scan")) if cloud is None else read_cloud(cloud)
        out.mkdir(parents=True, exist_ok=True)
        file = out / "scan.ply" if cloud is None else Path(cloud)
        if cloud is None:
            write_cloud_ply(file, points)

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

        what = "the finest level has no surface; is the cloud a surface, are its normals?"
        with reported(report, "mesh"), surface_needed(what):
            finest = extract_mesh(run.field, resolution=resolution)
        finest = spread_colors(finest, points, run.similarity)
        # The mesh in the scan's coordinates, and one for other programs: upright, in metres, at the origin.
        placement = Placement("z", "mm", center=True) if cloud is None else Placement(asked_up, center=True)
        for name in ("mesh.ply", "mesh.glb"):
            write_mesh(out / name, finest, run.similarity, placement if name == "mesh.glb" else None)
        if finest.colors is not None:
            camera = view_of(from_cloud(points).moved(run.similarity), up)
            drawn.append((f"mesh: {len(finest.faces):,} faces", picture_of(finest, camera)))
            write_picture(picture, contact_sheet(drawn))
    tell_budget(run.record)
    print(f"{file}: {len(points):,} points\n{describe(out / 'run')}")
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
