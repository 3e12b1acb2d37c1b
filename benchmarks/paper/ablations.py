"""The tables loss-weights and delta-factor: one level of our fit trained again with other weights, or another band.

The error is the paper's "approximation error": the mean of |f(x) − d(x)| near the surface, with the exact signed
distance d to the mesh. Every job starts from the levels of one finished fit; only what it is about is trained again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from mplicits.neural_fields import MultiscaleSDF, Similarity
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.samples import banded_sources
from mplicits.pipelines.surface.distance import Float64, MeshDistance
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import Report

from ..harness.jobs import Context, Method, Record, Results
from ..harness.plots import Plot, Series
from ..harness.tables import Column, Row, Table, Value, mean
from ..shapes.sampled_error import approximation_error, near_surface
from .base import base_job, base_of, delta_after, generator_for, train_level, up_to
from .jobs import PaperJob, TableSpec, select, shapes_of
from .judge import reference_of
from .ours import Ours, our_config
from .published import ABL_DELTA, ABL_GRAD, ABL_NORMAL, ABL_SDF

if TYPE_CHECKING:
    from .jobs import Preset


class Constraint(NamedTuple):
    """One term of the loss: its name in the paper and in `Source`, and the paper's table."""

    title: str
    term: str
    label: str
    published: Mapping[float, tuple[float, float]]


CONSTRAINTS: Mapping[str, Constraint] = MappingProxyType(
    {
        "gradient": Constraint("Gradient (eikonal) constraint", "eikonal", "tab:abl-grad", ABL_GRAD),
        "normal": Constraint("Normal constraint", "normal", "tab:abl-normal", ABL_NORMAL),
        "sdf": Constraint("SDF constraint", "data", "tab:abl-sdf", ABL_SDF),
    }
)
WEIGHTS: Mapping[Preset, tuple[float, ...]] = MappingProxyType(
    {"smoke": (0, 100), "cpu": (0, 10, 100, 1000, 10000), "paper": tuple(ABL_GRAD)}
)
FACTORS: Mapping[Preset, tuple[float, ...]] = MappingProxyType(
    {"smoke": (1.01, 5.0), "cpu": (1.01, 1.1, 1.3, 2.0, 5.0), "paper": tuple(ABL_DELTA)}
)
POINTS: Mapping[Preset, int] = MappingProxyType({"smoke": 500, "cpu": 20_000, "paper": 200_000})
# Half-width of the shell that errors are taken over; the paper's own bands are 0.011 to 0.029 wide (Tab. deltas).
REACH = 0.02
LEVELS = ("medium", "fine")
# Of an ablated level on a CPU.
SHORT_STEPS, SHORT_BATCH = 120, 4096


class LossWeights(Method[PaperJob]):
    """One constraint's weight at one level, the others as they are; ``overrides``: constraint, level."""

    name = "loss-weights"
    depends = True
    source = "paper, supplement, tables abl-grad, abl-normal and abl-sdf"
    differs = (
        "normals by their cosine; the weights not varied are ours, that of the distances relative to the error before"
    )

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """See `Method.settings`."""
        return {**_settings(job), "weights": WEIGHTS[job.preset]}

    def run(self, job: PaperJob, context: Context) -> Results:
        """See `Method.run`: one output per weight, each with its "weight" and "error"."""
        choice = dict(job.overrides)
        constraint, level = choice["constraint"], int(choice["level"])
        base = base_of(job, context)
        config = short(base.config, job.preset)
        truth = _Truth(job, base.similarity)
        index, previous = base.index(), up_to(base.field, level - 1)
        delta = float(base.field.deltas[level - 1])
        outputs = []
        for weight in WEIGHTS[job.preset]:
            weights = {{"gradient": "eikonal", "normal": "normal", "sdf": "data"}[constraint]: weight}
            field = _next_level(
                index, previous, delta, config, weights, context.progress, f"{constraint} weight {weight:g}"
            )
            outputs.append({"name": f"{weight:g}", "weight": weight, "error": truth.error(field)})
        details = {"without": truth.error(previous), "fit": truth.error(up_to(base.field, level))}
        return Results(tuple(outputs), deltas=(delta,), details=details)


