"""Benchmarks ``fit`` and ``scale``: how near fits come to the shapes that clouds were drawn from.

`FitBench` compares every level of ours with screened Poisson reconstruction (Kazhdan and Hoppe 2013, through pymeshlab,
which is never needed). `ScaleBench` fits clouds of several sizes.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mplicits.datasets import Camera, OrientedCloud, PointCloud, add_noise, orbit, read_cloud
from mplicits.datasets.synthetic.statue import Statue
from mplicits.neural_fields import InputError, Mesh, MultiscaleSDF, Similarity, load_field
from mplicits.neural_fields.backend.devices import peak_memory
from mplicits.neural_fields.meshing.extract import NoSurfaceError, extract_mesh
from mplicits.pipelines.fit.cloud import load_cloud
from mplicits.pipelines.fit.train import Run, fit, prepare
from mplicits.pipelines.render.picture import contact_sheet, write_picture
from mplicits.pipelines.render.rasterise import picture_of
from mplicits.pipelines.surface.measure import Metrics, evaluate_surfaces
from mplicits.pipelines.surface.surface import (
    drop_unsupported,
    face_normals,
    from_cloud,
    read_reference,
    read_support,
    read_surface,
    sample_points,
)
from mplicits.pipelines.training.folder import STATE_FILE, find_field, is_fitted, read_record
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import Report

from ..harness.benchmark import Benchmark, Part, plain
from ..harness.jobs import Context, key_of
from ..harness.tables import Column, Figure, Table, tabulated
from .roughness import Roughness, surface_roughness

SIDES = 8  # steps of a coordinate of a normal from 0 to 1: about 7° are one side
STEEPEST = 85.0  # degrees above or below the horizon, so that the picture has an upright


def fit_home(out: Path, source: Path, config: FitConfig, **more: Any) -> Path:
    """The run directory of a fit in a folder of results; its name is made of all that decides the fit.

    Args:
        out: the folder.
        source: the file that is fitted.
        config: settings of the fit.
        more: what else decides it, as JSON.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        key = key_of(Part("fit", source.stem, (source,)), {"fit": plain(config), **more})
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror})") from error
    return out / "runs" / f"{source.stem}-{key}"


def kept_fit(directory: Path, cloud: PointCloud | Path, config: FitConfig, *, progress: Report | None = None) -> Run:
    """The fit in a directory; what is not finished there goes on, and what is not there is fitted.

    Args:
        directory: see `fit_home`.
        cloud: what is fitted.
        config: settings.
        progress: called now and then with how far the training is.

    Raises:
        InputError: the cloud cannot be used.
        Interrupted: the fit was stopped; the next call goes on with it.
    """
    if not is_fitted(directory):
        directory.parent.mkdir(parents=True, exist_ok=True)
        return fit(cloud, config, out=directory, resume=(directory / STATE_FILE).is_file(), progress=progress)
    field, similarity, _ = load_field(find_field(directory))
    assert isinstance(field, MultiscaleSDF)
    return Run(field, similarity, directory, read_record(directory))


@dataclass(frozen=True)
class FitRow:
    """One method on one shape.

    Attributes:
        shape: name of the file.
        noise: half-width of the uniform displacement, as a fraction of the bounding box's diagonal.
        method: "level 0" to the finest, "screened Poisson", or "screened Poisson, smoothed" on the cloud that ours has
            smoothed the noise off, or "screened Poisson, MeshLab's normals" where normals are estimated.
        seconds: training up to and with this level, its sampling included; reconstruction for Poisson.
        mesh_seconds: extraction; 0 for Poisson, whose result is a mesh.
        metrics: against the shape; None where the method found no surface.
        isotropic: whether the noise has no direction: Gaussian, along the normals as strong as the other.
        rough: what it has at high frequency; None where there is no surface.
    """

    shape: str
    noise: float
    method: str
    seconds: float
    mesh_seconds: float
    metrics: Metrics | None
    isotropic: bool = False
    rough: Roughness | None = None


