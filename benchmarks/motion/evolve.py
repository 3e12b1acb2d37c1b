"""Benchmark ``evolve``: evolutions whose every frame is known, and a morph measured at both ends."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from mplicits.neural_fields import (
    Field,
    InputError,
    Moving,
    NoSurfaceError,
    RigidMotion,
    Sphere,
    TimeSlice,
    Torus,
    at_time,
    extract_mesh,
    load_field,
)
from mplicits.pipelines.evolve.checks import slope_figures
from mplicits.pipelines.evolve.shapes import Placed, Placement
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.surface.measure import evaluate_surfaces
from mplicits.pipelines.surface.surface import components, read_reference
from mplicits.pipelines.training.folder import find_field
from mplicits.pipelines.training.settings import EvolveConfig, FitConfig
from torch import Tensor

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from ..shapes.fits import fit_home, kept_fit
from .figures import ShrinkingSphere

TIMES = 20
RESOLUTION = 64
TARGET = 2e-3  # mean surface error, in units of the field


@dataclass(frozen=True)
class ExactCase:
    """An evolution that is known in closed form.

    Attributes:
        truth: the parts, four-dimensional; the surface is that of their union.
        settings: of the evolution, without those of the training.
        components: at a time.
    """

    truth: Callable[[], list[Field]]
    settings: Mapping[str, Any]
    components: Callable[[float], int]


@dataclass(frozen=True)
class ExactRow:
    """One case; errors are in units of the field, over all times unless said otherwise.

    Attributes:
        case: its name.
        seconds: training.
        mean_error: mean exact distance of the vertices of the slices' meshes.
        worst_error: the same at the worst time.
        max_error: the largest of any vertex.
        mean_value: mean |f| at points of the exact surface.
        slopes: figures of |∇f| near the surface.
        components: of the mesh at each time; 0 where there was none.
        expected: components that there should be.
        times: at which all this was measured.
    """

    case: str
    seconds: float
    mean_error: float
    worst_error: float
    max_error: float
    mean_value: float
    slopes: dict[str, float | None]
    components: tuple[int, ...]
    expected: tuple[int, ...]
    times: tuple[float, ...]


_SCREW = RigidMotion(axis=(0.0, 0.0, 1.0), angle=2.0, velocity=(0.3, 0.1, 0.0))
_TUMBLE = RigidMotion(axis=(1.0, 1.0, 0.0), angle=2.5, velocity=(0.2, -0.2, 0.3))
_LEFT, _RIGHT = RigidMotion(velocity=(0.4, 0.0, 0.0)), RigidMotion(velocity=(-0.4, 0.0, 0.0))

CASES: Mapping[str, ExactCase] = MappingProxyType(
    {
        "sphere, turning and travelling": ExactCase(
            lambda: [Moving(Sphere(radius=0.35, center=(-0.3, 0.0, 0.0)), _SCREW)],
            {
                "kind": "transport",
                "shapes": ("sphere:0.35@-0.3,0,0",),
                "angle": (2.0,),
                "velocity": (0.3, 0.1, 0.0),
            },
            lambda _: 1,
        ),
        "torus, turning and travelling": ExactCase(
            lambda: [Moving(Torus(major=0.4, minor=0.15), _TUMBLE)],
            {
                "kind": "transport",
                "shapes": ("torus:0.4,0.15",),
                "axis": (1.0, 1.0, 0.0),
                "angle": (2.5,),
                "velocity": (0.2, -0.2, 0.3),
            },
            lambda _: 1,
        ),
        "sphere, shrinking by mean curvature": ExactCase(
            lambda: [ShrinkingSphere(radius=0.8, alpha=0.12)],
            {"kind": "smooth", "shapes": ("sphere:0.8",), "alpha": 0.12},
            lambda _: 1,
        ),
        "two spheres, merging": ExactCase(
            lambda: [
                Moving(Sphere(radius=0.3, center=(-0.55, 0.0, 0.0)), _LEFT),
                Moving(Sphere(radius=0.3, center=(0.55, 0.0, 0.0)), _RIGHT),
            ],
            {
                "kind": "transport",
                "shapes": ("sphere:0.3@-0.55,0,0", "sphere:0.3@0.55,0,0"),
                "velocity": (0.4, 0.0, 0.0, -0.4, 0.0, 0.0),
            },
            lambda t: 2 if 0.55 - 0.4 * t > 0.3 else 1,
        ),
    }
)


@dataclass(frozen=True, kw_only=True)
class ExactBench(Benchmark[ExactRow]):
    """Exact cases, trained and measured at 20 times, between which there was no data either.

    Attributes:
        config: how all are trained; what is trained comes from the case.
        cases: names in `CASES`.
    """

    name = "exact"
    source = "evolutions that are known in closed form"
    row = ExactRow
    apart = ("cases",)
    config: EvolveConfig
    cases: Sequence[str] = tuple(CASES)

    def jobs(self) -> list[Part]:
        """One for each case; see `Benchmark.jobs`."""
        return [Part(self.name, case, options=(("case", case),)) for case in self.cases]

    def measure(self, job: Part, context: Context) -> list[ExactRow]:
        """See `Benchmark.measure`."""
        case = CASES[job.name]
        run = evolve(dataclasses.replace(self.config, **case.settings), progress=context.stage(job.name))
        return [measure_exact(job.name, run.field, case, run.record["training_seconds"])]

    def tables(self, rows: Sequence[ExactRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""

        def spread(row: ExactRow) -> str | None:
            low, high = row.slopes["low"], row.slopes["high"]
            return None if low is None else f"{low:.3f} to {high:.3f}"

        def parts(row: ExactRow) -> str:
            wrong = sum(found != expected for found, expected in zip(row.components, row.expected, strict=True))
            return f"{wrong} of {len(row.times)} wrong" if wrong else "right"

        figures: list[Figure[ExactRow]] = [
            (Column("mean error", ".2e"), lambda r: r.mean_error),
            (Column("worst time", ".2e"), lambda r: r.worst_error),
            (Column("max", ".1e"), lambda r: r.max_error),
            (Column("|f| on it", ".2e"), lambda r: r.mean_value),
            (Column("|∇f|", ".3f"), lambda r: r.slopes["mean"]),
            (Column("5 % to 95 %", "s"), spread),
            (Column("parts", "s"), parts),
            (Column("train, s", ".0f"), lambda r: r.seconds),
        ]
        note = f"distances over {TIMES} times in units of the field; the aim is a mean error below {TARGET:g}"
        items = [(row.case, row) for row in rows]
        return (tabulated(self.name, "Exact evolutions", "exact case", figures, items, notes=[note]),)


def measure_exact(name: str, field: Field, case: ExactCase, seconds: float) -> ExactRow:
    """The figures of a field against the truth."""
    truth = case.truth()
    times = tuple(torch.linspace(0, 1, TIMES).tolist())
    errors: list[Tensor] = []
    values: list[Tensor] = []
    counts = []
    for time in times:
        still = TimeSlice(field, time)
        try:
            surface = extract_mesh(still, resolution=RESOLUTION)
        except NoSurfaceError:
            counts.append(0)
            errors.append(torch.full((1,), math.inf))
            continue
        counts.append(components(surface))
        errors.append(_nearest(truth, torch.from_numpy(surface.vertices).float(), time).abs())
        values.append(still.value(_exact_points(truth, time)).abs())
    each = torch.stack([error.mean() for error in errors])
    return ExactRow(
        name,
        seconds,
        float(each.mean()),
        float(each.max()),
        float(torch.cat(errors).max()),
        float(torch.cat(values).mean()) if values else math.inf,
        slope_figures(field),
        tuple(counts),
        tuple(case.components(time) for time in times),
        times,
    )


def _nearest(parts: Sequence[Field], points: Tensor, time: float) -> Tensor:
    """Exact signed distances of points ``(N, 3)`` from the union of the parts."""
    return torch.stack([part.value(at_time(points, time)) for part in parts]).amin(dim=0)


def _exact_points(parts: Sequence[Field], time: float) -> Tensor:
    """Points of the exact surface: vertices of a mesh of each part, but those inside another one."""
    kept = []
    for part in parts:
        mesh = extract_mesh(TimeSlice(part, time), resolution=RESOLUTION)
        points = torch.from_numpy(mesh.vertices).float()
        kept.append(points[_nearest(parts, points, time) > -1e-4])
    return torch.cat(kept)


@dataclass(frozen=True)
class MorphRow:
    """A morph between two meshes.

    Attributes:
        shapes: names of the files.
        seconds: training of the morph, without the fits.
        fits: Chamfer distance of each static fit to its mesh, squared and both ways, in units of its bounding sphere.
        ends: the same of the morph at its ends.
        floors: what a perfect mesh would score.
        volumes: at each time.
        components: at each time.
        times: those times.
        warnings: as in ``run.json``.
    """

    shapes: tuple[str, str]
    seconds: float
    fits: tuple[float, float]
    ends: tuple[float, float]
    floors: tuple[float, float]
    volumes: tuple[float, ...]
    components: tuple[int, ...]
    times: tuple[float, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class MorphBench(Benchmark[MorphRow]):
    """A morph between the fits of two meshes, both of whose ends are measured against the meshes.

    Attributes:
        meshes: the two files.
        config: how the morph is trained and aligned.
        fits: settings of the fits.
        resolution: of the meshes that are measured.
        samples: points drawn on each surface.
    """

    name = "morph"
    source = "a morph between the fits of two meshes"
    row = MorphRow
    apart = ("meshes",)
    meshes: tuple[str | Path, str | Path]
    config: EvolveConfig
    fits: FitConfig = field(default_factory=FitConfig)
    resolution: int = 256
    samples: int = 500_000

    def jobs(self) -> list[Part]:
        """One; see `Benchmark.jobs`."""
        first, second = paths = [Path(mesh) for mesh in self.meshes]
        if first.stem == second.stem:
            raise InputError(f"--meshes {first} {second}: both are called {first.stem}; rename one")
        for path in paths:
            read_reference(path)
        return [Part(self.name, f"{first.stem} to {second.stem}", (first, second))]

    def measure(self, job: Part, context: Context) -> list[MorphRow]:
        """See `Benchmark.measure`; the morph is left in the run directory of the job."""
        runs = []
        for path in job.files:
            home, told = fit_home(context.out, path, self.fits), context.stage(path.stem)
            kept_fit(home, path, self.fits, progress=told)
            runs.append(home)
        own = dataclasses.replace(self.config, kind="morph", shapes=tuple(map(str, runs)), times=())
        run = evolve(own, out=context.run(), progress=context.stage("morph"))
        fits, ends, floors = [], [], []
        for time, (path, directory) in enumerate(zip(job.files, runs, strict=True)):
            fitted, similarity, _ = load_field(find_field(directory))
            moved = read_reference(path).moved(similarity)
            back = Placement.from_dict(run.record["placements"][time]).inverse()
            for found, into in ((fitted, fits), (Placed(run.field.at(float(time)), back), ends)):
                mesh = extract_mesh(found, resolution=self.resolution)
                # The volumes are not asked for.
                metrics = evaluate_surfaces(mesh, moved, samples=self.samples, columns=16)
                into.append(metrics.chamfer)
                floor = metrics.chamfer_floor
            floors.append(floor)
        frames = run.record["checks"]["frames"]
        first, second = job.files
        return [
            MorphRow(
                (first.stem, second.stem),
                run.record["training_seconds"],
                (fits[0], fits[1]),
                (ends[0], ends[1]),
                (floors[0], floors[1]),
                tuple(frame["volume"] for frame in frames),
                tuple(frame["components"] for frame in frames),
                tuple(frame["time"] for frame in frames),
                tuple(run.record["checks"]["warnings"]),
            )
        ]

    def tables(self, rows: Sequence[MorphRow], *, sgemm: float) -> tuple[Table, ...]:
        """Both ends, and the curves below them."""
        (row,) = rows
        ends = list(zip(row.shapes, row.ends, row.fits, row.floors, strict=True))
        figures: list[Figure[tuple[str, float, float, float]]] = [
            (Column("Chamfer", ".2e"), lambda end: end[1]),
            (Column("of the fit", ".2e"), lambda end: end[2]),
            (Column("floor", ".2e"), lambda end: end[3]),
            (Column("ratio", ".2f"), lambda end: end[1] / end[2]),
        ]
        curves: list[Figure[tuple[float, int]]] = [
            (Column("volume", ".3f"), lambda frame: frame[0]),
            (Column("components", "d"), lambda frame: frame[1]),
        ]
        notes = [f"trained in {row.seconds:.0f} s; the aim is a ratio below 1.5"]
        notes += [f"warning: {warning}" for warning in row.warnings]
        named = [(f"{end[0]} at t = {time}", end) for time, end in enumerate(ends)]
        frames = zip(map("{:.2f}".format, row.times), zip(row.volumes, row.components, strict=True), strict=True)
        return (
            tabulated(self.name, "Both ends of the morph", "morph", figures, named, notes=notes),
            tabulated("morph-curves", "On the way", "t", curves, frames),
        )