class DeltaFactor(Method[PaperJob]):
    """Both residual levels in bands of another width; ``overrides``: epsilon, one less than the factor."""

    name = "delta-factor"
    depends = True
    source = "paper, supplement, table abl-delta"
    differs = "δ is a robust maximum of |f| over the points (fit's own), not the plain one"

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """See `Method.settings`."""
        return _settings(job)

    def run(self, job: PaperJob, context: Context) -> Results:
        """See `Method.run`: one output per residual level, each with its "error"."""
        base = base_of(job, context)
        config = dataclasses.replace(short(base.config, job.preset), **dict(job.overrides))
        truth, index = _Truth(job, base.similarity), base.index()
        field, outputs = up_to(base.field, 0), []
        for name in LEVELS:
            delta = delta_after(index, field, config)
            field = _next_level(
                index, field, delta, config, {}, context.progress, f"δ × {1 + config.epsilon:g}, {name}"
            )
            outputs.append({"name": name, "error": truth.error(field)})
        return Results(tuple(outputs), deltas=tuple(field.deltas.tolist()))


def short(config: FitConfig, preset: Preset) -> FitConfig:
    """The schedule of one ablated level: on a CPU shorter than the fit's own, since there are many levels."""
    if preset != "cpu":
        return config
    steps = tuple(min(count, SHORT_STEPS) for count in config.steps)
    return dataclasses.replace(config, steps=steps, batch=SHORT_BATCH, samples=100_000)


def _settings(job: PaperJob) -> dict[str, Any]:
    base = base_job(job)
    level = short(our_config(base), job.preset)
    sizes = {"points": POINTS[job.preset], "reach": REACH, "steps": level.steps, "batch": level.batch}
    return {**Ours().settings(base), **sizes, "samples": level.samples}


def _next_level(
    index: CloudDistance,
    previous: MultiscaleSDF,
    delta: float,
    config: FitConfig,
    weights: Mapping[str, float],
    progress: Report | None,
    stage: str,
) -> MultiscaleSDF:
    """``previous`` with one more residual level, newly trained; ``weights`` replace those of terms that count."""
    generator = generator_for(config, previous.num_levels)
    sources = [
        dataclasses.replace(source, **{name: weight for name, weight in weights.items() if getattr(source, name)})
        for source in banded_sources(index, previous, delta, config, generator=generator)
    ]
    network = train_level(previous.num_levels, sources, config, generator=generator, progress=progress, stage=stage)
    return previous.with_level(network, delta=delta)


class _Truth:
    """Points near the surface of a job's shape, in the fit's coordinates, and their exact distances."""

    def __init__(self, job: PaperJob, similarity: Similarity) -> None:
        surface = reference_of(job).moved(similarity)
        self.points: Float64 = near_surface(surface, POINTS[job.preset], reach=REACH, seed=job.seed)
        self.distances: Float64 = MeshDistance(surface).signed(self.points)

    def error(self, field: MultiscaleSDF) -> float:
        """Of the finest level."""
        return approximation_error(field, self.points, self.distances)


def loss_weight_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    """The fits, and for each shape, constraint and residual level one job with all weights."""
    varied = [
        PaperJob(shape, LossWeights.name, preset, overrides=(("constraint", constraint), ("level", level)))
        for shape in shapes
        for constraint in CONSTRAINTS
        for level in (1, 2)
    ]
    return [*(base_job(PaperJob(shape, LossWeights.name, preset)) for shape in shapes), *varied]


def loss_weight_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """One table per constraint: weight → mean error of the medium and of the fine level."""
    found = [record for record in select(records, method=LossWeights.name) if record["outputs"]]
    tables = []
    for constraint, (title, _, label, published) in CONSTRAINTS.items():
        levels = [select(found, overrides={"constraint": constraint, "level": level}) for level in (1, 2)]
        weights = sorted({output["weight"] for records in levels for record in records for output in record["outputs"]})
        rows = [
            Row(f"{weight:g}", tuple(_mean_error(part, f"{weight:g}") for part in levels), published.get(weight))
            for weight in weights
        ]
        if not rows:
            continue
        for name, detail in (("level not trained at all", "without"), ("the finished fit, its own weights", "fit")):
            errors = tuple(mean(record["details"][detail] for record in part) for part in levels)
            rows.append(Row(name, errors, competes=False))
        tables.append(
            Table(
                f"loss-weights-{constraint}",
                f"{title}: mean |f − d| near the surface, by weight ({label})",
                "weight",
                _columns(),
                tuple(rows),
                notes=_notes(found),
            )
        )
    return tuple(tables)