@dataclass(frozen=True, kw_only=True)
class FitBench(Benchmark[FitRow]):
    """Fits of the vertices of meshes with their area-weighted normals, measured against the meshes themselves.

    Or of points drawn uniformly on them, with the normals of their faces: sharp edges have no vertices then.

    The protocol is the paper's: unit sphere, ``resolution``³ marching cubes, ``samples`` points on each surface.
    Noise moves the points along their normals, which stay as they were (the paper's Tab. 3), or in all directions.

    Attributes:
        shapes: mesh files.
        config: settings of the fits.
        noise: see `FitRow`.
        isotropic: see `FitRow`.
        points: how many are drawn on each mesh; None takes its vertices.
        resolution: cells along each side of the extraction box.
        samples: points drawn on each surface.
        poisson_depth: octree depth of screened Poisson, which runs if its extra is installed.
        pictures: folder for two contact sheets per shape, the second facing its widest face under a raking light.
    """

    name = "fit"
    source = "how near fits come, level by level"
    row = FitRow
    apart = ("shapes", "pictures")
    shapes: Sequence[str | Path]
    config: FitConfig
    noise: float = 0.0
    isotropic: bool = False
    points: int | None = None
    resolution: int = 512
    samples: int = 500_000
    poisson_depth: int = 10
    pictures: Path | None = None

    def jobs(self) -> list[Part]:
        """One for each shape; see `Benchmark.jobs`."""
        for shape in self.shapes:
            read_reference(shape)
        poisson = (("poisson", has_poisson()), ("pictures", None if self.pictures is None else str(self.pictures)))
        return [Part(self.name, Path(shape).stem, (Path(shape),), poisson) for shape in self.shapes]

    def measure(self, job: Part, context: Context) -> list[FitRow]:
        """See `Benchmark.measure`."""
        (path,), seed = job.files, self.config.seed
        reference = read_reference(path)
        cloud, drawing = self.cloud_of(path)
        rows: list[FitRow] = []
        drawn: list[tuple[str, Mesh]] = [("input", from_cloud(cloud))]
        home = fit_home(context.out, path, self.config, noise=self.noise, **drawing)
        for method, seconds, mesh_seconds, mesh in self.reconstructions(cloud, home, context.stage(path.stem)):
            metrics = rough = None
            if mesh is not None:
                metrics = evaluate_surfaces(mesh, reference, samples=self.samples, seed=seed)
                rough = surface_roughness(mesh, reference, samples=self.samples, seed=seed)
                drawn.append((method, mesh))
            rows.append(FitRow(path.stem, self.noise, method, seconds, mesh_seconds, metrics, self.isotropic, rough))
        if self.pictures is not None:
            self.pictures.mkdir(parents=True, exist_ok=True)
            camera = orbit(reference.vertices)
            drawn.append(("reference", _faceted(reference)))
            damage = f"{'-isotropic' * self.isotropic}-noise-{self.noise:g}" if self.noise else ""
            tiles = [(label, picture_of(surface, camera)) for label, surface in drawn]
            write_picture(self.pictures / f"{path.stem}{damage}.png", contact_sheet(tiles))
            facing = facing_camera(reference)
            raked = [(label, picture_of(surface, facing, shading="raking")) for label, surface in drawn[1:]]
            write_picture(self.pictures / f"{path.stem}{damage}-raking.png", contact_sheet(raked))
        return rows

    def cloud_of(self, path: Path) -> tuple[PointCloud, dict[str, Any]]:
        """What is fitted of a mesh, and what else than the mesh and the noise decides it."""
        about = {"points": self.points, "noise": self.noise, "isotropic": self.isotropic, "seed": self.config.seed}
        drawing: dict[str, Any] = {} if self.points is None else {"points": self.points}
        return clouds_of(path, **about)[1], drawing | ({"isotropic": True} if self.isotropic else {})

    def reconstructions(
        self, cloud: PointCloud, home: Path, progress: Report
    ) -> Iterator[tuple[str, float, float, Mesh | None]]:
        """Method, its seconds, seconds of meshing, and the mesh in input coordinates."""
        run = kept_fit(home, cloud, self.config, progress=progress)
        seconds = 0.0
        for level, stage in enumerate(run.record["stages"]):
            seconds += stage_seconds(stage)
            mesh, meshing = timed_mesh(run, self.resolution, level)
            surface = None if mesh is None else in_input(mesh, run.similarity)
            yield f"level {level}", seconds, meshing, surface
        if not has_poisson():
            return
        given = {"screened Poisson": False}  # smoothing is part of ours
        if run.record["cleaning"]["smoothed_noise"]:
            given["screened Poisson, smoothed"] = True  # and what it would do for others
        prepared = {
            smooth: prepare(cloud, dataclasses.replace(self.config, smooth_noise=smooth)) for smooth in given.values()
        }
        rows = [(method, prepared[smooth], False) for method, smooth in given.items()]
        if run.record["cleaning"]["normals_source"] == "estimated":
            rows.append(("screened Poisson, MeshLab's normals", prepared[False], True))
        for method, oriented, own in rows:
            started = time.perf_counter()
            surface = screened_poisson(oriented, depth=self.poisson_depth, own_normals=own)
            yield method, time.perf_counter() - started, 0.0, in_input(surface, oriented.similarity)

    def tables(self, rows: Sequence[FitRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""

        def of(name: str) -> Callable[[FitRow], Any]:
            return lambda row: None if row.metrics is None else getattr(row.metrics, name)

        def peel(name: str) -> Callable[[FitRow], Any]:
            return lambda row: None if row.rough is None else getattr(row.rough, name)

        def above(row: FitRow) -> float | None:
            """What of the distance is the mesh's, and not the samples'."""
            floor = of("chamfer_floor")(row)
            return None if row.metrics is None or floor is None else row.metrics.chamfer - floor

        figures: list[Figure[FitRow]] = [
            (Column("method", "s"), lambda row: row.method),
            (Column("Chamfer", ".2e"), lambda row: "no surface" if row.metrics is None else row.metrics.chamfer),
            (Column("floor", ".2e"), of("chamfer_floor")),
            (Column("above it", ".2e"), above),
            (Column("Hausdorff", ".1e"), of("hausdorff")),
            (Column("IoU", ".4f"), of("iou")),
            (Column("shell IoU", ".3f"), of("shell_iou")),
            (Column("normals", ".4f"), of("normal_consistency")),
            (Column("flat, °", ".2f"), peel("flat_angle")),
            (Column("90 %", ".2f"), peel("flat_angle_90")),
            (Column("edges, °", ".2f"), peel("edge_angle")),
            (Column("ripple", ".1e"), peel("ripple")),
            (Column("parts", "d"), of("components")),
            (Column("fit, s", ".1f"), lambda row: row.seconds),
            (Column("mesh, s", ".1f"), lambda row: row.mesh_seconds or None),
        ]
        kinds = {False: "noise", True: "isotropic noise"}
        items = [(f"{row.shape}{f' + {kinds[row.isotropic]} {row.noise:g}' if row.noise else ''}", row) for row in rows]
        return (tabulated(self.name, "How near fits come", "shape", figures, items),)


def facing_camera(surface: Mesh) -> Camera:
    """A camera that looks at the side of a mesh with most area in one direction, or nearly, a little from above."""
    normals, areas = face_normals(surface)
    owner = np.unique(np.round(SIDES * normals), axis=0, return_inverse=True)[1].reshape(-1)
    widest = owner == np.bincount(owner, areas).argmax()
    side = (areas[widest, None] * normals[widest]).sum(axis=0)
    x, y, z = side / np.linalg.norm(side)
    elevation = np.clip(np.degrees(np.arcsin(y)), -STEEPEST, STEEPEST)
    return orbit(surface.vertices, azimuth=float(np.degrees(np.arctan2(x, z))), elevation=float(elevation))


def _faceted(surface: Mesh) -> Mesh:
    """The mesh with every face on its own: no normal is a mean of those of two sides of an edge."""
    corners = surface.faces.ravel()
    normals = np.repeat(face_normals(surface)[0], 3, axis=0)
    colors = None if surface.colors is None else surface.colors[corners]
    return Mesh(surface.vertices[corners], np.arange(len(corners)).reshape(-1, 3), normals, colors)


def clouds_of(
    path: Path, *, points: int | None, noise: float, isotropic: bool, seed: int
) -> tuple[PointCloud, PointCloud]:
    """The vertices of a mesh, or points drawn on it, with exact normals; and the same with noise.

    Args:
        path: the mesh.
        points: see `FitBench`.
        noise: see `FitRow`.
        isotropic: see `FitRow`.
        seed: of what is drawn, and of the noise.

    Raises:
        InputError: the file cannot be read.
    """
    if points is None:
        cloud = read_cloud(path)
    else:
        drawn, normals = sample_points(read_reference(path), points, np.random.default_rng(seed))
        assert normals is not None
        cloud = PointCloud(drawn, normals.astype(np.float32), None, str(path))
    if not noise:
        return cloud, cloud
    return cloud, add_noise(cloud, noise, isotropic=isotropic, seed=seed)


def timed_mesh(run: Run, resolution: int, level: int = -1) -> tuple[Mesh | None, float]:
    """The mesh of a level as `mplicits mesh` makes it, without blobs, but in unit-sphere coordinates; and its seconds.

    A level without a surface has none. Of a run that no folder holds, nothing says what supports it, and blobs stay.
    """
    level, home = run.field.resolve_level(level), run.directory
    support = None if home is None else read_support(find_field(home), read_record(home), level)
    started = time.perf_counter()
    try:
        mesh = extract_mesh(run.field, resolution=resolution, level=level)
    except NoSurfaceError:
        mesh = None
    if mesh is not None and support is not None:
        mesh = drop_unsupported(mesh, support.points, radius=support.radius).mesh
    return mesh, time.perf_counter() - started


def stage_seconds(stage: Mapping[str, Any]) -> float:
    """What a level took, its samples included."""
    return stage["sampling_seconds"] + stage["training_seconds"]


def in_input(surface: Mesh, similarity: Similarity) -> Mesh:
    """A mesh of the unit sphere in input coordinates."""
    return Mesh(similarity.to_input(surface.vertices), surface.faces, surface.normals, surface.colors)


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


@dataclass(frozen=True, kw_only=True)
class ScaleBench(Benchmark[ScaleRow]):
    """Fits of clouds of several sizes, drawn from one mesh and moved by the same noise.

    Each is fitted and meshed by a process of its own, so that the most memory that one has held is that of this size.

    Attributes:
        counts: how many points.
        config: settings of the fits.
        folder: the clouds are written there, one at a time, and removed: 24 bytes for each point. By default, that of
            the results.
        shape: a mesh; by default that of the bundled statue.
        noise: standard deviation of what points are moved by along their normals, in bounding-box diagonals.
        resolution: cells along each side of the extraction box.
        samples: points on each surface for the Chamfer distance.
    """

    name = "scale"
    source = "what clouds of many sizes cost, and what more points gain"
    row = ScaleRow
    apart = ("counts", "folder", "shape")
    counts: Sequence[int]
    config: FitConfig
    folder: Path | None = None
    shape: str | Path | None = None
    noise: float = 0.001
    resolution: int = 256
    samples: int = 500_000

    def jobs(self) -> list[Part]:
        """One for each size; see `Benchmark.jobs`."""
        if self.shape is not None and not len(read_surface(self.shape).faces):
            raise InputError(f"{self.shape}: has no faces, so there is no surface to draw points from; give a mesh")
        files = () if self.shape is None else (Path(self.shape),)
        return [Part(self.name, f"{count:,} points", files, (("points", count),)) for count in self.counts]

    def measure(self, job: Part, context: Context) -> list[ScaleRow]:
        """See `Benchmark.measure`."""
        count = job.parameters["points"]
        path = (self.folder or context.out) / f"cloud_{count}.ply"
        context.say(job.name)
        surface = read_surface(self.shape) if self.shape else extract_mesh(Statue(), resolution=384)
        try:
            write_noisy_cloud(path, surface, count, noise=self.noise, seed=self.config.seed)
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other:
                measured, mesh = other.submit(_measured, path, self.config, self.resolution).result()
        finally:
            path.unlink(missing_ok=True)
        chamfer = floor = None
        if mesh is not None:  # volumes are not asked for: few columns
            metrics = evaluate_surfaces(mesh, surface, samples=self.samples, seed=self.config.seed, columns=8)
            chamfer, floor = metrics.chamfer, metrics.chamfer_floor
        return [ScaleRow(points=count, chamfer=chamfer, chamfer_floor=floor, **measured)]

    def tables(self, rows: Sequence[ScaleRow], *, sgemm: float) -> tuple[Table, ...]:
        """The figures, and how many times as long as the smallest cloud the others took."""
        first = rows[0].fit_seconds + rows[0].mesh_seconds
        figures: list[Figure[ScaleRow]] = [
            (Column("kept", ",d"), lambda row: row.kept),
            (Column("read, s", ".1f"), lambda row: row.read_seconds),
            (Column("prepare, s", ".1f"), lambda row: row.prepare_seconds),
            (Column("samples, s", ".1f"), lambda row: row.sampling_seconds),
            (Column("step, ms", ".0f"), lambda row: 1000 * row.step_seconds),
            (Column("fit, s", ".1f"), lambda row: row.fit_seconds),
            (Column("mesh, s", ".1f"), lambda row: row.mesh_seconds),
            (Column("ratio", ".2f"), lambda row: (row.fit_seconds + row.mesh_seconds) / first),
            (
                Column("peak memory, MiB", ",.0f"),
                lambda row: None if row.peak_memory is None else row.peak_memory / 2**20,
            ),
            (Column("Chamfer", ".3e"), lambda row: "no surface" if row.chamfer is None else row.chamfer),
        ]
        floors = [row.chamfer_floor for row in rows if row.chamfer_floor is not None]
        notes = [f"Two samplings of the mesh itself are {floor:.3e} apart." for floor in floors[:1]]
        items = [(f"{row.points:,}", row) for row in rows]
        return (tabulated(self.name, "What more points cost", "points", figures, items, notes=notes),)


def write_noisy_cloud(
    path: Path, surface: Mesh, count: int, *, noise: float, seed: int = 0, rows: int = 1_000_000
) -> None:
    """Write ``count`` points of a mesh, uniform by area, as binary PLY of floats, ``rows`` at a time.

    Args:
        path: the file.
        surface: a mesh.
        count: how many points.
        noise: see `ScaleBench`.
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


def _measured(path: Path, config: FitConfig, resolution: int) -> tuple[Mapping[str, Any], Mesh | None]:
    """Fit and mesh a file → figures of `ScaleRow`, and the mesh in the coordinates of the file."""
    started = time.perf_counter()
    cloud, merging = load_cloud(path, limit=config.merge_above, isolation=config.isolation)
    read = time.perf_counter() - started
    run = fit(cloud, config)
    total = time.perf_counter() - started
    stages = run.record["stages"]
    sampling, training = (sum(stage[f"{what}_seconds"] for stage in stages) for what in ("sampling", "training"))
    mesh, meshing = timed_mesh(run, resolution)
    figures = {
        "kept": len(cloud) if merging is None else merging.kept,
        "read_seconds": read,
        "prepare_seconds": max(0.0, total - read - sampling - training),
        "sampling_seconds": sampling,
        "step_seconds": training / sum(stage["steps"] for stage in stages),
        "fit_seconds": total,
        "mesh_seconds": meshing,
        "peak_memory": peak_memory(),
    }
    if mesh is None:
        return figures, None
    surface = mesh
    return figures, Mesh(run.similarity.to_input(surface.vertices), surface.faces)


def has_poisson() -> bool:
    """Whether the extra ``mplicits[poisson]`` is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def screened_poisson(cloud: OrientedCloud, *, depth: int = 10, trim: float = 0.0, own_normals: bool = False) -> Mesh:
    """Reconstruct a cloud, with MeshLab's defaults except for the octree's depth (10 in the paper).

    Args:
        cloud: in unit-sphere coordinates.
        depth: of the octree.
        trim: vertices whose density is below this quantile are cut away with their faces, as the example code of
            Open3D does it (the paper's supplement, 1 %); 0 cuts nothing.
        own_normals: whether MeshLab estimates and orients normals (32 neighbours), in place of the cloud's.

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
    if own_normals:
        meshes.compute_normal_for_point_clouds(k=32)
    # Its threads wait for each other by spinning: more than there are cores for them, and they take ten times as long.
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=torch.get_num_threads())
    mesh = meshes.current_mesh()
    vertices = np.asarray(mesh.vertex_matrix(), np.float64)
    faces = np.asarray(mesh.face_matrix(), np.int64)
    if trim:
        density = np.asarray(mesh.vertex_scalar_array(), np.float64)
        kept = density >= np.quantile(density, trim)
        faces = faces[kept[faces].all(axis=1)]
    return Mesh(vertices, faces)
