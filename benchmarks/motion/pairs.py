"""``motion A B``: figures of the motion between two meshes, without a ground truth in between.

Each mesh is fitted, and every kind of ``evolve`` that goes from shape to shape is trained between the fits; the blend
of their distances stands beside them. Parts, holes, volume and area are taken at moments on the way. A mesh of the
start is carried to the end, and pictures are compared pixel by pixel. Both ends are painted, each with smooth waves of
its own, and carried colours should be as smooth as those of the ends.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np
import torch
from mplicits.datasets.cameras import Camera
from mplicits.neural_fields import Field, InputError, Mesh, TimeSlice
from mplicits.neural_fields.meshing.extract import surface_of
from mplicits.neural_fields.spacetime.evolution import VectorField
from mplicits.pipelines.evolve.checks import volume
from mplicits.pipelines.evolve.problem import build_problem
from mplicits.pipelines.evolve.shapes import read_shape
from mplicits.pipelines.evolve.topology import topology_of
from mplicits.pipelines.evolve.train import train_evolution
from mplicits.pipelines.render.draw import Orbit, orbit_cameras
from mplicits.pipelines.render.picture import contact_sheet, in_rows, write_picture
from mplicits.pipelines.render.rasterise import mesh_view, picture_of
from mplicits.pipelines.surface.surface import face_normals, read_reference
from mplicits.pipelines.texture.transport import Colors, TransportedColors
from mplicits.pipelines.training.settings import EvolveConfig, FitConfig
from numpy.typing import NDArray
from torch import Tensor

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, mean, tabulated
from ..shapes.fits import fit_home, kept_fit
from .motion import BLEND, STRETCHED, blended, carried_points, triangle_stretch

Float64 = NDArray[np.float64]

# One level of a fit: a morph is looked at from further away than a scan is.
PAIR_FITS = FitConfig(
    widths=(128,), depths=(2,), omegas=(20.0,), steps=(500,), learning_rates=(4e-3,), batch=4096, samples=100_000
)
PIXELS = 256  # on each side of the pictures whose neighbouring pixels are compared
VIEWS = 2  # from opposite sides
APART = 3.0  # pixels; neighbours whose points are further apart are on two sides of an outline
JUMP = 1.5  # of the ends' largest, which neighbours should not exceed
WAVES, CRESTS = 6, 5.0  # of the paint in each channel, and their wave numbers' deviation along each axis
TILE, ACROSS = 200, 7  # pixels of a picture on a contact sheet, and pictures in a row


@dataclass(frozen=True)
class PairRow:
    """One method between two meshes; lengths are in units of the unit sphere that ``evolve`` works in.

    Attributes:
        pair: names of the meshes.
        method: a kind of ``evolve``, or the blend of distances.
        seconds: of processors, of all that ``evolve`` does; without the fits.
        times: of what follows, from 0 to 1.
        volumes: inside the surface at each; 0 without one.
        areas: likewise.
        components: likewise.
        holes: through it, the sum of genera.
        calm: share of the triangles of a mesh of the start that are stretched by less than 4 until the end; None where
            they cannot be carried.
        jumps: the largest step of the carried colours between neighbouring pixels at each time, over the larger of
            those at both ends; None where they cannot be carried.
        cracked: share of the neighbours at each that step by more than 1.5 times that.
    """

    pair: str
    method: str
    seconds: float
    times: tuple[float, ...]
    volumes: tuple[float, ...]
    areas: tuple[float, ...]
    components: tuple[int, ...]
    holes: tuple[int, ...]
    calm: float | None
    jumps: tuple[float | None, ...]
    cracked: tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class PairBench(Benchmark[PairRow]):
    """Motions between the fits of meshes.

    Attributes:
        pairs: of mesh files.
        config: how all are trained and aligned.
        kinds: of ``evolve``.
        fits: settings of the fits.
        moments: how many times are measured, 0 and 1 among them.
        resolution: cells along each side of the meshes.
        pictures: folder for a sheet of moments of each method, with the carried colours; None draws none.
    """

    name = "pairs"
    source = "motions between the fits of two meshes"
    row = PairRow
    apart = ("pairs", "kinds", "pictures")
    pairs: Sequence[tuple[Path, Path]]
    config: EvolveConfig
    kinds: Sequence[str]
    fits: FitConfig = PAIR_FITS
    moments: int = 20
    resolution: int = 96
    pictures: Path | None = None

    def jobs(self) -> list[Part]:
        """One for each pair and method; see `Benchmark.jobs`."""
        for pair in self.pairs:
            for path in pair:
                read_reference(path)
        return [
            Part(self.name, f"{first.stem} to {second.stem}, {method}", (first, second), (("method", method),))
            for first, second in self.pairs
            for method in (BLEND, *self.kinds)
        ]

    def measure(self, job: Part, context: Context) -> list[PairRow]:
        """See `Benchmark.measure`."""
        homes = []
        for path in job.files:
            home = fit_home(context.out, path, self.fits)
            kept_fit(home, path, self.fits, progress=context.stage(path.stem))
            homes.append(str(home))
        shapes, method = [read_shape(home) for home in homes], job.parameters["method"]
        told, begun = context.stage(job.name), process_time()
        if method == BLEND:
            field, _ = blended(shapes, (0.0, 1.0), self.config.align)
            motion, seconds = None, 0.0
        else:
            own = dataclasses.replace(self.config, kind=method, shapes=tuple(homes), times=())
            problem = build_problem(shapes, own, progress=told)
            field, motion = train_evolution(problem, own, shapes=shapes, progress=told).field, problem.motion
            seconds = process_time() - begun
        sheet = None
        if self.pictures is not None:
            self.pictures.mkdir(parents=True, exist_ok=True)
            sheet = self.pictures / f"{'-'.join(path.stem for path in job.files)}-{method.replace(' ', '-')}.png"
        times = tuple(np.linspace(0, 1, self.moments).tolist())
        pair = job.name.rpartition(", ")[0]
        row = measure_pair(pair, method, field, times, velocity=motion, resolution=self.resolution, sheet=sheet)
        return [dataclasses.replace(row, seconds=seconds)]

    def tables(self, rows: Sequence[PairRow], *, sgemm: float) -> tuple[Table, ...]:
        """What was least and most on the way, then all moments; see `Benchmark.tables`."""

        def extremes(values: Sequence[float]) -> str:
            ends = values[0], values[-1]
            return f"{min(values) / min(ends):.2f} to {max(values) / max(ends):.2f}" if min(ends) > 0 else "none"

        def most(values: Sequence[float | None]) -> float | None:
            return max((value for value in values if value is not None), default=None)

        def changes(row: PairRow) -> int:
            found = list(zip(row.components, row.holes, strict=True))
            return sum(a != b for a, b in itertools.pairwise(found))

        figures: list[Figure[PairRow]] = [
            (Column("parts at most", "d"), lambda r: max(r.components)),
            (Column("at the ends", "s"), lambda r: f"{r.components[0]}, {r.components[-1]}"),
            (Column("holes at the ends", "s"), lambda r: f"{r.holes[0]}, {r.holes[-1]}"),
            (Column("changes", "d"), changes),
            (Column("volume", "s"), lambda r: extremes(r.volumes)),
            (Column("area", "s"), lambda r: extremes(r.areas)),
            (Column("stretch < 4, %", ".1f"), lambda r: None if r.calm is None else 100 * r.calm),
            (Column("jump", ".1f"), lambda r: most(r.jumps)),
            (Column("cracked, %", ".2f"), lambda r: None if r.cracked[0] is None else 100 * (mean(r.cracked) or 0.0)),
            (Column("CPU, s", ".0f"), lambda r: r.seconds),
        ]
        notes = [
            f"{len(rows[0].times)} moments; volume and area: the least over that of the smaller end, the most over "
            f"that of the larger; jump: the largest step of carried colours between neighbouring pixels, over that of "
            f"both ends; cracked: neighbours above {JUMP:g} times that, of all moments"
        ]
        items = [(f"{row.pair}, {row.method}", row) for row in rows]
        moments: list[Figure[tuple[PairRow, int]]] = [
            (Column("volume", ".3f"), lambda at: at[0].volumes[at[1]]),
            (Column("area", ".3f"), lambda at: at[0].areas[at[1]]),
            (Column("parts", "d"), lambda at: at[0].components[at[1]]),
            (Column("holes", "d"), lambda at: at[0].holes[at[1]]),
            (Column("jump", ".2f"), lambda at: at[0].jumps[at[1]]),
        ]
        over = [(f"{name}, {time:.3f}", (row, k)) for name, row in items for k, time in enumerate(row.times)]
        return (
            tabulated(self.name, "Motions between meshes", "pair", figures, items, notes=notes),
            tabulated("pairs-moments", "On the way", "pair, t", moments, over),
        )


def measure_pair(
    pair: str,
    method: str,
    field: Field,
    times: Sequence[float],
    *,
    velocity: VectorField | None = None,
    resolution: int = 96,
    sheet: Path | None = None,
) -> PairRow:
    """The figures of a field of space-time; seconds are 0.

    Args:
        pair: name for the row.
        method: likewise.
        field: four-dimensional.
        times: growing, from 0 to 1.
        velocity: what carries points; None is what the field's normal speeds say (`CarriedVelocity`).
        resolution: of the meshes, in cells along the cube.
        sheet: a file for a contact sheet of the moments.

    Raises:
        InputError: there is no surface at time 0.
    """
    meshes = [surface_of(TimeSlice(field, time), resolution=resolution) for time in times]
    start = meshes[0]
    if start is None:
        raise InputError(f"{pair}, {method}: no surface at time 0")
    shapes = [topology_of(mesh) for mesh in meshes]
    path = carried_points(field, velocity, start.vertices, times[1:])
    calm = None
    if path is not None:
        calm = float((triangle_stretch(start.vertices, path[-1], start.faces) < STRETCHED).mean())
    seen = [mesh for mesh in meshes if mesh is not None]
    cameras = orbit_cameras(
        np.concatenate([mesh.vertices for mesh in seen]), Orbit(), size=(PIXELS, PIXELS), frames=VIEWS
    )
    transported = TransportedColors(field, paint(0), last=paint(1), motion=velocity)
    colors = [_carried(transported, time) for time in times]
    steps = [
        None if mesh is None or at is None else np.concatenate([color_jumps(mesh, at, camera) for camera in cameras])
        for mesh, at in zip(meshes, colors, strict=True)
    ]
    largest = max(float(found.max()) for found in (steps[0], steps[-1]) if found is not None)
    if sheet is not None:
        _draw(sheet, times, meshes, colors, cameras[0])
    volumes = tuple(0.0 if mesh is None else volume(mesh) for mesh in meshes)
    areas = tuple(0.0 if mesh is None else float(face_normals(mesh)[1].sum()) for mesh in meshes)
    return PairRow(
        pair,
        method,
        0.0,
        tuple(times),
        volumes,
        areas,
        tuple(shape.components for shape in shapes),
        tuple(shape.holes for shape in shapes),
        calm,
        tuple(None if found is None else float(found.max()) / largest for found in steps),
        tuple(None if found is None else float((found > JUMP * largest).mean()) for found in steps),
    )


def paint(seed: int) -> Colors:
    """Smooth colours of points ``(N, 3)``, from 0 to 1: in each channel the mean of six waves, drawn at random.

    Wave numbers have a deviation of 5 along each axis, so a shape in the unit sphere is some three waves long.
    """
    generator = torch.Generator().manual_seed(seed)
    numbers = CRESTS * torch.randn(3, 3 * WAVES, generator=generator)
    phases = 2 * torch.pi * torch.rand(3 * WAVES, generator=generator)

    def colors(points: Tensor) -> Tensor:
        waves = torch.sin(points @ numbers.to(points) + phases.to(points))
        return 0.5 + 0.5 * waves.reshape(-1, 3, WAVES).mean(dim=2)

    return colors


def color_jumps(mesh: Mesh, colors: Colors, camera: Camera) -> Float64:
    """How far apart the colours of neighbouring pixels of a picture are, ``(N,)``: lengths of differences.

    Neighbours beside and below each other count, where both see the surface and their points are no further apart than
    three pixels: else an outline lies between them, where colours may step. That is so at the ends as in between.

    Args:
        mesh: of a moment.
        colors: of points of its surface.
        camera: of the picture.
    """
    seen = mesh_view(mesh, camera)
    width, height = seen.size
    row = np.full(width * height, -1)
    row[seen.pixel.numpy()] = np.arange(len(seen.pixel))
    grid = row.reshape(height, width)
    pairs = [(grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])]
    first, second = (np.concatenate([pair[side].ravel() for pair in pairs]) for side in (0, 1))
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    here, found = seen.position.double().numpy(), colors(seen.position).double().numpy()
    reach = APART / float(camera.intrinsics[0, 0]) * seen.depth.double().numpy()[first]
    near = np.linalg.norm(here[first] - here[second], axis=1) <= reach
    return np.linalg.norm(found[first[near]] - found[second[near]], axis=1)


def _carried(transported: TransportedColors, time: float) -> Colors | None:
    """None where colours cannot be carried."""
    try:
        return transported.at(time)
    except InputError:
        return None


def _draw(
    path: Path,
    times: Sequence[float],
    meshes: Sequence[Mesh | None],
    colors: Sequence[Colors | None],
    camera: Camera,
) -> None:
    """A contact sheet of the moments, painted."""
    small, tiles = camera.resized(TILE, TILE), []
    for time, mesh, at in zip(times, meshes, colors, strict=True):
        if mesh is None:
            continue
        painted = None
        if at is not None:
            painted = at(torch.from_numpy(mesh.vertices).float()).double().numpy()
        tiles.append((f"t = {time:.2f}", picture_of(Mesh(mesh.vertices, mesh.faces, None, painted), small)))
    write_picture(path, contact_sheet(*in_rows(tiles, ACROSS)))
