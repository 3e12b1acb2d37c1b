"""Benchmark ``motion``: motions between key shapes of exact figures, judged at moments that were held out.

The figures are known at all times (see `figures`), so is where each point of their surfaces goes. Only the key shapes,
or fits of their scans, are shown to ``evolve``. Every kind of it that goes from shape to shape is trained on the same
ones, and the level-set blend (`Keyframes`), which is trained by nothing, stands beside them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import process_time
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
import torch
from mplicits.datasets.clouds.readers.ply import write_cloud_ply
from mplicits.datasets.synthetic.scanner import simulate_scan
from mplicits.neural_fields import (
    Field,
    InputError,
    Mesh,
    NoSurfaceError,
    Similarity,
    TimeSlice,
    extract_mesh,
    project_to_surface,
)
from mplicits.neural_fields.spacetime.evolution import VectorField
from mplicits.neural_fields.spacetime.flow import IntegrationError, Solver, trajectories
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.neural_fields.spacetime.surface_velocity import CarriedVelocity
from mplicits.pipelines.evolve.checks import volume
from mplicits.pipelines.evolve.problem import build_problem
from mplicits.pipelines.evolve.shapes import StaticShape, aligned, into_unit_sphere, read_shape
from mplicits.pipelines.evolve.train import train_evolution
from mplicits.pipelines.surface.distance import MeshDistance
from mplicits.pipelines.surface.surface import components, face_normals, sample_points
from mplicits.pipelines.training.settings import EvolveConfig, FitConfig
from numpy.typing import NDArray
from torch import Tensor

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, mean, tabulated
from ..shapes.fits import fit_home, kept_fit
from .figures import DeformingField, bending_arm, twisting_bar
from .walking import walker

Float64 = NDArray[np.float64]

FIGURES: Mapping[str, Callable[[], DeformingField]] = MappingProxyType(
    {"arm": bending_arm, "bar": twisting_bar, "walker": walker}
)
BLEND = "blend of distances"
SAMPLES = 5000  # points of each surface that is compared
# Points that are carried: near a change of topology adaptive steps would shrink to nothing, for the sake of a few.
CARRY = Solver(method="rk4", step=0.02)
STRETCHED = 4.0
SCAN_RESOLUTION = 128  # rays along each side of a scanner's grid
# Of scans of the figures, which have no fine parts: one coarse level is as near to them as all of a preset.
SCAN_FITS = FitConfig(
    widths=(128,), depths=(2,), omegas=(15.0,), steps=(300,), learning_rates=(4e-3,), batch=4096, samples=60_000
)


@dataclass(frozen=True)
class MotionRow:
    """One method on one figure; lengths are in percent of the diagonal of the figure's bounding box at rest.

    Attributes:
        figure: its name.
        method: a kind of ``evolve``, or `BLEND`.
        seconds: of processors, of all that ``evolve`` does: motion, samples, training, checks.
        times: held-out moments.
        errors: mean distance between found and true surface, the mean of both ways, at each; None without a surface.
        volumes: found over true, at each.
        areas: likewise.
        components: of the surface at each; the truth has one.
        correspondence: mean distance of carried points from where they truly are, at each; None where they are lost.
        calm: share of the triangles of a mesh of the start that are stretched by less than 4 until the end.
    """

    figure: str
    method: str
    seconds: float
    times: tuple[float, ...]
    errors: tuple[float | None, ...]
    volumes: tuple[float | None, ...]
    areas: tuple[float | None, ...]
    components: tuple[int, ...]
    correspondence: tuple[float | None, ...]
    calm: float | None


@dataclass(frozen=True, kw_only=True)
class MotionBench(Benchmark[MotionRow]):
    """Figures in motion, each from exact key shapes at even times.

    Attributes:
        config: how all are trained.
        kinds: of ``evolve``.
        figures: names in `FIGURES`.
        keys: how many key shapes.
        noise: standard deviation of the ranges of scans of the key shapes, over the diagonal, which are fitted then;
            None shows the exact key shapes.
        fits: settings of those fits.
        moments: how many held-out times, spread evenly between the first key and the last, none of them a key.
        resolution: cells along each side of the meshes.
    """

    name = "motion"
    source = "figures whose motion is known in closed form"
    row = MotionRow
    apart = ("kinds", "figures")
    config: EvolveConfig
    kinds: Sequence[str]
    figures: Sequence[str] = tuple(FIGURES)
    keys: int = 5
    noise: float | None = None
    fits: FitConfig = SCAN_FITS
    moments: int = 20
    resolution: int = 96

    def jobs(self) -> list[Part]:
        """One for each figure and method; see `Benchmark.jobs`."""
        for name in self.figures:
            if name not in FIGURES:
                raise InputError(f"figures: no figure is called {name}; there are {', '.join(FIGURES)}")
        return [
            Part(self.name, f"{figure}, {method}", options=(("figure", figure), ("method", method)))
            for figure in self.figures
            for method in (BLEND, *self.kinds)
        ]

    def held_out(self) -> tuple[float, ...]:
        """The moments: middles of even intervals, moved off the keys by a tenth of one where they would meet."""
        middles = (np.arange(self.moments) + 0.5) / self.moments
        keys = np.linspace(0, 1, self.keys)
        meets = np.abs(middles[:, None] - keys).min(axis=1) < 0.01 / self.moments
        return tuple((middles + meets * 0.1 / self.moments).tolist())

    def measure(self, job: Part, context: Context) -> list[MotionRow]:
        """See `Benchmark.measure`."""
        name, method = job.parameters["figure"], job.parameters["method"]
        truth = FIGURES[name]()
        keys = tuple(np.linspace(0, 1, self.keys).tolist())
        shapes = self._key_shapes(truth, name, keys, context)
        if method == BLEND:
            blend, place = blended(shapes, keys)
            return [
                measure_motion(
                    name, method, blend, truth, self.held_out(), similarity=place, resolution=self.resolution
                )
            ]
        own = dataclasses.replace(
            self.config, kind=method, shapes=tuple(shape.name for shape in shapes), times=keys, align="none"
        )
        told, begun = context.stage(job.name), process_time()
        problem = build_problem(shapes, own)
        run = train_evolution(problem, own, shapes=shapes, progress=told)
        seconds = process_time() - begun
        row = measure_motion(
            name,
            method,
            run.field,
            truth,
            self.held_out(),
            velocity=problem.motion,
            similarity=run.similarity,
            resolution=self.resolution,
        )
        return [dataclasses.replace(row, seconds=seconds)]

    def _shown(self) -> str:
        return "exact key shapes" if self.noise is None else f"key scans with noise of {100 * self.noise:g} %"

    def _key_shapes(
        self, truth: DeformingField, name: str, keys: Sequence[float], context: Context
    ) -> list[StaticShape]:
        """The exact shapes, or fits of their scans, which are kept with the results."""
        if self.noise is None:
            return [_key_shape(truth, name, time, self.resolution) for time in keys]
        deviation = self.noise * _diagonal(_rest(truth, self.resolution))
        shapes = []
        for index, time in enumerate(keys):
            stem = f"{name.replace(' ', '-')}-{self.noise:g}-{time:.4f}"
            path = context.out / "scans" / f"{stem}.ply"
            path.parent.mkdir(parents=True, exist_ok=True)
            scan = simulate_scan(TimeSlice(truth, time), resolution=SCAN_RESOLUTION, noise=deviation, seed=index)
            write_cloud_ply(path, scan)
            home = fit_home(context.out, path, self.fits)
            kept_fit(home, path, self.fits, progress=context.stage(stem))
            shapes.append(read_shape(str(home)))
        return shapes

    def tables(self, rows: Sequence[MotionRow], *, sgemm: float) -> tuple[Table, ...]:
        """Means over the moments, then the moments of the surface errors; see `Benchmark.tables`."""

        def drift(found: Sequence[float | None]) -> float | None:
            left = [abs(one - 1) * 100 for one in found if one is not None]
            return max(left) if left else None

        def most(row: MotionRow) -> int:
            return max(row.components)

        figures: list[Figure[MotionRow]] = [
            (Column("surface, %", ".3f"), lambda r: mean(r.errors)),
            (Column("worst time", ".3f"), lambda r: max((e for e in r.errors if e is not None), default=None)),
            (Column("points, %", ".2f"), lambda r: mean(r.correspondence)),
            (Column("volume off, %", ".1f"), lambda r: drift(r.volumes)),
            (Column("area off, %", ".1f"), lambda r: drift(r.areas)),
            (Column("parts at most", "d"), most),
            (Column("stretch < 4, %", ".1f"), lambda r: None if r.calm is None else 100 * r.calm),
            (Column("CPU, s", ".0f"), lambda r: r.seconds),
        ]
        note = (
            f"{len(rows[0].times)} held-out moments between {self.keys} {self._shown()}; lengths in percent of the "
            "diagonal; volume and area at the worst moment"
        )
        items = [(f"{row.figure}, {row.method}", row) for row in rows]
        moments: list[Figure[tuple[float | None, ...]]] = [
            (Column(f"{row.figure}, {row.method}", ".3f"), lambda errors, index=index: errors[index])
            for index, row in enumerate(rows)
        ]
        over = [(f"{time:.3f}", tuple(row.errors[index] for row in rows)) for index, time in enumerate(rows[0].times)]
        return (
            tabulated(self.name, "Motions of exact figures", "figure", figures, items, notes=[note]),
            tabulated("motion-moments", "Surface errors at each moment, in percent", "t", moments, over),
        )


def measure_motion(
    figure: str,
    method: str,
    field: Field,
    truth: DeformingField,
    times: Sequence[float],
    *,
    velocity: VectorField | None = None,
    similarity: Similarity | None = None,
    resolution: int = 96,
) -> MotionRow:
    """The figures of a field of space-time against the truth.

    Args:
        figure: name for the row.
        method: likewise.
        field: four-dimensional.
        truth: the figure.
        times: growing moments, after 0.
        velocity: what carries points; None is what the field's normal speeds say (`CarriedVelocity`).
        similarity: from the truth's coordinates to those of ``field`` and ``velocity``; None: they are the same.
        resolution: of the meshes, in cells along the cube.
    """
    place = similarity or Similarity.identity()
    rest = _rest(truth, resolution)
    diagonal = _diagonal(rest)
    frames = [_frame(field, truth, rest, place, time, resolution) for time in times]
    paths = carried_points(field, velocity, rest.vertices, times, place)
    apart: list[float | None] = [None] * len(times)
    calm = None
    if paths is not None:
        wanted = [_moved(truth, rest.vertices, time) for time in times]
        apart = [
            100 * float(np.linalg.norm(path - exact, axis=1).mean()) / diagonal
            for path, exact in zip(paths, wanted, strict=True)
        ]
        calm = float((triangle_stretch(rest.vertices, paths[-1], rest.faces) < STRETCHED).mean())
    return MotionRow(
        figure,
        method,
        0.0,
        tuple(times),
        tuple(None if frame is None else 100 * frame.error / diagonal for frame in frames),
        tuple(None if frame is None else frame.volume for frame in frames),
        tuple(None if frame is None else frame.area for frame in frames),
        tuple(0 if frame is None else frame.components for frame in frames),
        tuple(apart),
        calm,
    )


class _Frame(NamedTuple):
    """One moment: mean distance, volume and area over the true ones, components."""

    error: float
    volume: float
    area: float
    components: int


def _frame(
    field: Field, truth: DeformingField, rest: Mesh, place: Similarity, time: float, resolution: int
) -> _Frame | None:
    """The surface of a moment against the true one; None without a surface."""
    exact = Mesh(_moved(truth, rest.vertices, time), rest.faces)
    try:
        mesh = extract_mesh(TimeSlice(field, time), resolution=resolution, normals=False)
    except NoSurfaceError:
        return None
    found = Mesh(place.to_input(mesh.vertices), mesh.faces)
    both = (_mean_distance(found, exact) + _mean_distance(exact, found)) / 2
    return _Frame(both, volume(found) / volume(exact), _area(found) / _area(exact), components(found))


def triangle_stretch(before: Float64, after: Float64, faces: NDArray[np.integer]) -> Float64:
    """By how much each triangle is stretched at most, ``(F,)``: the larger singular value of the map of its plane.

    Args:
        before: vertices ``(V, 3)``.
        after: the same vertices ``(V, 3)`` later.
        faces: ``(F, 3)``; of those without an area the stretch is that of their longest edge.
    """
    metric, other = (_metric(rows[faces]) for rows in (before, after))
    # The squares of the singular values are the eigenvalues of M⁻¹ N, with M and N the metrics of before and after.
    determinant = metric[:, 0] * metric[:, 2] - metric[:, 1] ** 2
    flat = determinant <= 1e-12 * (metric[:, 0] + metric[:, 2]) ** 2
    safe = np.where(flat, 1.0, determinant)
    trace = (metric[:, 2] * other[:, 0] - 2 * metric[:, 1] * other[:, 1] + metric[:, 0] * other[:, 2]) / safe
    product = (other[:, 0] * other[:, 2] - other[:, 1] ** 2) / safe
    largest = trace / 2 + np.sqrt(np.maximum(trace**2 / 4 - product, 0.0))
    longest = np.maximum(other[:, 0], other[:, 2]) / np.maximum(np.maximum(metric[:, 0], metric[:, 2]), 1e-300)
    return np.sqrt(np.maximum(np.where(flat, longest, largest), 0.0))


def _metric(corners: Float64) -> Float64:
    """Squares and product of two edges ``(F, 3)``: ⟨a, a⟩, ⟨a, b⟩, ⟨b, b⟩."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.stack([(a * a).sum(axis=1), (a * b).sum(axis=1), (b * b).sum(axis=1)], axis=1)


