"""``mplicits bench evolve``: evolutions whose every frame is known.

``mplicits bench evolve --meshes A B``: a morph between the fits of two meshes, measured against the meshes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from ...neural_fields import (
    Field,
    InputError,
    Moving,
    NoSurfaceError,
    RigidMotion,
    ShrinkingSphere,
    Sphere,
    TimeSlice,
    Torus,
    at_time,
    extract_mesh,
    load_field,
)
from ..evolve.checks import slope_figures
from ..evolve.shapes import Placed, Placement
from ..evolve.train import evolve
from ..fit.train import fit
from ..run.folder import FIELD_FILE, STATE_FILE
from ..run.machine import format_table
from ..run.settings import EvolveConfig, FitConfig
from ..run.trainer import Progress
from ..surface.measure import evaluate_surfaces
from ..surface.surface import components, from_mesh, read_reference

__all__ = [
    "CASES",
    "ExactCase",
    "ExactRow",
    "MorphRow",
    "bench_exact",
    "bench_morph",
    "format_exact",
    "format_morph",
    "measure_exact",
]

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

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return dataclasses.asdict(self)


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


def bench_exact(
    config: EvolveConfig,
    *,
    cases: Sequence[str] = tuple(CASES),
    progress: Callable[[str, Progress], None] | None = None,
) -> list[ExactRow]:
    """Train each case and measure it at 20 times, between which there was no data either.

    Args:
        config: how all are trained; what is trained comes from the case.
        cases: names in `CASES`.
        progress: called with the name of the case and its progress.
    """
    rows = []
    for name in cases:
        case = CASES[name]
        own = dataclasses.replace(config, **case.settings)
        run = evolve(own, progress=None if progress is None else _named(progress, name))
        rows.append(measure_exact(name, run.field, case, run.record["training_seconds"]))
    return rows


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
            surface = from_mesh(extract_mesh(still, resolution=RESOLUTION))
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


def format_exact(rows: Sequence[ExactRow]) -> str:
    """The table that the command prints."""
    header = ("exact case", "mean error", "worst time", "max", "|f| on it", "|∇f|", "5 % to 95 %", "parts", "train")
    cells = []
    for row in rows:
        slopes = row.slopes
        wrong = sum(found != expected for found, expected in zip(row.components, row.expected, strict=True))
        cells.append(
            (
                row.case,
                f"{row.mean_error:.2e}",
                f"{row.worst_error:.2e}",
                f"{row.max_error:.1e}",
                f"{row.mean_value:.2e}",
                "" if slopes["mean"] is None else f"{slopes['mean']:.3f}",
                "" if slopes["low"] is None else f"{slopes['low']:.3f} to {slopes['high']:.3f}",
                "right" if not wrong else f"{wrong} of {len(row.times)} wrong",
                f"{row.seconds:.0f} s",
            )
        )
    note = f"distances over {TIMES} times in units of the field; the aim is a mean error below {TARGET:g}"
    return f"{format_table(header, cells)}\n{note}"


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


def _named(progress: Callable[[str, Progress], None], name: str) -> Callable[[Progress], None]:
    return lambda report: progress(name, report)


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

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return dataclasses.asdict(self)


def bench_morph(
    first: str | Path,
    second: str | Path,
    config: EvolveConfig,
    *,
    directory: Path,
    fit_config: FitConfig | None = None,
    resolution: int = 256,
    samples: int = 500_000,
    progress: Callable[[str, Progress], None] | None = None,
) -> MorphRow:
    """Fit two meshes, morph between the fits, and measure both ends against the meshes.

    Args:
        first: mesh file.
        second: mesh file.
        config: how the morph is trained and aligned.
        directory: keeps the fits and the morph; fits that are there are used, and continued if interrupted.
        fit_config: of the fits.
        resolution: of the meshes that are measured.
        samples: points drawn on each surface.
        progress: called with what is being trained and its progress.

    Raises:
        InputError: a file cannot be read, holds no faces to compare with, or both have one name.
    """
    paths = [Path(first), Path(second)]
    if len({"morph", *(path.stem for path in paths)}) < 3:
        raise InputError(f"--meshes {first} {second}: their names are those of their runs; rename one")
    references = [read_reference(path) for path in paths]
    runs = [directory / path.stem for path in paths]
    for path, run in zip(paths, runs, strict=True):
        interrupted = (run / STATE_FILE).is_file()
        if not (run / FIELD_FILE).is_file() or interrupted:
            tell = None if progress is None else _named(progress, path.stem)
            fit(path, fit_config, out=run, resume=interrupted, progress=tell)
    own = dataclasses.replace(config, kind="morph", shapes=tuple(map(str, runs)), times=())
    tell = None if progress is None else _named(progress, "morph")
    run = evolve(own, out=directory / "morph", progress=tell)
    fits, ends, floors = [], [], []
    for time, (path, reference) in enumerate(zip(runs, references, strict=True)):
        field, similarity, _ = load_field(path / FIELD_FILE)
        moved = reference.moved(similarity)
        back = Placement.from_dict(run.record["placements"][time]).inverse()
        for found, into in ((field, fits), (Placed(run.field.at(float(time)), back), ends)):
            mesh = from_mesh(extract_mesh(found, resolution=resolution))
            metrics = evaluate_surfaces(mesh, moved, samples=samples, columns=16)  # the volumes are not asked for
            into.append(metrics.chamfer)
            floor = metrics.chamfer_floor
        floors.append(floor)
    frames = run.record["checks"]["frames"]
    return MorphRow(
        (paths[0].stem, paths[1].stem),
        run.record["training_seconds"],
        (fits[0], fits[1]),
        (ends[0], ends[1]),
        (floors[0], floors[1]),
        tuple(frame["volume"] for frame in frames),
        tuple(frame["components"] for frame in frames),
        tuple(frame["time"] for frame in frames),
        tuple(run.record["checks"]["warnings"]),
    )


def format_morph(row: MorphRow) -> str:
    """The table that the command prints, and the curves below it."""
    header = ("morph", "Chamfer", "of the fit", "floor", "ratio")
    cells = [
        (f"{name} at t = {time}", f"{end:.2e}", f"{fitted:.2e}", f"{floor:.2e}", f"{end / fitted:.2f}")
        for time, (name, end, fitted, floor) in enumerate(zip(row.shapes, row.ends, row.fits, row.floors, strict=True))
    ]
    curve = [
        (f"{time:.2f}", f"{volume:.3f}", str(count))
        for time, volume, count in zip(row.times, row.volumes, row.components, strict=True)
    ]
    lines = [format_table(header, cells), f"trained in {row.seconds:.0f} s; the aim is a ratio below 1.5", ""]
    lines.append(format_table(("t", "volume", "components"), curve))
    return "\n".join([*lines, *(f"warning: {warning}" for warning in row.warnings)])
