"""``reconstruct --geometry-only``: geometries from photographs, with everything else equal."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.pipelines.reconstruct.model import SceneModel, build_scene
from mplicits.pipelines.training.settings import ReconstructConfig
from mplicits.pipelines.training.trainer import seeded
from scipy.special import stdtrit

from ..harness.benchmark import Benchmark, Part, one_of_each, plain
from ..harness.jobs import Context, read_record
from ..harness.tables import Column, Figure, Table, tabulated
from .reconstruct import ALIKE, UNUSED, BenchScene, ReconstructBench
from .reconstruct_rows import MULTISCALE, NEUS, ReconstructRow

SINGLE = "single"
GEOMETRIES = (MULTISCALE, NEUS, SINGLE)
FACTORS = ("color_rate", "sharpening")  # rates in units of the geometry's
APART = (*UNUSED, "seed", "learning_rate")  # settings that are in the jobs, or change no row


@dataclass(frozen=True)
class GeometryRow:
    """One training.

    Attributes:
        geometry: one of `GEOMETRIES`.
        rate: peak learning rate of the geometry.
        seed: of weights and rays.
        result: what came of it.
    """

    geometry: str
    rate: float
    seed: int
    result: ReconstructRow


@dataclass(frozen=True)
class Interval:
    """A mean, and the half-width of its confidence interval."""

    mean: float
    half: float

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.half:.2f}"


def interval(numbers: Sequence[float], confidence: float = 0.95) -> Interval:
    """Student's interval: mean ± t s / sqrt(n), of n ≥ 2 numbers that are independent and nearly normal.

    Args:
        numbers: n of them.
        confidence: that the interval holds the expectation.

    Raises:
        statistics.StatisticsError: fewer than two numbers.

    Example:
        >>> str(interval([1.0, 3.0]))
        '2.00 ± 12.71'
    """
    spread = statistics.stdev(numbers) / math.sqrt(len(numbers))
    return Interval(statistics.fmean(numbers), float(stdtrit(len(numbers) - 1, (1 + confidence) / 2)) * spread)


def single_siren(config: ReconstructConfig) -> ReconstructConfig:
    """The settings with one SIREN in place of all levels: as deep and of as high a frequency as the last of them.

    A SIREN of width w, depth d and F features has 4 w + (d - 1) (w^2 + w) + (1 + F) (w + 1) parameters. Its width is
    the whole number that brings them nearest to those of all levels together.
    """
    depth, outputs = config.depths[-1], 1 + config.features

    def parameters(width: int, depth: int) -> int:
        return 4 * width + (depth - 1) * (width * width + width) + outputs * (width + 1)

    wanted = sum(parameters(width, depth) for width, depth in zip(config.widths, config.depths, strict=True))
    linear = 4 + depth - 1 + outputs
    root = 2 * (wanted - outputs) / (linear + math.sqrt(linear**2 + 4 * (depth - 1) * (wanted - outputs)))
    width = min((math.floor(root), math.ceil(root)), key=lambda width: abs(parameters(width, depth) - wanted))
    return dataclasses.replace(config, widths=(width,), depths=(depth,), omegas=config.omegas[-1:], starts=(0.0,))


@dataclass(frozen=True, kw_only=True)
class _Training(ReconstructBench):
    """One training of one geometry; all have the first weights of the same colour network.

    Attributes:
        geometry: one of `GEOMETRIES`.
    """

    geometry: str

    def config_of(self, kind: str) -> ReconstructConfig:
        """The settings as they are, but for the levels, and with the same rays for all."""
        config = dataclasses.replace(self.config, **ALIKE)
        return single_siren(config) if self.geometry == SINGLE else config

    def build(self, config: ReconstructConfig, *, has_masks: bool, views: int) -> SceneModel:
        """The multiscale scene, with the geometry exchanged."""
        model = build_scene(self.config, has_masks=has_masks, views=views)
        if self.geometry == NEUS:
            with seeded(config.seed):
                model.geometry = NeusSDF(num_features=config.features, radius=config.radius)
        elif self.geometry == SINGLE:
            model.geometry = build_scene(config, has_masks=has_masks).geometry
        return model


@dataclass(frozen=True, kw_only=True)
class GeometryBench(Benchmark[GeometryRow]):
    """The multiscale geometry, NeuS's network, and one SIREN of as many parameters as the multiscale one.

    Colour network and its first weights, encodings of position and direction, features that it gets, rays, samples,
    schedules, and rates of all that is not geometry are the same for all three. With the first seed every geometry is
    trained with each of the rates; the one of the best PSNR is its own, a choice that favours each of them alike, and
    with the other seeds it is trained with that rate alone.

    Attributes:
        scenes: of different names.
        config: settings of all rows; seed and learning rate are chosen here.
        rates: peak learning rates of the geometry; those of colours and uncertainty stay ``color_rate · learning_rate``
            and ``sharpening · learning_rate`` of the config.
        seeds: 0, 1, … below it, two at least.
        geometries: those of `GEOMETRIES` that are trained.
        streams: trainings at a time; a step of each takes longer for that.
        test_views: the most held-out views that are measured, evenly chosen.
        resolution: of the marching cubes, of the exact surface as well.
        samples: points on each surface for Chamfer distances.
    """

    name = "geometries"
    source = "geometries from photographs, with the same colour network"
    row = GeometryRow
    apart = ("scenes", "config", "rates", "seeds", "geometries")
    scenes: Sequence[BenchScene]
    config: ReconstructConfig
    rates: tuple[float, ...] = (3e-4,)
    seeds: int = 3
    geometries: tuple[str, ...] = GEOMETRIES
    streams: int = 1
    test_views: int = 8
    resolution: int = 256
    samples: int = 500_000

    def jobs(self) -> list[Part]:
        """One for each training, all of a seed before the next; see `Benchmark.jobs`.

        Those of the first seed have a rate each; the others find theirs when those are done.
        """
        one_of_each([scene.name for scene in self.scenes], "scenes")
        for scene in self.scenes:
            self._training(scene, MULTISCALE, self.rates[0], 0).views(scene)
        first = [self.part(s, kind, r, 0) for s in self.scenes for r in self.rates for kind in self.geometries]
        some, others = [(scene, kind) for scene in self.scenes for kind in self.geometries], range(1, self.seeds)
        return first + [self.part(scene, kind, self.rates, seed) for seed in others for scene, kind in some]

    def part(self, scene: BenchScene, geometry: str, rate: float | tuple[float, ...], seed: int) -> Part:
        """The job of a training, with a rate, or with that of several which is the best one of the first seed."""
        what = (("scene", scene.name), ("pictures", scene.digest), ("geometry", geometry), ("rate", rate))
        rates = "its rate" if isinstance(rate, tuple) else f"{rate:g}"
        return Part(self.name, f"{scene.name}, {geometry}, {rates}, seed {seed}", options=(*what, ("seed", seed)))

    def goes_on(self, job: Part) -> bool:
        """See `Method.goes_on`: the other seeds wait for the rates of the first."""
        return isinstance(job.parameters["rate"], tuple)

    def settings(self, job: Part) -> Mapping[str, Any]:
        """See `Benchmark.settings`; with the rate of the colours, which the job's own does not change."""
        config = {name: value for name, value in plain(self.config).items() if name not in APART}
        fixed = {name: self.config.learning_rate * getattr(self.config, name) for name in FACTORS}
        return {**super().settings(job), "config": config, "rates": fixed}

    def _training(self, scene: BenchScene, geometry: str, rate: float, seed: int) -> _Training:
        fixed = {name: self.config.learning_rate / rate * getattr(self.config, name) for name in FACTORS}
        changes = {"geometry": "multiscale", "seed": seed, "learning_rate": rate, **fixed}
        names = ("test_views", "resolution", "samples", "device")
        options: dict[str, Any] = {name: getattr(self, name) for name in names}
        config = dataclasses.replace(self.config, **changes)
        return _Training(scenes=[scene], config=config, geometry=geometry, **options)

    def measure(self, job: Part, context: Context) -> list[GeometryRow]:
        """See `Benchmark.measure`; a training that is interrupted begins anew."""
        of = job.parameters
        scene = next(scene for scene in self.scenes if scene.name == of["scene"])
        kind, rate, seed = of["geometry"], of["rate"], of["seed"]
        if isinstance(rate, tuple):
            tried = [row for one in rate for row in self._kept(self.part(scene, kind, one, 0), context)]
            # Under a job of its own, the training is still there when other rates are tried.
            return self._kept(self.part(scene, kind, best_rate(tried), seed), context)
        row = self._training(scene, kind, rate, seed).trained(scene, kind, None, context)
        return [GeometryRow(kind, rate, seed, row)]

    def _kept(self, job: Part, context: Context) -> list[GeometryRow]:
        """The rows of another job, which is done first, unless it has been done."""
        assert context.first is not None
        where = context.first(job)
        record = read_record(where.out, where.key)
        assert record is not None
        return self.read([record])

    def tables(self, rows: Sequence[GeometryRow], *, sgemm: float) -> tuple[Table, ...]:
        """Each geometry with its own rate, and what the multiscale one gains seed by seed."""
        best = best_trainings(rows)
        table, gains = _of_geometries(self.name, best), _gains(best)
        return (table, _of_gains(f"{self.name}-gains", gains)) if gains else (table,)


