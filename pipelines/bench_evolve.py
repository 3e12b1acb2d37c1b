"""``mplicits bench evolve``: evolutions whose every frame is known."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from ..neural_fields import (
    Field,
    Moving,
    NoSurfaceError,
    RigidMotion,
    ShrinkingSphere,
    Sphere,
    TimeSlice,
    Torus,
    at_time,
    extract_mesh,
)
from .evolve.checks import slope_figures
from .evolve.train import evolve
from .run.machine import format_table
from .run.settings import EvolveConfig
from .run.trainer import Progress
from .surface.surface import components, from_mesh

__all__ = ["CASES", "ExactCase", "ExactRow", "bench_exact", "format_exact", "measure_exact"]

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
