"""Benchmark ``srb``: the surface reconstruction benchmark, by the two protocols that papers report.

Simulated range scans (Berger et al. 2013), five of them as Williams et al. 2019 ship them. Papers give distances in the
scans' own units (DiGS: Ben-Shabat et al. 2022, and those after it), or of shapes in the unit sphere (neural singular
Hessian, HotSpot). Neither prints what two samplings of the truth itself are apart, which is most of the second figure;
it stands beside ours here.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from mplicits.datasets import PointCloud, read_cloud
from mplicits.neural_fields import Field, InputError, Mesh, Similarity
from mplicits.pipelines.fit.train import prepare
from mplicits.pipelines.surface.distance import MeshDistance
from mplicits.pipelines.surface.surface import components, is_closed, read_surface, sample_points
from mplicits.pipelines.training.settings import FitConfig
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Row, Table, tabulated
from .fits import fit_home, has_poisson, in_input, kept_fit, screened_poisson, stage_seconds, timed_mesh
from .sampled_error import approximation_error, near_surface

Float64 = NDArray[np.float64]

READABLE = (".ply", ".obj", ".stl", ".off", ".xyz", ".npz", ".npy")
NORMALISED_SAMPLES = 100_000
BAND = 0.05  # half-width of the band of `SrbRow.sdf_error`, in the unit sphere
BAND_SAMPLES = 50_000


class Distances(NamedTuple):
    """Of two sets of points.

    Attributes:
        there: mean distance from the first to the nearest of the second.
        back: mean distance from the second to the nearest of the first.
        largest_there: the largest of the first kind.
        largest_back: the largest of the second.
    """

    there: float
    back: float
    largest_there: float
    largest_back: float

    @property
    def half_sum(self) -> float:
        """Half the sum of the two means: d_C of the raw protocol."""
        return (self.there + self.back) / 2

    @property
    def hausdorff(self) -> float:
        """The larger maximum: d_H of both protocols."""
        return max(self.largest_there, self.largest_back)


def distances(first: Float64, second: Float64) -> Distances:
    """Unsquared distances between points ``(N, 3)`` and ``(M, 3)``, each to the nearest of the others."""
    there, _ = KDTree(second, balanced_tree=False).query(first, workers=-1)
    back, _ = KDTree(first, balanced_tree=False).query(second, workers=-1)
    return Distances(float(there.mean()), float(back.mean()), float(there.max()), float(back.max()))


class Published(NamedTuple):
    """What a paper prints: d_C and d_H in raw units, of a shape or of the mean of all five."""

    method: str
    figures: MappingProxyType[str, tuple[float, float]]


def _published(method: str, anchor: Any, dc: Any, lordquas: Any, mean: Any) -> Published:
    named = {"anchor": anchor, "dc": dc, "lordquas": lordquas, "mean of five": mean}
    return Published(method, MappingProxyType(named))


PUBLISHED = (
    _published("DiGS, without normals", (0.29, 7.19), (0.15, 1.70), (0.12, 0.91), (0.19, 3.52)),
    _published("PHASE + FF, without normals", (0.29, 7.43), (0.19, 4.65), (0.11, 0.71), (0.22, 4.96)),
    _published("SAL, without normals", (0.42, 7.21), (0.18, 3.06), (0.13, 4.14), (0.36, 7.47)),
    _published("SIREN, without normals", (0.72, 10.98), (0.34, 6.27), (0.35, 8.96), (0.42, 7.67)),
)
# Sum of the two means, and the larger maximum, in the unit sphere; means over the five shapes.
PUBLISHED_NORMALISED = "neural singular Hessian 0.0102, 0.0521; HotSpot 0.0105, 0.0704"


@dataclass(frozen=True)
class Scan:
    """A scan and its truth.

    Attributes:
        shape: name of the truth, in small letters and digits only.
        cloud: file of the scan.
        truth: file of the true surface: a mesh, or dense points of it.
    """

    shape: str
    cloud: Path
    truth: Path


def find_scans(folder: str | Path) -> list[Scan]:
    """The scans of a folder, each with its truth.

    Either ``scans/`` and ``ground_truth/`` in it, as the scans are shipped, or all files in one: those with faces are
    truths then. A scan belongs to the truth whose name, in small letters and digits only, its own begins with.

    Raises:
        InputError: there is no such folder, a file cannot be read, or no scan has a truth.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the one with the scans and the true surfaces")
    if (folder / "scans").is_dir() and (folder / "ground_truth").is_dir():
        clouds, truths = _files(folder / "scans"), _files(folder / "ground_truth")
    else:
        files = _files(folder)
        truths = [path for path in files if len(read_surface(path).faces)]
        clouds = [path for path in files if path not in truths]
    found = []
    for cloud in clouds:
        named = [truth for truth in truths if _plain(cloud).startswith(_plain(truth))]
        if named:
            truth = max(named, key=lambda path: len(_plain(path)))
            found.append(Scan(_plain(truth), cloud, truth))
    if not found:
        names = ", ".join(path.name for path in clouds[:3]) or "no clouds"
        raise InputError(
            f"{folder}: no scan with a true surface of its name ({names}, {len(truths)} surfaces); "
            "name them alike, as anchor.ply and anchor.off"
        )
    return found


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in READABLE)


