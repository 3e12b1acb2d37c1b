"""The table isolation: residual levels without bands, bands without residual levels, and the method with both.

All variants stand on the same coarse network, that of the finished fit, which itself is variant (a). Each is
extracted in the way that is sound for it: (a) and (c) level by level inside their bands, (b) on the whole domain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch
from mplicits.neural_fields import Field, Jet, MultiscaleSDF, NoSurfaceError, extract_mesh
from mplicits.neural_fields.networks.multiscale import Parts, walk_levels
from mplicits.pipelines.fit.samples import banded_sources
from mplicits.pipelines.training.trainer import Report, parameter_count
from torch import Tensor, nn

from ..harness.jobs import Context, Method, Record, Results
from ..harness.tables import Column, Row, Table, Value, mean, median
from .base import (
    Base,
    base_job,
    base_of,
    delta_after,
    domain_sources,
    generator_for,
    on_its_own,
    train_level,
    up_to,
    without_bands,
)
from .jobs import PaperJob, TableSpec, select, shapes_of
from .judge import Judge, protocol_of
from .ours import Ours
from .published import CD_WITHOUT_CULLING, COMPONENTS, TAB_ISOLATION

if TYPE_CHECKING:
    from .jobs import Preset

NOISE = 0.01
VARIANTS: Mapping[str, str] = MappingProxyType(
    {
        "a": "(a) with residual, with bands (ours)",
        "b": "(b) with residual, without bands",
        "c": "(c) without residual, with bands",
    }
)
UNCULLED = " without culling"
FIGURES = (
    Column("mean CD", ".2e", "lowest"),
    Column("median CD", ".2e", "lowest"),
    Column("mean Hausdorff", ".2e", "lowest"),
    Column("mean shell IoU", ".3f", "highest"),
    Column("mean IoU", ".3f", "highest"),
    Column("mean components", ".1f", "lowest"),
)
LIPSCHITZ = 1.25  # as our own fields are extracted with: the eikonal term keeps |∇f| near 1


class IndependentLevels(Field):
    """Nested distances, each on its own: f_j is a network inside the band of f_{j−1}, and f_{j−1} elsewhere.

    Args:
        levels: coarse to fine; the first is defined everywhere.
        deltas: half-width of the band around each level but the last.

    Raises:
        ValueError: the numbers of levels and deltas do not fit.
    """

    def __init__(self, levels: Sequence[Field], deltas: Sequence[float]) -> None:
        super().__init__()
        if len(deltas) != len(levels) - 1:
            raise ValueError(f"deltas has {len(deltas)} entries for {len(levels)} levels; expected one less")
        self.levels = nn.ModuleList(levels)
        self.in_dim, self.num_levels = levels[0].in_dim, len(levels)
        self.register_buffer("deltas", torch.tensor(deltas, dtype=torch.get_default_dtype()))

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.level_values(x, level=level)[-1]

    def level_values(self, x: Tensor, *, level: int = -1) -> list[Tensor]:
        """See `Field.level_values`."""
        return [f for (f,) in self._walk(x, level, lambda own, points: (own.value(points),))]

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        return Jet(*list(self._walk(x, level, lambda own, points: own.jet(points)))[-1])

    def with_level(self, own: Field, *, delta: float) -> IndependentLevels:
        """This field with one more level inside ``|f_last| < delta``; the levels are shared, not copied."""
        return IndependentLevels([*self._fields(), own], [*self.deltas.tolist(), delta]).to(self.deltas.device)

    def finest(self) -> Field:
        """The last network, without the bands that it lives in."""
        return self._fields()[-1]

    def _fields(self) -> list[Field]:
        return [level for level in self.levels if isinstance(level, Field)]

    def _walk(self, x: Tensor, level: int, evaluate: Callable[[Field, Tensor], Parts]) -> Iterator[Parts]:
        """The jets of the levels up to ``level``: inside a band the next one takes the place of the one before."""
        levels = self._fields()[: self.resolve_level(level) + 1]
        return walk_levels(levels, self.deltas, self.check_points(x), evaluate, lambda _before, own, _delta: own)


class Isolation(Method[PaperJob]):
    """One variant of the residual levels, trained on the coarse level of our fit; ``overrides``: variant, a, b or c.

    Variant (a) is the fit itself, so its job only extracts it once more, with and without culling. No blobs are
    removed from any of them, as the fit's own row elsewhere has it, since blobs are what this is about.
    """

    name = "isolation"
    depends = True
    source = "paper, supplement, table isolation"
    differs = "the schedule, the weights and the samples are those of our fit"

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """See `Method.settings`."""
        return Ours().settings(base_job(job))

    def run(self, job: PaperJob, context: Context) -> Results:
        """See `Method.run`; outputs "a", "b" or "c", and with noise "a without culling" and "c without culling"."""
        variant = str(dict(job.overrides)["variant"])
        base, judge = base_of(job, context), Judge(job, context)
        resolution = protocol_of(job.preset).resolution
        started = time.perf_counter()
        if variant == "a":
            field, unculled = base.field, without_bands(base.field)
        elif variant == "b":
            field, unculled = residuals_everywhere(base, context.progress), None
        else:
            field = distances_in_bands(base, context.progress)
            unculled = field.finest()
        surfaces: list[tuple[str, Field, bool, int]] = [(variant, field, variant == "b", resolution)]
        if unculled is not None and job.noise:  # as in the paper; it takes longer than all the rest
            surfaces.append((variant + UNCULLED, unculled, True, resolution // 2))
        seconds = time.perf_counter() - started
        outputs = []
        for name, surface, everywhere, cells in surfaces:
            slope = steepness(surface) if everywhere else LIPSCHITZ
            figures = _figures(judge, base, name, surface, slope, cells, seconds)
            outputs.append({**figures, "lipschitz": slope, "resolution": cells})
        deltas = () if variant == "b" else tuple(field.deltas.tolist())
        return Results(tuple(outputs), deltas=deltas)


def _figures(
    judge: Judge, base: Base, name: str, field: Field, lipschitz: float, cells: int, train_seconds: float
) -> dict[str, Any]:
    started = time.perf_counter()
    try:
        mesh = extract_mesh(field, resolution=cells, lipschitz=lipschitz)
    except NoSurfaceError:
        mesh = None
    seconds = time.perf_counter() - started
    parameters = parameter_count(field)
    return judge.mesh(
        name, mesh, base.similarity, parameters=parameters, train_seconds=train_seconds, mesh_seconds=seconds
    )


def residuals_everywhere(base: Base, progress: Report | None = None) -> MultiscaleSDF:
    """Variant (b): the residuals learn from distances on the whole domain, and are added everywhere."""
    index, field = base.index(), up_to(base.field, 0)
    for level in range(1, base.field.num_levels):
        generator = generator_for(base.config, level)
        sources = domain_sources(index, field, base.config, generator=generator)
        network = train_level(
            level, sources, base.config, generator=generator, progress=progress, stage=f"(b) level {level}"
        )
        field = field.with_level(network, delta=math.inf)
    return field


def distances_in_bands(base: Base, progress: Report | None = None) -> IndependentLevels:
    """Variant (c): every level is a distance of its own, which learns inside the band of the one before it."""
    index = base.index()
    field = IndependentLevels([base.field.base], [])  # pyright: ignore[reportArgumentType]
    for level in range(1, base.field.num_levels):
        generator, delta = generator_for(base.config, level), delta_after(index, field, base.config)
        sources = on_its_own(banded_sources(index, field, delta, base.config, generator=generator))
        network = train_level(
            level,
            sources,
            base.config,
            generator=generator,
            residual=False,
            progress=progress,
            stage=f"(c) level {level}",
        )
        field = field.with_level(network, delta=delta)
    return field


@torch.no_grad()
def steepness(field: Field, *, count: int = 1 << 16, margin: float = 1.25, seed: int = 0) -> float:
    """A bound on |∇f| in the mesher's box: its largest value at random points, times ``margin``; 1.25 at least."""
    points = 1.02 * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)) - 1)
    slopes = field.jet(points.to(field.like.device)).gradient.norm(dim=-1)
    return max(LIPSCHITZ, margin * float(slopes.max()))