def delta_factor_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    """The fits, and one job for each shape and factor."""
    varied = [
        PaperJob(shape, DeltaFactor.name, preset, overrides=(("epsilon", round(factor - 1, 6)),))
        for shape in shapes
        for factor in FACTORS[preset]
    ]
    return [*(base_job(PaperJob(shape, DeltaFactor.name, preset)) for shape in shapes), *varied]


def delta_factor_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """Factor 1 + ε → mean bands and mean errors of the medium and of the fine level."""
    found = [record for record in select(records, method=DeltaFactor.name) if record["outputs"]]
    rows = []
    for epsilon in sorted({record["cell"]["overrides"]["epsilon"] for record in found}):
        part = select(found, overrides={"epsilon": epsilon})
        deltas = tuple(mean(record["deltas"][level] for record in part) for level in (0, 1))
        errors = tuple(_mean_error(part, name) for name in LEVELS)
        factor = round(1 + epsilon, 6)
        published = ABL_DELTA.get(factor)
        rows.append(Row(f"{factor:g}", (*deltas, *errors), None if published is None else (None, None, *published)))
    if not rows:
        return ()
    columns = (Column("δ₁"), Column("δ₂"), *_columns())
    title = "δ factor: mean |f − d| near the surface, by the factor on the bands' half-widths (tab:abl-delta)"
    return (Table("delta-factor", title, "factor", columns, tuple(rows), notes=_notes(found)),)


def error_plots(tables: Sequence[Table]) -> tuple[Plot, ...]:
    """One plot per table: the errors over what was varied, with the paper's own."""
    plots = []
    for table in tables:
        rows = [row for row in table.rows if row.competes]
        series = []
        for index, column in enumerate(table.columns):
            if column.best is None:  # a band's width, no error
                continue
            ours = [row.values[index] for row in rows]
            theirs = [None if row.published is None else row.published[index] for row in rows]
            series += [_series(column.name, ours), _series(f"{column.name}, paper", theirs)]
        places = tuple(row.name for row in rows)
        plots.append(Plot(table.name, table.title, places, tuple(series), "mean |f − d|", lines=True))
    return tuple(plots)


def _series(name: str, values: Sequence[Value]) -> Series:
    return Series(name, tuple(value if isinstance(value, int | float) else None for value in values))


def _columns() -> tuple[Column, ...]:
    return tuple(Column(f"{name} level", ".5f", best="lowest") for name in LEVELS)


def _mean_error(records: Sequence[Record], name: str) -> float | None:
    return mean(output["error"] for record in records for output in record["outputs"] if output["name"] == name)


def _notes(found: Sequence[Record]) -> tuple[str, ...]:
    preset: Preset = found[0]["cell"]["preset"]
    shapes = shapes_of(found)
    return (
        f"Means over the shapes ({', '.join(shapes)}); the paper's figures are of Lucy.",
        f"The error is taken over {POINTS[preset]:,} points, uniform on the mesh and moved along its normal by up to "
        f"±{REACH:g}, against exact signed distances to the mesh. The paper does not define its points.",
        "Coarser levels come from one finished fit of the shape; only the level in question is trained again"
        + (f", for {SHORT_STEPS} steps of {SHORT_BATCH:,} samples." if preset == "cpu" else "."),
        f"Weights and factors tried here: {', '.join(f'{w:g}' for w in WEIGHTS[preset])} and "
        f"{', '.join(f'{f:g}' for f in FACTORS[preset])}.",
    )


LOSS_WEIGHTS = TableSpec(
    "loss-weights",
    "Tabs. abl-grad, abl-normal, abl-sdf",
    "each term of the loss at weights from none to far too much, at the medium and at the fine level",
    loss_weight_jobs,
    loss_weight_tables,
    lambda records: error_plots(loss_weight_tables(records)),
)
DELTA_FACTOR = TableSpec(
    "delta-factor",
    "Tab. abl-delta",
    "narrower and wider bands",
    delta_factor_jobs,
    delta_factor_tables,
    lambda records: error_plots(delta_factor_tables(records)),
)
