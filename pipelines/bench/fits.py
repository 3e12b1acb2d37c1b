"""``mplicits bench fit``: every level of our fit, and screened Poisson, against the shapes the clouds came from.

``mplicits bench scale``: what clouds of 100 thousand to 10 million points cost, and what more points gain.

Clouds of every size are drawn from one mesh and moved by the same noise. Each is fitted and meshed by a process of its
own, so that the most memory that one has held is that of this size.

Screened Poisson reconstruction (Kazhdan and Hoppe 2013) through pymeshlab: a peer for benchmarks, never needed.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...datasets import OrientedCloud, PointCloud, add_noise, orbit, read_cloud
from ...datasets.synthetic.statue import Statue
from ...neural_fields import InputError, Similarity
from ...neural_fields.meshing import NoSurfaceError, extract_mesh
from ..fit.cloud import load_cloud
from ..fit.train import fit, prepare
from ..render.picture import contact_sheet, write_picture
from ..render.rasterise import picture_of
from ..run.machine import format_table, peak_memory
from ..run.settings import FitConfig
from ..run.trainer import Progress
from ..surface.measure import Metrics, evaluate_surfaces
from ..surface.surface import Surface, from_cloud, from_mesh, read_reference, read_surface, sample_points

__all__ = [
    "FitRow",
    "ScaleRow",
    "bench_fit",
    "bench_scale",
    "format_fit",
    "format_scale",
    "has_poisson",
    "screened_poisson",
    "write_noisy_cloud",
]


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


@dataclass(frozen=True)
class ScaleRow:
    """One size of cloud.

    Attributes:
        points: in the file.
        kept: what the fit saw of them, after merging.
        read_seconds: reading, and merging where there are many.
        prepare_seconds: cleaning, and all else that is neither reading nor sampling nor training.
        sampling_seconds: making the samples of all levels.
        step_seconds: one training step, the mean over all levels.
        fit_seconds: all of the above, and all steps.
        mesh_seconds: extraction.
        peak_memory: of the process that did it, in bytes; None where the system does not keep it.
        chamfer: against the mesh, in the unit sphere of that; None if the fit has no surface.
        chamfer_floor: of two samplings of that mesh.
    """

    points: int
    kept: int
    read_seconds: float
    prepare_seconds: float
    sampling_seconds: float
    step_seconds: float
    fit_seconds: float
    mesh_seconds: float
    peak_memory: int | None
    chamfer: float | None
    chamfer_floor: float | None

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self)


def bench_scale(
    counts: Sequence[int],
    config: FitConfig,
    folder: Path,
    *,
    shape: str | Path | None = None,
    noise: float = 0.001,
    resolution: int = 256,
    samples: int = 500_000,
    report: Callable[[str], None] | None = None,
) -> list[ScaleRow]:
    """Fit clouds of several sizes drawn from one shape.

    Args:
        counts: how many points.
        config: settings of the fits.
        folder: the clouds are written there, one at a time, and removed: 24 bytes for each point.
        shape: a mesh; by default that of the bundled statue.
        noise: standard deviation of what points are moved by along their normals, in bounding-box diagonals.
        resolution: cells along each side of the extraction box.
        samples: points on each surface for the Chamfer distance.
        report: told what comes next.

    Raises:
        InputError: the shape cannot be read, or has no faces.
    """
    report = report or (lambda _: None)
    surface = from_mesh(extract_mesh(Statue(), resolution=384)) if shape is None else read_surface(shape)
    if not len(surface.faces):
        raise InputError(f"{shape}: has no faces, so there is no surface to draw points from; give a mesh")
    rows = []
    for count in counts:
        path = folder / f"cloud_{count}.ply"
        report(f"{count:,} points")
        try:
            write_noisy_cloud(path, surface, count, noise=noise, seed=config.seed)
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other:
                measured, mesh = other.submit(_measured, path, config, resolution).result()
        finally:
            path.unlink(missing_ok=True)
        # Volumes are not asked for: few columns.
        metrics = (
            None if mesh is None else evaluate_surfaces(mesh, surface, samples=samples, seed=config.seed, columns=8)
        )
        chamfer, floor = (None, None) if metrics is None else (metrics.chamfer, metrics.chamfer_floor)
        rows.append(ScaleRow(points=count, chamfer=chamfer, chamfer_floor=floor, **measured))
    return rows


def write_noisy_cloud(
    path: Path, surface: Surface, count: int, *, noise: float, seed: int = 0, rows: int = 1_000_000
) -> None:
    """Write ``count`` points of a mesh, uniform by area, as binary PLY of floats, ``rows`` at a time.

    Args:
        path: the file.
        surface: a mesh.
        count: how many points.
        noise: see `bench_scale`.
        seed: of the random numbers.
        rows: points held at once.
    """
    random = np.random.default_rng(seed)
    deviation = noise * float(np.linalg.norm(np.ptp(surface.used_vertices(), axis=0)))
    names = ("x", "y", "z", "nx", "ny", "nz")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [*(f"property float {name}" for name in names), "end_header\n"]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        for start in range(0, count, rows):
            points, normals = sample_points(surface, min(rows, count - start), random)
            assert normals is not None
            points = points + random.normal(0, deviation, (len(points), 1)) * normals
            table = np.concatenate((points, normals), axis=1).astype("<f4")
            # Sampling orders them by place, which scanners do not.
            file.write(table[random.permutation(len(table))].tobytes())


def _measured(path: Path, config: FitConfig, resolution: int) -> tuple[dict[str, Any], Surface | None]:
    """Fit and mesh a file → figures of `ScaleRow`, and the mesh in the coordinates of the file."""
    started = time.perf_counter()
    cloud, merging = load_cloud(path, limit=config.merge_above, isolation=config.isolation)
    read = time.perf_counter() - started
    run = fit(cloud, config)
    total = time.perf_counter() - started
    stages = run.record["stages"]
    sampling, training = (sum(stage[f"{what}_seconds"] for stage in stages) for what in ("sampling", "training"))
    started = time.perf_counter()
    try:
        mesh = from_mesh(extract_mesh(run.field, resolution=resolution))
        mesh = Surface(run.similarity.to_input(mesh.vertices), mesh.faces)
    except NoSurfaceError:
        mesh = None
    figures = {
        "kept": len(cloud) if merging is None else merging.kept,
        "read_seconds": read,
        "prepare_seconds": max(0.0, total - read - sampling - training),
        "sampling_seconds": sampling,
        "step_seconds": training / sum(stage["steps"] for stage in stages),
        "fit_seconds": total,
        "mesh_seconds": time.perf_counter() - started,
        "peak_memory": peak_memory(),
    }
    return figures, mesh


def format_scale(rows: Sequence[ScaleRow]) -> str:
    """A table, and how many times as long as the smallest cloud the others took."""
    header = ("points", "kept", "read", "prepare", "samples", "step", "fit", "mesh", "ratio", "peak memory", "Chamfer")
    cells = []
    first = rows[0].fit_seconds + rows[0].mesh_seconds
    for row in rows:
        seconds = (row.read_seconds, row.prepare_seconds, row.sampling_seconds)
        cells.append(
            (
                f"{row.points:,}",
                f"{row.kept:,}",
                *(f"{second:.1f} s" for second in seconds),
                f"{1000 * row.step_seconds:.0f} ms",
                f"{row.fit_seconds:.1f} s",
                f"{row.mesh_seconds:.1f} s",
                f"{(row.fit_seconds + row.mesh_seconds) / first:.2f}",
                "" if row.peak_memory is None else f"{row.peak_memory / 2**20:,.0f} MiB",
                "no surface" if row.chamfer is None else f"{row.chamfer:.3e}",
            )
        )
    floors = [row.chamfer_floor for row in rows if row.chamfer_floor is not None]
    note = f"Two samplings of the mesh itself are {floors[0]:.3e} apart." if floors else ""
    return "\n".join([format_table(header, cells), note]).strip()


def has_poisson() -> bool:
    """Whether the extra ``mplicits[poisson]`` is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def screened_poisson(cloud: OrientedCloud, *, depth: int = 10, trim: float = 0.0) -> Surface:
    """Reconstruct a cloud, with MeshLab's defaults except for the octree's depth (10 in the paper).

    Args:
        cloud: in unit-sphere coordinates.
        depth: of the octree.
        trim: vertices whose density is below this quantile are cut away with their faces, as the example code of
            Open3D does it (the paper's supplement, 1 %); 0 cuts nothing.

    Returns:
        The mesh, in unit-sphere coordinates.

    Raises:
        ModuleNotFoundError: the extra is not installed (see `has_poisson`).
        ValueError: ``trim`` is not in [0, 1).
    """
    if not 0 <= trim < 1:
        raise ValueError(f"trim={trim}: expected a fraction in [0, 1)")
    import pymeshlab  # pyright: ignore[reportMissingImports]  an extra

    meshes = pymeshlab.MeshSet()  # pyright: ignore[reportAttributeAccessIssue]  its names come from a C++ module
    points, normals = cloud.points.astype(np.float64), cloud.normals.astype(np.float64)
    mesh = pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals)  # pyright: ignore[reportAttributeAccessIssue]
    meshes.add_mesh(mesh)
    # Its threads wait for each other by spinning: more than there are cores for them, and they take ten times as long.
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=torch.get_num_threads())
    mesh = meshes.current_mesh()
    vertices = np.asarray(mesh.vertex_matrix(), np.float64)
    faces = np.asarray(mesh.face_matrix(), np.int64)
    if trim:
        density = np.asarray(mesh.vertex_scalar_array(), np.float64)
        kept = density >= np.quantile(density, trim)
        faces = faces[kept[faces].all(axis=1)]
    return Surface(vertices, faces)