def isolation_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    """The fits and the variants of each shape, clean and with noise."""
    plain = [PaperJob(shape, Isolation.name, preset, noise=noise) for shape in shapes for noise in (0.0, NOISE)]
    varied = [
        PaperJob(job.shape, job.method, preset, noise=job.noise, overrides=(("variant", variant),))
        for job in plain
        for variant in VARIANTS
    ]
    return [*map(base_job, plain), *varied]


def isolation_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """The paper's table, and what culling does to (a) and (c)."""
    if not any(record["outputs"] for record in select(records, method=Isolation.name)):
        return ()
    rows = []
    for variant, title in VARIANTS.items():
        values: list[Value] = []
        published: list[Value] = []
        for noise, figures in zip((NOISE, 0.0), TAB_ISOLATION[variant], strict=True):
            outputs = _outputs(records, variant, noise)
            chamfers = [output.get("chamfer") for output in outputs]
            values += [mean(chamfers), median(chamfers)]
            values += [mean(o.get(what) for o in outputs) for what in ("hausdorff", "shell_iou", "iou", "components")]
            published += [*figures, None, None]
        rows.append(Row(title, tuple(values), tuple(published), source=Isolation.source))
    columns = tuple(
        Column(f"{figure.name}, {cloud}", figure.form, figure.best)
        for cloud in ("1 % noise", "clean")
        for figure in FIGURES
    )
    shapes = shapes_of(select(records, method=Isolation.name))
    title = "Isolating the residual sum and the nested bands (tab:isolation)"
    notes = (
        f"Means over the shapes ({', '.join(shapes)}); the paper's figures are of ten others.",
        "All variants share the coarse network, the schedule and the weights. (a) and (c) are extracted inside their "
        "bands; (b) on the whole domain, culled only by the steepest slope measured there. No blobs are removed.",
        "The paper's IoU is that of surface voxels, here shell IoU; IoU is of volumes. Hausdorff is squared.",
    )
    return Table("isolation", title, "variant", columns, tuple(rows), notes), _culling_table(records)


