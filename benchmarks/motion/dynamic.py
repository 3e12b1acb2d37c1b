"""Frames per second of the dynamic tracer, against tracing every frame from scratch and against meshing it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mplicits.datasets.cameras import Camera, orbit
from mplicits.neural_fields import Field, InputError, SpaceTimeSDF, extract_mesh, load_field, sphere_trace
from mplicits.neural_fields.meshing.extract import DEFAULT_BOUNDS
from mplicits.neural_fields.spacetime.dynamic_tracing import DynamicTracer, moment
from mplicits.neural_fields.tracing.sphere import Hits
from mplicits.pipelines.render.trace import PRECISION, pixel_size, trace_hits
from mplicits.pipelines.training.folder import find_field

from ..costs.speed import counted, evaluate_slabs, peer_mesher
from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .evolve import MorphBench

FIRST = 2  # frames that the dynamic tracer needs to know a motion; they are left out of all figures
FRAMES_OF_MOTION = 96  # from t = 0 to t = 1: four seconds of a film
START = 0.25
OUTLINE_RESOLUTION = 64

# From a time to the hits, if that is what is made.
Draw = Callable[[float], Hits | None]


@dataclass(frozen=True)
class DynamicRow:
    """One way to see every frame; means over the frames but the first two, and over one frame for meshes.

    Attributes:
        way: its name.
        seconds: per frame.
        speedup: of the dynamic tracer over it.
        evaluations: points per frame, of each level.
        differing: pixels per frame whose hit is not that of tracing from scratch; None for meshes.
        deviation: the 99.9 % quantile of how far depths are from those, in pixels; None for meshes.
    """

    way: str
    seconds: float
    speedup: float
    evaluations: tuple[float, ...]
    differing: float | None
    deviation: float | None

    @property
    def fps(self) -> float:
        """Frames per second."""
        return 1 / self.seconds


@dataclass(frozen=True, kw_only=True)
class DynamicBench(Benchmark[DynamicRow]):
    """Frames of a motion, seen in several ways; see `dynamic_rows`.

    Attributes:
        run_file: a run of ``mplicits evolve``; or
        morph: the bench whose morph is seen.
        size: width and height of the pictures in pixels.
        resolution: of the meshes.
        frames: see `dynamic_rows`.
    """

    name = "dynamic"
    source = "the dynamic tracer against tracing every frame from scratch, and against meshing it"
    depends = True
    row = DynamicRow
    apart = ("run_file",)
    run_file: str | Path | None = None
    morph: MorphBench | None = None
    size: int = 512
    resolution: int = 256
    frames: int = 14

    def jobs(self) -> list[Part]:
        """One; see `Benchmark.jobs`."""
        peer_mesher()  # it is there, before the long work
        if self.morph is not None:
            return [Part(self.name, "the morph, traced", tuple(map(Path, self.morph.meshes)))]
        assert self.run_file is not None
        file = find_field(self.run_file)
        if load_field(file).field.in_dim != 4:
            raise InputError(f"--trace {self.run_file}: does not move; give a run of `mplicits evolve`")
        return [Part(self.name, f"{file.parent.name}, traced", (file,))]

    def measure(self, job: Part, context: Context) -> list[DynamicRow]:
        """See `Benchmark.measure`."""
        if self.morph is None:
            (file,) = job.files
        else:
            assert context.first is not None
            (morph,) = self.morph.jobs()
            file = find_field(context.first(morph).run())
        return dynamic_rows(load_field(file).field, frames=self.frames, size=self.size, cells=self.resolution)

    def tables(self, rows: Sequence[DynamicRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[DynamicRow]] = [
            (Column("s", ".3f"), lambda r: r.seconds),
            (Column("frames / s", ".2f"), lambda r: r.fps),
            (Column("× dynamic is faster", ".1f"), lambda r: r.speedup),
            (Column("evaluations / 1000", "s"), lambda r: " ".join(f"{n / 1000:,.0f}" for n in r.evaluations)),
            (Column("hits differ", ".1f"), lambda r: r.differing),
            (Column("depth, px", ".2f"), lambda r: r.deviation),
        ]
        items = [(row.way, row) for row in rows]
        return (tabulated(self.name, "Frames of a motion", "every frame", figures, items),)


def dynamic_rows(
    field: Field, *, frames: int = 14, size: int = 512, cells: int = 256, level: int = -1
) -> list[DynamicRow]:
    """Trace a part of a motion in three ways, and mesh one of its frames in three.

    Hits alone are compared; normals and shading cost all ways the same, and a mesh would still have to be drawn. Frames
    are 1/96 apart, from t = 0.25 on. Meshes are extracted adaptively, with ``cells`` and with cells of the size of a
    pixel, which is what shows as much as a picture does; and in the paper's way, level 0 on every vertex.

    Args:
        field: four-dimensional.
        frames: of the film, at least 3.
        size: width and height of the pictures in pixels.
        cells: of the meshes, along each side.
        level: whose surface.

    Raises:
        ValueError: too few frames.
    """
    if frames <= FIRST:
        raise ValueError(f"frames={frames}: expected at least {FIRST + 1}")
    level = field.resolve_level(level)
    times = [START + index / FRAMES_OF_MOTION for index in range(frames)]
    camera = _camera(field, times, size)
    eye, directions = camera.rays(device=field.deltas.device)
    tolerance, resolution = PRECISION.tolerance * pixel_size(camera), PRECISION.resolution * pixel_size(camera)

    def dynamic(field: Field) -> Draw:
        return DynamicTracer(field, eye, directions, level=level, tolerance=tolerance, resolution=resolution).trace

    def tiles(field: Field) -> Draw:
        return lambda t: trace_hits(moment(field, t), camera, eye, directions, level=level)

    def scratch(field: Field) -> Draw:
        return lambda t: sphere_trace(
            moment(field, t), eye, directions, level=level, tolerance=tolerance, resolution=resolution
        )

    def meshing(cells: int) -> Callable[[Field], Draw]:
        def way(field: Field) -> Draw:
            def draw(t: float) -> None:
                extract_mesh(moment(field, t), resolution=cells, level=level, normals=False)

            return draw

        return way

    def dense(field: Field) -> Draw:
        def draw(t: float) -> None:
            _dense_mesh(moment(field, t), cells, level)

        return draw

    edge = DEFAULT_BOUNDS[1][0] - DEFAULT_BOUNDS[0][0]
    fine, one = round(edge / pixel_size(camera)), times[FIRST : FIRST + 1]
    figures = {
        "dynamic tracer": _run(dynamic, field, times[:FIRST], times[FIRST:]),
        "from scratch, tiles first": _run(tiles, field, (), times[FIRST:]),
        "from scratch": _run(scratch, field, (), times[FIRST:]),
        f"adaptive marching cubes, {cells}³": _run(meshing(cells), field, (), one),
        f"adaptive, cells of a pixel, {fine}³": _run(meshing(fine), field, (), one),
        f"level 0 on every vertex, {cells}³": _run(dense, field, (), one),
    }
    fastest, reference = figures["dynamic tracer"][0], figures["from scratch"][2]
    rows = []
    for name, (seconds, evaluations, seen) in figures.items():
        differing, deviation = _compare(seen, reference, pixel_size(camera))
        rows.append(DynamicRow(name, seconds, seconds / fastest, evaluations, differing, deviation))
    return rows


def _camera(field: Field, times: Sequence[float], size: int) -> Camera:
    ends = (times[0], times[-1])
    points = [extract_mesh(moment(field, t), resolution=OUTLINE_RESOLUTION, normals=False).vertices for t in ends]
    return orbit(np.concatenate(points), width=size, height=size)


def _dense_mesh(field: Field, cells: int, level: int) -> None:
    """Marching cubes as in the paper: level 0 on every vertex, finer levels in their bands."""
    values = np.empty((cells + 1,) * 3, np.float32)
    evaluate_slabs(field, values, range(cells + 1), level=level)
    peer_mesher()(values, 0.0, gradient_direction="descent")


def _run(
    way: Callable[[Field], Draw], field: Field, warm: Sequence[float], times: Sequence[float]
) -> tuple[float, tuple[float, ...], list[Hits]]:
    """Seconds and evaluations per frame, and the hits, if that is what it gives."""
    draw = way(field)
    for t in warm:
        draw(t)
    started = time.perf_counter()
    seen = [hits for t in times if (hits := draw(t)) is not None]
    seconds = (time.perf_counter() - started) / len(times)
    # Once more with counters, which the clock shall not see.
    whole, levels = counted(field.sdf if isinstance(field, SpaceTimeSDF) else field)
    draw = way(whole)
    for t in warm:
        draw(t)
    for counter in levels:
        counter.values = counter.jets = 0
    for t in times:
        draw(t)
    return seconds, tuple((counter.values + counter.jets) / len(times) for counter in levels), seen


def _compare(seen: Sequence[Hits], reference: Sequence[Hits], pixel: float) -> tuple[float | None, float | None]:
    if not seen:
        return None, None
    apart, differing = [], 0
    for found, fresh in zip(seen, reference, strict=True):
        differing += int((found.mask != fresh.mask).sum())
        apart.append((found.depth - fresh.depth)[found.mask & fresh.mask].abs())
    # torch.quantile takes no more than 2²⁴ numbers.
    together = np.concatenate([part.cpu().numpy() for part in apart])
    return differing / len(seen), float(np.quantile(together, 0.999)) / pixel