def _rest(truth: DeformingField, resolution: int) -> Mesh:
    """The mesh of the rest shape, its vertices on the surface."""
    mesh = extract_mesh(truth.field, resolution=resolution, normals=False)
    points = project_to_surface(truth.field, torch.from_numpy(mesh.vertices), steps=3)[0]
    return Mesh(points.double().numpy(), mesh.faces)


def _key_shape(truth: DeformingField, name: str, time: float, resolution: int) -> StaticShape:
    rest = _rest(truth, resolution)
    surface = Mesh(_moved(truth, rest.vertices, time), rest.faces)
    return StaticShape(f"{name} at {time:g}", TimeSlice(truth, time), Similarity.identity(), surface)


def _diagonal(surface: Mesh) -> float:
    return float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))


def blended(
    shapes: Sequence[StaticShape], keys: tuple[float, ...], align: Literal["none", "center", "pca"] = "none"
) -> tuple[Keyframes, Similarity]:
    """The blend in the unit sphere that ``evolve`` works in, and the way from the first shape's coordinates to it."""
    first = shapes[0].similarity
    placed = aligned(list(shapes), align)
    placed, region = into_unit_sphere(placed, np.concatenate([shape.surface.vertices for shape in placed]))
    x, y, z = first.to_input(np.asarray(region.center)).tolist()
    return Keyframes(keys, [shape.field for shape in placed]), Similarity((x, y, z), first.scale * region.scale)