Best = Mapping[tuple[str, str], Sequence[GeometryRow]]


def best_rate(rows: Sequence[GeometryRow]) -> float:
    """The rate of the best PSNR among trainings of a geometry that have one seed."""
    return max(rows, key=lambda row: row.result.psnr).rate


def best_trainings(rows: Sequence[GeometryRow]) -> Best:
    """Of every scene and geometry the trainings with the best rate of the first seed, by their seeds."""
    best: dict[tuple[str, str], list[GeometryRow]] = {}
    for scene in dict.fromkeys(row.result.scene for row in rows):
        for geometry in GEOMETRIES:
            mine = [row for row in rows if (row.result.scene, row.geometry) == (scene, geometry)]
            if first := [row for row in mine if row.seed == 0]:
                chosen = [row for row in mine if row.rate == best_rate(first)]
                best[scene, geometry] = sorted(chosen, key=lambda row: row.seed)
    return best


def _spread(numbers: Sequence[float | None]) -> str | None:
    """A mean with its interval, or alone where there is one training."""
    there = [number for number in numbers if number is not None]
    if not there or len(there) < len(numbers):
        return None
    return str(interval(there)) if len(there) > 1 else f"{there[0]:.2f}"


def _of_geometries(name: str, best: Best) -> Table:
    def chamfers(rows: Sequence[GeometryRow]) -> str | None:
        # In thousandths of the exact surface's radius squared, which are figures with few zeros.
        return _spread([r.result.surface and 1e3 * r.result.surface.largest_chamfer for r in rows])

    def normals(rows: Sequence[GeometryRow]) -> str | None:
        found = [r.result.surface and r.result.surface.normal_consistency for r in rows]
        angles = [None if one is None else math.degrees(math.acos(min(1.0, one))) for one in found]
        return _spread(angles)

    figures: list[Figure[Sequence[GeometryRow]]] = [
        (Column("rate", ".0e"), lambda rows: rows[0].rate),
        (Column("seeds", "d"), lambda rows: len(rows)),
        (Column("steps", ",d"), lambda rows: rows[0].result.steps),
        (Column("a step, ms", ".1f"), lambda rows: 1e3 * statistics.fmean(r.result.step_seconds for r in rows)),
        (Column("PSNR, dB", "s"), lambda rows: _spread([r.result.psnr for r in rows])),
        (Column("object, dB", "s"), lambda rows: _spread([r.result.psnr_object for r in rows])),
        (Column("Chamfer · 1000", "s"), chamfers),
        (Column("normals, °", "s"), normals),
        (Column("parameters", ",d"), lambda rows: rows[0].result.parameters),
        (Column("colour", ",d"), lambda rows: rows[0].result.color_parameters),
    ]
    notes = (
        "±: half of Student's 95 % interval over the seeds. Each geometry has that of the rates with which its PSNR "
        "is best with the first seed. normals: the angle whose cosine is the mean |n·n'|. Chamfer: of the largest "
        "component.",
    )
    items = [(f"{scene} {rows[0].result.network}", rows) for (scene, _), rows in best.items()]
    return tabulated(name, "Geometries with the same colours", "scene, geometry", figures, items, notes=notes)


