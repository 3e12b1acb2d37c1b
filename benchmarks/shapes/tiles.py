"""Benchmark ``tiles``: an exact town fitted in tiles, beside one network and screened Poisson on the same points."""

from __future__ import annotations

import dataclasses
import resource
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mplicits.datasets.clouds.large import merge_cloud
from mplicits.datasets.clouds.tiling import TilePlan, plan_tiles
from mplicits.neural_fields import Field, Mesh, Similarity, extract_mesh
from mplicits.pipelines.fit.tiles import fit_tiles, plan_fit
from mplicits.pipelines.fit.train import fit, prepare
from mplicits.pipelines.surface.surface import components, drop_unsupported, read_support, sample_points
from mplicits.pipelines.training.folder import FIELD_FILE, read_record
from mplicits.pipelines.training.settings import FitConfig
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..harness.benchmark import Benchmark, Part, plain
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .fits import has_poisson, screened_poisson
from .town import TOWN, Town, TownScan

Float64 = NDArray[np.float64]

TILED, SINGLE, POISSON = "tiles", "one network", "screened Poisson"
EDGE = 4.0  # metres at the rim of the town, where the ground ends and nothing is compared
DEPTH = 0.5  # metres below the ground, from which on nothing is compared


@dataclasses.dataclass(frozen=True)
class TilesRow:
    """One method on one town; lengths are in metres.

    Attributes:
        method: `TILED`, `SINGLE` or `POISSON`.
        points: of the scan.
        tiles: how many.
        sort_seconds: for cutting the cloud and sorting its points.
        fit_seconds: for all fits.
        memory: the largest of the process, or of one worker's, in MiB.
        accuracy: mean distance of the mesh to the town.
        completeness: the same the other way.
        floor: mean of both between two samplings of the town.
        inside: mean of |f| at exact points that see one tile; None for a mesh.
        border: the same where tiles are blended.
        gap: median difference of tiles where they overlap.
        parts: components of the mesh.
        open_edges: of the mesh, away from the rim of the town.
    """

    method: str
    points: int
    tiles: int
    sort_seconds: float
    fit_seconds: float
    memory: float
    accuracy: float
    completeness: float
    floor: float
    inside: float | None
    border: float | None
    gap: float | None
    parts: int
    open_edges: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class TilesBench(Benchmark[TilesRow]):
    """One town scanned from the air and from a car.

    Attributes:
        config: settings of all fits.
        plots: along each side of the town.
        points: of the scan.
        methods: some of `TILED`, `SINGLE` and `POISSON`.
        workers: tiles that are fitted at a time.
        noise: standard deviation of the points along their normals, in metres.
        resolution: of the meshes, cells along the longest side.
        eval_samples: points on each surface.
        poisson_depth: of the octree.
    """

    name = "tiles"
    source = "a town that one network cannot hold"
    row = TilesRow
    apart = ("methods", "workers", "config")
    config: FitConfig
    plots: int = 4
    points: int = 1_000_000
    methods: tuple[str, ...] = (TILED, SINGLE, POISSON)
    workers: int = 1
    noise: float = 0.01
    resolution: int = 1024
    eval_samples: int = 500_000
    poisson_depth: int = 11

    def jobs(self) -> list[Part]:
        """One for each method that is installed."""
        chosen = [method for method in self.methods if method != POISSON or has_poisson()]
        return [Part(self.name, f"{self.points:,} points, {method}", (), (("method", method),)) for method in chosen]

    def settings(self, job: Part) -> Mapping[str, Any]:
        """See `Benchmark.settings`."""
        return {**super().settings(job), "config": plain(self.config)}

    def measure(self, job: Part, context: Context) -> list[TilesRow]:
        """See `Benchmark.measure`."""
        method, town = job.parameters["method"], Town(self.plots)
        scan = TownScan(town, self.points, noise=self.noise)
        home = context.out / "runs" / f"{self.points}-{method.replace(' ', '-')}"
        shutil.rmtree(home, ignore_errors=True)
        home.mkdir(parents=True)
        plan: TilePlan | None = None
        mesh: Mesh | None = None
        gap = sorting = memory = None
        started = time.monotonic()
        if method == TILED:
            file = _written(scan, home / "town.npy")
            started = time.monotonic()
            job_of = plan_fit(file, home / "run", self.config, report=context.progress)
            plan, sorting = job_of.plan, time.monotonic() - started
            run = fit_tiles(job_of, jobs=self.workers, report=lambda done: context.say(done.item.directory.name))
            field, similarity, gap = run.field, run.similarity, run.record["seams"]["typical"]
            memory = run.record["peak_memory"]
            file.unlink()
        elif method == SINGLE:
            # Of a network that knows no borders: how much harder the town is where they would be.
            plan, _ = plan_tiles(scan)
            run = fit(scan.cloud(), self.config, out=home / "run", progress=context.progress)
            field, similarity = run.field, run.similarity
        else:
            merged = merge_cloud(scan, self.config.merge_above or self.points)
            assert merged is not None
            prepared = prepare(merged[0] if self.points > (self.config.merge_above or 0) else scan.cloud(), self.config)
            field, similarity = None, prepared.similarity
            mesh = screened_poisson(prepared, depth=self.poisson_depth)
        seconds = time.monotonic() - started - (sorting or 0)
        memory = memory or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        truth, _ = town.even(self.eval_samples, seed=1)
        again, _ = town.even(self.eval_samples, seed=2)
        inside = border = None
        if field is not None:
            mesh = extract_mesh(field, resolution=self.resolution, bounds=_box(town, similarity))
            support = read_support(home / "run" / FIELD_FILE, read_record(home / "run"), field.num_levels - 1)
            if support is not None:
                mesh = drop_unsupported(mesh, support.points, radius=support.radius).mesh
            if plan is not None:
                off = np.abs(_distances(field, similarity, truth))
                blended = _blended(plan, truth + TOWN.origin)
                kept = _away(truth, town)
                inside, border = float(off[kept & ~blended].mean()), float(off[kept & blended].mean())
        assert mesh is not None
        placed = mesh.moved(_back(similarity))
        above = _above(placed.vertices, town)[placed.faces].any(axis=1)
        seen = dataclasses.replace(placed, faces=placed.faces[above])  # so that an underside takes no samples
        found, _ = sample_points(seen, self.eval_samples, np.random.default_rng(3))
        floor = [*_both_ways(again, truth, town)]
        accuracy, completeness = _both_ways(found, truth, town)
        return [
            TilesRow(
                method=method,
                points=self.points,
                tiles=plan.num_tiles if plan is not None and method == TILED else 1,
                sort_seconds=sorting or 0.0,
                fit_seconds=seconds,
                memory=memory / 2**20,
                accuracy=accuracy,
                completeness=completeness,
                floor=sum(floor) / 2,
                inside=inside,
                border=border,
                gap=gap,
                parts=components(placed),
                open_edges=_open_edges(placed, town),
            )
        ]

    def tables(self, rows: Sequence[TilesRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        millimetres = 1e3
        figures: list[Figure[TilesRow]] = [
            (Column("tiles", "d"), lambda row: row.tiles),
            (Column("sort, s", ".0f"), lambda row: row.sort_seconds),
            (Column("fit, s", ".0f"), lambda row: row.fit_seconds),
            (Column("MiB", ",.0f"), lambda row: row.memory),
            (Column("accuracy", ".1f", "lowest"), lambda row: millimetres * row.accuracy),
            (Column("completeness", ".1f", "lowest"), lambda row: millimetres * row.completeness),
            (Column("floor", ".1f"), lambda row: millimetres * row.floor),
            (Column("inside", ".2f"), lambda row: None if row.inside is None else millimetres * row.inside),
            (Column("border", ".2f"), lambda row: None if row.border is None else millimetres * row.border),
            (Column("gap", ".2f"), lambda row: None if row.gap is None else millimetres * row.gap),
            (Column("parts", "d"), lambda row: row.parts),
            (Column("open", "d"), lambda row: row.open_edges),
        ]
        items = [(f"{row.points:,} points, {row.method}", row) for row in rows]
        title = f"A town of {self.plots} × {self.plots} plots of {TOWN.plot:g} m, noise of {1e3 * self.noise:g} mm"
        note = "Distances are in millimetres, away from the rim of the town: of meshes, and |f| at exact points."
        return (tabulated(self.name, title, "method", figures, items, notes=[note]),)


def _written(scan: TownScan, path: Path) -> Path:
    cloud = scan.cloud()
    assert cloud.normals is not None
    np.save(path, np.concatenate((cloud.points, cloud.normals), axis=1))
    return path


def _back(similarity: Similarity) -> Similarity:
    """From a field's coordinates to metres from the town's corner."""
    center = (np.asarray(TOWN.origin) - similarity.center) / similarity.scale
    return Similarity((center[0], center[1], center[2]), 1 / similarity.scale)


def _box(town: Town, similarity: Similarity) -> Any:
    """The box of the town, in a field's coordinates."""
    low = np.append(np.zeros(2), town.triangles[..., 2].min() - 1) + TOWN.origin
    high = np.append(np.full(2, town.size), town.triangles[..., 2].max() + 1) + TOWN.origin
    return tuple(tuple(corner.tolist()) for corner in similarity.to_unit(np.array([low, high])))


def _above(points: NDArray[np.floating], town: Town) -> NDArray[np.bool_]:
    return points[:, 2] > town.height(points[:, :2]) - DEPTH


def _away(points: Float64, town: Town) -> NDArray[np.bool_]:
    """Which points are not at the rim of the town, nor below its ground, where meshes are closed in some way."""
    within = ((points[:, :2] > EDGE) & (points[:, :2] < town.size - EDGE)).all(axis=1)
    return within & _above(points, town)


def _both_ways(found: Float64, truth: Float64, town: Town) -> tuple[float, float]:
    """Mean distances of samples of a surface to those of the town, and back."""
    there = KDTree(truth).query(found[_away(found, town)], workers=-1)[0]
    back = KDTree(found).query(truth[_away(truth, town)], workers=-1)[0]
    return float(there.mean()), float(back.mean())


@torch.no_grad()
def _distances(field: Field, similarity: Similarity, points: Float64) -> Float64:
    unit = torch.from_numpy(similarity.to_unit(points + TOWN.origin)).to(field.like)
    values = [field.value(part) for part in unit.split(1 << 17)]
    return torch.cat(values).double().numpy() * similarity.scale


def _blended(plan: TilePlan, points: Float64) -> NDArray[np.bool_]:
    """Which points lie in a blend of tiles."""
    count = np.zeros(len(points), np.int64)
    for _, rows in plan.rows(points, margin=plan.blend):
        count[rows] += 1
    return count > 1


def _open_edges(mesh: Mesh, town: Town) -> int:
    """Edges of a mesh with a single face, away from the rim."""
    sides = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [0, 2])]), axis=1)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    middle = mesh.vertices[edges[count == 1]].mean(axis=1)
    return int(_away(middle, town).sum()) if len(middle) else 0
