"""``mplicits bench fit``: every level of our fit, and screened Poisson, against the shapes the clouds came from."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..datasets import PointCloud, add_noise, orbit, read_cloud
from ..neural_fields import Similarity
from ..neural_fields.meshing import NoSurfaceError, extract_mesh
from .fit.train import fit, prepare
from .poisson import has_poisson, screened_poisson
from .render.rasterise import contact_sheet, picture_of, write_picture
from .run.machine import format_table
from .run.settings import FitConfig
from .run.trainer import Progress
from .surface.measure import Metrics, evaluate_surfaces
from .surface.surface import Surface, from_cloud, from_mesh, read_reference

__all__ = ["FitRow", "bench_fit", "format_fit"]


@dataclass(frozen=True)
class FitRow:
    """One method on one shape.

    Attributes:
        shape: name of the file.
        noise: half-width of the uniform displacement, as a fraction of the bounding box's diagonal.
        method: "level 0" to the finest, "screened Poisson", or "screened Poisson, smoothed" on the cloud that ours has
            smoothed the noise off.
        seconds: training up to and with this level, its sampling included; reconstruction for Poisson.
        mesh_seconds: extraction; 0 for Poisson, whose result is a mesh.
        metrics: against the shape; None where the method found no surface.
    """

    shape: str
    noise: float
    method: str
    seconds: float
    mesh_seconds: float
    metrics: Metrics | None

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self)


def bench_fit(
    shapes: Sequence[str | Path],
    config: FitConfig,
    *,
    noise: float = 0.0,
    resolution: int = 512,
    samples: int = 500_000,
    poisson_depth: int = 10,
    pictures: Path | None = None,
    progress: Callable[[str, Progress], None] | None = None,
) -> list[FitRow]:
    """Fit the vertices of each mesh with their area-weighted normals, and compare with the mesh itself.

    The protocol is the paper's: unit sphere, ``resolution``³ marching cubes, ``samples`` points on each surface.
    Noise moves the points along their normals, which stay as they were (the paper's Tab. 3).

    Args:
        shapes: mesh files.
        config: settings of the fit.
        noise: see `FitRow`.
        resolution: cells along each side of the extraction box.
        samples: points drawn on each surface.
        poisson_depth: octree depth of screened Poisson, which runs if its extra is installed.
        pictures: folder for one contact sheet per shape.
        progress: called with the shape's name and the fit's progress.

    Raises:
        InputError: a file cannot be read, or holds no faces to compare with.
    """
    references = [read_reference(shape) for shape in shapes]
    rows: list[FitRow] = []
    for path, reference in zip(map(Path, shapes), references, strict=True):
        cloud = read_cloud(path)
        if noise:
            cloud = add_noise(cloud, noise, seed=config.seed)
        drawn: list[tuple[str, Surface]] = [("input", from_cloud(cloud))]
        for method, seconds, mesh_seconds, mesh in _reconstructions(
            cloud, config, resolution, poisson_depth, None if progress is None else _named(progress, path.stem)
        ):
            metrics = None
            if mesh is not None:
                metrics = evaluate_surfaces(mesh, reference, samples=samples, seed=config.seed)
                drawn.append((method, mesh))
            rows.append(FitRow(path.stem, noise, method, seconds, mesh_seconds, metrics))
        if pictures is not None:
            camera = orbit(reference.vertices)
            tiles = [(label, picture_of(surface, camera)) for label, surface in [*drawn, ("reference", reference)]]
            write_picture(pictures / f"{path.stem}{f'-noise-{noise:g}' if noise else ''}.png", contact_sheet(tiles))
    return rows


def format_fit(rows: Sequence[FitRow]) -> str:
    """The table that the command prints."""
    header = ("shape", "method", "Chamfer", "floor", "Hausdorff", "IoU", "shell IoU", "normals", "parts", "fit", "mesh")
    cells = []
    for row in rows:
        name = f"{row.shape}{f' + noise {row.noise:g}' if row.noise else ''}"
        if row.metrics is None:
            cells.append((name, row.method, "no surface", *[""] * 6, f"{row.seconds:.1f} s", ""))
            continue
        m = row.metrics
        cells.append(
            (
                name,
                row.method,
                f"{m.chamfer:.2e}",
                "" if m.chamfer_floor is None else f"{m.chamfer_floor:.2e}",
                f"{m.hausdorff:.1e}",
                "" if m.iou is None else f"{m.iou:.4f}",
                f"{m.shell_iou:.3f}",
                "" if m.normal_consistency is None else f"{m.normal_consistency:.4f}",
                str(m.components),
                f"{row.seconds:.1f} s",
                f"{row.mesh_seconds:.1f} s" if row.mesh_seconds else "",
            )
        )
    return format_table(header, cells)


def _named(progress: Callable[[str, Progress], None], name: str) -> Callable[[Progress], None]:
    return lambda report: progress(name, report)


def _reconstructions(
    cloud: PointCloud,
    config: FitConfig,
    resolution: int,
    poisson_depth: int,
    progress: Callable[[Progress], None] | None,
) -> list[tuple[str, float, float, Surface | None]]:
    """Method, its seconds, seconds of meshing, and the mesh in input coordinates."""
    run = fit(cloud, config, progress=progress)
    results: list[tuple[str, float, float, Surface | None]] = []
    seconds = 0.0
    for level, stage in enumerate(run.record["stages"]):
        seconds += stage["sampling_seconds"] + stage["training_seconds"]
        started = time.perf_counter()
        try:
            mesh = _in_input(from_mesh(extract_mesh(run.field, resolution=resolution, level=level)), run.similarity)
        except NoSurfaceError:
            mesh = None
        results.append((f"level {level}", seconds, time.perf_counter() - started, mesh))
    if has_poisson():
        given = {"screened Poisson": False}  # smoothing is part of ours
        if run.record["cleaning"]["smoothed_noise"]:
            given["screened Poisson, smoothed"] = True  # and what it would do for others
        for method, smooth in given.items():
            oriented = prepare(cloud, dataclasses.replace(config, smooth_noise=smooth))
            started = time.perf_counter()
            mesh = screened_poisson(oriented, depth=poisson_depth)
            results.append((method, time.perf_counter() - started, 0.0, _in_input(mesh, oriented.similarity)))
    return results


def _in_input(surface: Surface, similarity: Similarity) -> Surface:
    return Surface(similarity.to_input(surface.vertices), surface.faces, surface.normals, surface.colors)