def _culling_table(records: Sequence[Record]) -> Table:
    rows = []
    for variant in ("a", "c"):
        for suffix in ("", UNCULLED):
            outputs = _outputs(records, variant + suffix, NOISE)
            parts = [output["components"] for output in outputs if output.get("components") is not None]
            chamfer = CD_WITHOUT_CULLING[variant] if suffix else TAB_ISOLATION[variant][0][0]
            span = " to ".join(f"{count:,}" for count in sorted({min(parts), max(parts)})) if parts else None
            published = (chamfer, COMPONENTS[variant] if suffix else None)
            name = VARIANTS[variant] + (", extracted without culling" if suffix else "")
            rows.append(Row(name, (mean(output.get("chamfer") for output in outputs), span), published))
    columns = (Column("mean CD, 1 % noise", best="lowest"), Column("components"))
    notes = (
        "Without culling the finest level is evaluated everywhere: for (a) the sum of all levels, for (c) its last "
        "network. Those meshes are extracted at half the resolution, since the whole lattice must be evaluated.",
    )
    return Table("isolation-culling", "What is left outside the bands", "variant", columns, tuple(rows), notes)


def _outputs(records: Sequence[Record], name: str, noise: float) -> list[Mapping[str, Any]]:
    """The surface called ``name`` in every record."""
    found = select(records, method=Isolation.name, noise=noise)
    return [output for record in found for output in record["outputs"] if output["name"] == name]


ISOLATION = TableSpec(
    "isolation",
    "Tab. isolation",
    "the method without its bands, and without its residuals",
    isolation_jobs,
    isolation_tables,
    sheets=True,
)