def _plain(path: Path) -> str:
    return "".join(letter for letter in path.stem.lower() if letter.isalnum())


@dataclass(frozen=True)
class SrbRow:
    """One method on one scan; raw units are those of the files.

    Attributes:
        shape: see `Scan`.
        scan: name of the scan's file.
        normals: "file" or "none".
        method: "level 0" to the finest, or "screened Poisson" on the points and normals that ours was fitted to.
        seconds: training up to and with this level, with its sampling; reconstruction for Poisson.
        chamfer: d_C, raw: half the sum of the two mean distances.
        hausdorff: d_H, raw: the largest distance either way.
        floor: ``chamfer`` between two samplings of the truth.
        scan_chamfer: mean distance from the scan's points to the mesh, raw.
        scan_hausdorff: the largest of those.
        scan_error: mean distance from the scan's points to the truth, raw: noise, and how far the scan as a whole is
            beside the truth, which no method can know.
        normalised: sum of the two mean distances, of 100,000 samples in the truth's unit sphere.
        normalised_hausdorff: the largest distance there.
        normalised_floor: ``normalised`` between two samplings of the truth.
        sdf_error: mean of |f − d| where |d| < 0.05 in the truth's unit sphere; None for a mesh, or a truth of points.
        parts: connected components of the mesh.
        closed: whether it is watertight.
    """

    shape: str
    scan: str
    normals: str
    method: str
    seconds: float
    chamfer: float | None
    hausdorff: float | None
    floor: float
    scan_chamfer: float | None
    scan_hausdorff: float | None
    scan_error: float
    normalised: float | None
    normalised_hausdorff: float | None
    normalised_floor: float
    sdf_error: float | None
    parts: int | None
    closed: bool | None