@dataclass(frozen=True)
class _Gain:
    """Seed by seed, the PSNR of the multiscale geometry above that of another, in dB."""

    scene: str
    other: str
    gains: tuple[float, ...]


def _gains(best: Best) -> list[_Gain]:
    found = []
    for (scene, geometry), rows in best.items():
        ours = {row.seed: row.result.psnr for row in best.get((scene, MULTISCALE), ())}
        gains = tuple(ours[row.seed] - row.result.psnr for row in rows if row.seed in ours)
        if geometry != MULTISCALE and len(gains) > 1:
            found.append(_Gain(scene, rows[0].result.network, gains))
    return found


def _of_gains(name: str, gains: Sequence[_Gain]) -> Table:
    figures: list[Figure[_Gain]] = [
        (Column("seeds", "d"), lambda g: len(g.gains)),
        (Column("gain, dB", "s"), lambda g: f"{interval(g.gains).mean:+.2f} ± {interval(g.gains).half:.2f}"),
        (Column("of seeds", "s"), lambda g: f"{sum(gain > 0 for gain in g.gains)} better"),
    ]
    notes = ("Differences of trainings of the same seed. The paper has +1.08 dB in the mean of five DTU scans.",)
    items = [(f"{one.scene}, above {one.other}", one) for one in gains]
    return tabulated(name, "What the multiscale geometry gains", "scene", figures, items, notes=notes)