def _moved(truth: DeformingField, points: Float64, time: float) -> Float64:
    return truth.motion.forward(torch.from_numpy(points), time).numpy()


@torch.no_grad()
def carried_points(
    field: Field,
    velocity: VectorField | None,
    points: Float64,
    times: Sequence[float],
    place: Similarity | None = None,
) -> list[Float64] | None:
    """Where points of time 0 are at each of some growing times after it; None if they cannot be followed.

    Args:
        field: four-dimensional.
        velocity: what carries points; None is what the field's normal speeds say (`CarriedVelocity`).
        points: ``(N, 3)``.
        times: ``(T,)``.
        place: from the coordinates of the points to those of ``field`` and ``velocity``; None: they are the same.
    """
    place = place or Similarity.identity()
    start: Tensor = torch.from_numpy(place.to_unit(points)).float()
    try:
        path = trajectories(velocity or CarriedVelocity(field), start, [0.0, *times], solver=CARRY)
    except (IntegrationError, NoSurfaceError):
        return None
    return [place.to_input(rows.double().numpy()) for rows in path[1:]]


def _mean_distance(surface: Mesh, other: Mesh) -> float:
    """How far points of one surface are from the other one, on average."""
    points, _ = sample_points(surface, SAMPLES, np.random.default_rng(0))
    return float(np.abs(MeshDistance(other).with_slope(points, certain=False)[0]).mean())


def _area(surface: Mesh) -> float:
    return float(face_normals(surface)[1].sum())