@dataclass(frozen=True, kw_only=True)
class SrbBench(Benchmark[SrbRow]):
    """Fits of the scans of a folder, with the file's normals and without, measured against the true surfaces.

    Attributes:
        folder: see `find_scans`.
        config: settings of the fits.
        normals: which rows: with the file's normals ("file"), without ("none").
        shapes: only scans of these truths, as `Scan.shape`; all if empty.
        resolution: cells along each side of the extraction box.
        samples: points on each surface for the raw protocol (a million in the papers).
        poisson_depth: octree depth of screened Poisson, which runs if its extra is installed.
    """

    name = "srb"
    source = "the surface reconstruction benchmark"
    row = SrbRow
    apart = ("folder", "normals", "shapes")
    folder: str | Path
    config: FitConfig
    normals: Sequence[str] = ("file", "none")
    shapes: Sequence[str] = ()
    resolution: int = 512
    samples: int = 1_000_000
    poisson_depth: int = 10

    def jobs(self) -> list[Part]:
        """One for each scan, with the file's normals and without; see `Benchmark.jobs`."""
        scans = find_scans(self.folder)
        known = {scan.shape for scan in scans}
        for shape in self.shapes:
            if shape not in known:
                raise InputError(f"{self.folder}: no scan of {shape!r}; there are {', '.join(sorted(known))}")
        parts = []
        for scan in scans:
            if self.shapes and scan.shape not in self.shapes:
                continue
            has = read_cloud(scan.cloud).normals is not None
            for given in self.normals:
                if has or given == "none":
                    options = (("shape", scan.shape), ("normals", given), ("poisson", has_poisson()))
                    name = f"{scan.cloud.stem}, {'without normals' if given == 'none' else 'with normals'}"
                    parts.append(Part(self.name, name, (scan.cloud, scan.truth), options))
        if not parts:
            raise InputError(f"{self.folder}: no scan has normals; ask for the rows without them (--rows none)")
        return parts

    def measure(self, job: Part, context: Context) -> list[SrbRow]:
        """See `Benchmark.measure`."""
        scan, truth_file = job.files
        shape, given = job.parameters["shape"], job.parameters["normals"]
        cloud = read_cloud(scan)
        config = dataclasses.replace(self.config, normals="estimate") if given == "none" else self.config
        judge = _Judge(read_surface(truth_file), cloud, self.samples, config.seed)
        rows = []
        home = fit_home(context.out, scan, config)
        for method, seconds, mesh, error in self.reconstructions(cloud, home, config, judge, context):
            figures = judge.figures(mesh)
            rows.append(
                SrbRow(
                    shape=shape,
                    scan=scan.name,
                    normals=given,
                    method=method,
                    seconds=seconds,
                    sdf_error=error,
                    **figures,
                )
            )
        return rows

    def reconstructions(
        self, cloud: PointCloud, home: Path, config: FitConfig, judge: _Judge, context: Context
    ) -> Iterator[tuple[str, float, Mesh | None, float | None]]:
        """Method, its seconds, the mesh in the scan's coordinates, and the error of the field in the band."""
        run = kept_fit(home, cloud, config, progress=context.stage(home.name))
        seconds = 0.0
        for level, stage in enumerate(run.record["stages"]):
            seconds += stage_seconds(stage)
            mesh, _ = timed_mesh(run, self.resolution, level)
            yield (
                f"level {level}",
                seconds,
                None if mesh is None else in_input(mesh, run.similarity),
                judge.sdf_error(run.field, run.similarity, level),
            )
        if has_poisson():
            oriented = prepare(cloud, config)
            started = time.perf_counter()
            surface = screened_poisson(oriented, depth=self.poisson_depth)
            yield (
                "screened Poisson",
                time.perf_counter() - started,
                in_input(surface, oriented.similarity),
                None,
            )

    def tables(self, rows: Sequence[SrbRow], *, sgemm: float) -> tuple[Table, ...]:
        """Ours by both protocols, and what papers print of the same shapes."""
        figures: list[Figure[SrbRow]] = [
            (Column("normals", "s"), lambda row: row.normals),
            (Column("method", "s"), lambda row: row.method),
            (Column("d_C", ".3f"), lambda row: "no surface" if row.chamfer is None else row.chamfer),
            (Column("d_H", ".2f"), lambda row: row.hausdorff),
            (Column("floor", ".3f"), lambda row: row.floor),
            (Column("scan → mesh", ".3f"), lambda row: row.scan_chamfer),
            (Column("largest", ".2f"), lambda row: row.scan_hausdorff),
            (Column("scan → truth", ".3f"), lambda row: row.scan_error),
            (Column("normalised", ".4f"), lambda row: row.normalised),
            (Column("largest, normalised", ".4f"), lambda row: row.normalised_hausdorff),
            (Column("floor, normalised", ".4f"), lambda row: row.normalised_floor),
            (Column("|f − d| in the band", ".4f"), lambda row: row.sdf_error),
            (Column("parts", "d"), lambda row: row.parts),
            (Column("watertight", "s"), lambda row: None if row.closed is None else "yes" if row.closed else "no"),
            (Column("time, s", ".0f"), lambda row: row.seconds),
        ]
        notes = (
            f"d_C: half the sum of the mean distances, {self.samples:,} samples; d_H: the largest; raw units.",
            f"Normalised: the sum of both means, {NORMALISED_SAMPLES:,} samples in the truth's unit sphere. Published "
            f"means over all five shapes: {PUBLISHED_NORMALISED}.",
        )
        ours = tabulated(
            self.name,
            "Surface reconstruction benchmark",
            "scan",
            figures,
            [(row.scan, row) for row in rows],
            notes=notes,
        )
        columns = tuple(
            Column(f"{shape}, {what}", form)
            for shape in PUBLISHED[0].figures
            for what, form in (("d_C", ".2f"), ("d_H", ".2f"))
        )
        printed = [
            Row(entry.method, tuple(figure for pair in entry.figures.values() for figure in pair))
            for entry in PUBLISHED
        ]
        published = Table(f"{self.name}_published", "What papers print, raw units", "method", columns, tuple(printed))
        return ours, published


