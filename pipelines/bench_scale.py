"""``mplicits bench scale``: what clouds of 100 thousand to 10 million points cost, and what more points gain.

Clouds of every size are drawn from one mesh and moved by the same noise. Each is fitted and meshed by a process of its
own, so that the most memory that one has held is that of this size.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets.synthetic.statue import Statue
from ..neural_fields import InputError
from ..neural_fields.meshing import NoSurfaceError, extract_mesh
from .fit.cloud import load_cloud
from .fit.train import fit
from .run.machine import format_table, peak_memory
from .run.settings import FitConfig
from .surface.measure import evaluate_surfaces
from .surface.surface import Surface, from_mesh, read_surface, sample_surface

__all__ = ["ScaleRow", "bench_scale", "format_scale", "write_noisy_cloud"]


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
            points, normals = sample_surface(surface, min(rows, count - start), random)
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