class _Judge:
    """The truth of a scan, sampled once for all methods."""

    def __init__(self, truth: Mesh, cloud: PointCloud, samples: int, seed: int) -> None:
        self.truth, self.samples = truth, samples
        self.scan = cloud.points[np.isfinite(cloud.points).all(axis=1)]
        self.similarity = Similarity.to_unit_sphere(truth.used_vertices())
        self.seeds = np.random.SeedSequence(seed).spawn(4)
        self.points, self.few = self._drawn(truth, 0)
        again, few = self._drawn(truth, 1)
        self.floor = distances(again, self.points).half_sum
        self.scan_error = float(KDTree(self.points, balanced_tree=False).query(self.scan, workers=-1)[0].mean())
        apart = distances(few, self.few)
        self.normalised_floor = apart.there + apart.back
        self.near: tuple[Float64, Float64] | None = None
        if len(truth.faces):
            unit = truth.moved(self.similarity)
            places = near_surface(unit, BAND_SAMPLES, reach=BAND, seed=seed)
            self.near = places, MeshDistance(unit).signed(places)

    def _drawn(self, surface: Mesh, which: int) -> tuple[Float64, Float64]:
        """Samples of a surface in raw units, and fewer of them in the truth's unit sphere."""
        points, _ = sample_points(surface, self.samples, np.random.default_rng(self.seeds[which]))
        few, _ = sample_points(surface, NORMALISED_SAMPLES, np.random.default_rng(self.seeds[which + 2]))
        return points, self.similarity.to_unit(few)

    def figures(self, mesh: Mesh | None) -> dict[str, Any]:
        """All that `SrbRow` says of a mesh in the scan's coordinates."""
        names = ("chamfer", "hausdorff", "scan_chamfer", "scan_hausdorff", "normalised", "normalised_hausdorff")
        found: dict[str, Any] = dict.fromkeys((*names, "parts", "closed"))
        found |= {"floor": self.floor, "normalised_floor": self.normalised_floor, "scan_error": self.scan_error}
        if mesh is None:
            return found
        points, few = self._drawn(mesh, 1)
        raw, unit = distances(points, self.points), distances(few, self.few)
        to_mesh, _ = KDTree(points, balanced_tree=False).query(self.scan, workers=-1)
        return found | {
            "chamfer": raw.half_sum,
            "hausdorff": raw.hausdorff,
            "scan_chamfer": float(to_mesh.mean()),
            "scan_hausdorff": float(to_mesh.max()),
            "normalised": unit.there + unit.back,
            "normalised_hausdorff": unit.hausdorff,
            "parts": components(mesh),
            "closed": is_closed(mesh),
        }

    def sdf_error(self, field: Field, similarity: Similarity, level: int) -> float | None:
        """The mean of |f − d| in the band, in the truth's unit sphere; None where the truth has no inside."""
        if self.near is None:
            return None
        points, exact = self.near
        factor = similarity.scale / self.similarity.scale  # the field's units in the truth's
        places = similarity.to_unit(self.similarity.to_input(points))
        return factor * approximation_error(field, places, exact / factor, level=level)
