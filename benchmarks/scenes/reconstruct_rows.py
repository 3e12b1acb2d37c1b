"""Rows of ``reconstruct``: what geometries cost on scenes, how near they come, and how ours compare."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ..harness.tables import Column, Figure, Row, Table, tabulated

NEUS = "neus"
MULTISCALE = "multiscale"
EQUAL_TIME = "equal-time"


@dataclass(frozen=True)
class SurfaceFigures:
    """A reconstructed surface against the exact one; see `Metrics`.

    Attributes:
        chamfer: squared L2, both ways, in units of the exact surface's bounding sphere.
        floor: what the exact surface itself would score.
        largest_chamfer: of the component of largest area alone.
        iou: of the volumes, or None.
        normal_consistency: mean |n·n'|, or None.
        components: connected ones.
    """

    chamfer: float
    floor: float | None
    largest_chamfer: float
    iou: float | None
    normal_consistency: float | None
    components: int


@dataclass(frozen=True)
class LateRates:
    """Evaluations per ray in the second half of a training.

    Attributes:
        values: of each level, without gradient; those that keep the grid up to date are among them.
        jets: of each level, with gradient.
        colors: of the colour network.
    """

    values: tuple[float, ...]
    jets: tuple[float, ...]
    colors: float


@dataclass(frozen=True)
class StepParts:
    """Seconds of a step in the second half of a training, by what it spends them on.

    Attributes:
        march: placing and skipping samples, the grid of values included, and composing what they see.
        jets: forward.
        colors: forward.
        backward: through all of it, and the optimiser.
    """

    march: float
    jets: float
    colors: float
    backward: float


@dataclass(frozen=True)
class ReconstructRow:
    """One geometry, trained on one scene.

    FLOPs are those of the matrix products of training; see `flops` for how they are counted.

    Attributes:
        scene: name of the scene or data set.
        kind: NEUS or MULTISCALE, both with as many steps, or EQUAL_TIME: multiscale for as long as NEUS took.
        network: widths and depths of the geometry.
        steps: training steps.
        rays: per step.
        seconds: of all steps.
        start_seconds: before the first step: making the geometry a sphere.
        step_seconds: median of the steps.
        views: held-out views that were measured.
        psnr: mean over these views, in dB.
        psnr_object: the same inside the masks; None without masks.
        ssim: mean over these views.
        parameters: of the geometry.
        color_parameters: of the colour network.
        outside_parameters: of what is behind the object, 0 if nothing is.
        geometry_flops: per ray.
        color_flops: per ray, of the colours and of what is behind the object.
        values_per_ray: evaluations of each level without gradient, to find out where to sample.
        jets_per_ray: evaluations of each level with gradient, which are trained.
        colors_per_ray: evaluations of the colour network.
        late: the same in the second half of the training alone; None if that had no step.
        parts: seconds of a step there, by what they are spent on; None on a GPU.
        finest_share: of the samples that are evaluated, how many the finest level saw while it was switched on; None if
            it never was.
        exact: whether the scene's surface is known in closed form.
        surface: None where it is not, or where the training found no surface.
        inv_std: s of NeuS at the end.
        deltas: half-widths of the bands at the end.
        device: where it was trained.
    """

    scene: str
    kind: str
    network: str
    steps: int
    rays: int
    seconds: float
    start_seconds: float
    step_seconds: float
    views: int
    psnr: float
    psnr_object: float | None
    ssim: float
    parameters: int
    color_parameters: int
    outside_parameters: int
    geometry_flops: float
    color_flops: float
    values_per_ray: tuple[float, ...]
    jets_per_ray: tuple[float, ...]
    colors_per_ray: float
    late: LateRates | None
    parts: StepParts | None
    finest_share: float | None
    exact: bool
    surface: SurfaceFigures | None
    inv_std: float
    deltas: tuple[float, ...]
    device: str

    @property
    def flops_per_ray(self) -> float:
        """Of all networks."""
        return self.geometry_flops + self.color_flops

    @property
    def flops_per_second(self) -> float:
        """That the training reached."""
        return self.flops_per_ray * self.rays * self.steps / self.seconds


# The paper's table of PSNR in dB over DTU scans 24, 37, 40, 55 and 63, and its text: "37 % fewer parameters".
PAPER = (("paper, DTU scan 24", 28.20, 31.50), ("paper, mean of 5 DTU scans", 28.86, 29.94))
PAPER_PARAMETERS = 0.37


@dataclass(frozen=True)
class Comparison:
    """Ours against NeuS on one scene, or the means over scenes; a figure is None where a row is missing.

    Attributes:
        name: of the scene.
        neus: PSNR of the held-out views, in dB.
        ours: after as many steps.
        equal_time: after as much time.
        fewer: share of the geometry's parameters that ours does without.
        step: how many times shorter its median step is.
        mean_step: the same of the mean step.
        flops: how many times fewer FLOPs a ray costs.
        chamfer: how many times smaller the Chamfer distance of its largest component is after as many steps.
        equal_time_chamfer: after as much time.
    """

    name: str
    neus: float
    ours: float
    equal_time: float | None
    fewer: float
    step: float
    mean_step: float
    flops: float
    chamfer: float | None
    equal_time_chamfer: float | None


ARITHMETIC = ("neus", "ours", "equal_time", "fewer")  # means of decibels and shares; those of ratios are geometric


def comparisons(rows: Sequence[ReconstructRow]) -> list[Comparison]:
    """One for every scene that has both rows of equal steps; of two or more, their means last."""
    found = []
    for scene in dict.fromkeys(row.scene for row in rows):
        of = {row.kind: row for row in rows if row.scene == scene}
        if NEUS in of and MULTISCALE in of:
            found.append(_comparison(of[NEUS], of[MULTISCALE], of.get(EQUAL_TIME)))
    if len(found) < 2:
        return found
    means = {}
    for name in (field.name for field in dataclasses.fields(Comparison)[1:]):
        numbers = [getattr(one, name) for one in found]
        mean = statistics.fmean if name in ARITHMETIC else statistics.geometric_mean
        means[name] = None if None in numbers else mean(numbers)
    return [*found, Comparison(name=f"mean of {len(found)} scenes", **means)]


def _comparison(neus: ReconstructRow, ours: ReconstructRow, equal: ReconstructRow | None) -> Comparison:
    return Comparison(
        name=neus.scene,
        neus=neus.psnr,
        ours=ours.psnr,
        equal_time=None if equal is None else equal.psnr,
        fewer=1 - ours.parameters / neus.parameters,
        step=neus.step_seconds / ours.step_seconds,
        mean_step=(neus.seconds / neus.steps) / (ours.seconds / ours.steps),
        flops=neus.flops_per_ray / ours.flops_per_ray,
        chamfer=_nearer(neus, ours),
        equal_time_chamfer=None if equal is None else _nearer(neus, equal),
    )


def _nearer(neus: ReconstructRow, ours: ReconstructRow) -> float | None:
    if neus.surface is None or ours.surface is None:
        return None
    return neus.surface.largest_chamfer / ours.surface.largest_chamfer


def reconstruct_tables(name: str, rows: Sequence[ReconstructRow], *, sgemm: float) -> tuple[Table, ...]:
    """All rows, and ours against NeuS where a scene has both.

    Args:
        name: of the tables' files.
        rows: of the bench.
        sgemm: the machine's matrix rate in FLOP/s, the limit of every row.
    """

    def surface(name: str) -> Callable[[ReconstructRow], float | None]:
        return lambda row: None if row.surface is None else getattr(row.surface, name)

    def largest(row: ReconstructRow) -> float | None:
        return None if row.surface is None or row.surface.components < 2 else row.surface.largest_chamfer

    figures: list[Figure[ReconstructRow]] = [
        (Column("steps", ",d"), lambda r: r.steps),
        (Column("trained, s", ".1f"), lambda r: r.seconds),
        (Column("a step, ms", ".1f"), lambda r: 1e3 * r.step_seconds),
        (Column("PSNR, dB", ".2f"), lambda r: r.psnr),
        (Column("object, dB", ".2f"), lambda r: r.psnr_object),
        (Column("SSIM", ".4f"), lambda r: r.ssim),
        (Column("Chamfer", ".2e"), lambda r: "no surface" if r.exact and r.surface is None else surface("chamfer")(r)),
        (Column("floor", ".2e"), surface("floor")),
        (Column("largest", ".2e"), largest),
        (Column("parameters", ",d"), lambda r: r.parameters),
        (Column("colour", ",d"), lambda r: r.color_parameters + r.outside_parameters),
        (Column("a ray, MFLOP", ".1f"), lambda r: r.flops_per_ray / 1e6),
        (Column("geometry", ".1f"), lambda r: r.geometry_flops / 1e6),
        (Column("fine", ".1%"), lambda r: r.finest_share),
        (Column("GFLOP/s", ".1f"), lambda r: r.flops_per_second / 1e9),
        (Column("of SGEMM", ".0%"), lambda r: r.flops_per_second / sgemm),
    ]
    counts = " or ".join(map(str, sorted({row.views for row in rows})))
    notes = (
        f"PSNR and SSIM: means over the held-out views ({counts}); object: PSNR inside the masks. a step: the median.",
        "a ray: FLOPs of all matrix products of training; geometry: its own. fine: share of the samples that the "
        "finest level sees, once it is switched on. largest: Chamfer of the largest component, where there are others.",
    )
    items = [(f"{r.scene} {r.network}{', equal time' if r.kind == EQUAL_TIME else ''}", r) for r in rows]
    table = tabulated(name, "Geometries on the same rays", "scene, geometry", figures, items, notes=notes)
    tables = (table, _evaluations(f"{name}-evaluations", items), _parts(f"{name}-parts", items))
    found = comparisons(rows)
    return (*tables, _against_neus(f"{name}-against-neus", found)) if found else tables


def _evaluations(name: str, items: Sequence[tuple[str, ReconstructRow]]) -> Table:
    """What a ray asks of the networks, in the whole training and in its second half."""

    def late(kind: str, level: int) -> Callable[[ReconstructRow], float | None]:
        return lambda row: None if row.late is None else getattr(row.late, kind)[level]

    figures: list[Figure[ReconstructRow]] = [
        (Column("values", ".1f"), lambda r: r.values_per_ray[0]),
        (Column("jets", ".1f"), lambda r: r.jets_per_ray[0]),
        (Column("finest jets", ".1f"), lambda r: r.jets_per_ray[-1]),
        (Column("colours", ".1f"), lambda r: r.colors_per_ray),
        (Column("late values", ".1f"), late("values", 0)),
        (Column("late jets", ".1f"), late("jets", 0)),
        (Column("late finest jets", ".1f"), late("jets", -1)),
        (Column("late colours", ".1f"), lambda r: None if r.late is None else r.late.colors),
    ]
    notes = ("values and jets: of the coarsest level, the jets are trained. late: in the second half of the training.",)
    return tabulated(name, "Evaluations per ray", "scene, geometry", figures, items, notes=notes)


def _parts(name: str, items: Sequence[tuple[str, ReconstructRow]]) -> Table:
    """What the time of a step is spent on."""

    def milliseconds(part: str) -> Callable[[ReconstructRow], float | None]:
        return lambda row: None if row.parts is None else 1e3 * getattr(row.parts, part)

    columns = {"march": "march", "jets": "jets", "colours": "colors", "backward": "backward"}
    figures: list[Figure[ReconstructRow]] = [
        (Column(title, ".1f"), milliseconds(part)) for title, part in columns.items()
    ]
    notes = (
        "Milliseconds of a step, means over the second half of the training. march: samples are placed, skipped and "
        "composed, the grid kept up to date. backward: the optimiser too. Nothing is said of a GPU.",
    )
    return tabulated(name, "What a step is spent on", "scene, geometry", figures, items, notes=notes)


def _against_neus(name: str, found: Sequence[Comparison]) -> Table:
    def gain(psnr: float | None, neus: float) -> str | None:
        return None if psnr is None else f"{psnr - neus:+.2f}"

    def times(factor: float | None) -> str | None:
        return None if factor is None else f"{factor:.{1 if factor >= 1 else 3}f}"

    figures: list[Figure[Comparison]] = [
        (Column("NeuS, dB", ".2f"), lambda c: c.neus),
        (Column("equal steps, dB", ".2f"), lambda c: c.ours),
        (Column("gain", "s"), lambda c: gain(c.ours, c.neus)),
        (Column("equal time, dB", ".2f"), lambda c: c.equal_time),
        (Column("gain", "s"), lambda c: gain(c.equal_time, c.neus)),
        (Column("parameters", "s"), lambda c: f"{-c.fewer:+.0%}"),
        (Column("× a step", "s"), lambda c: times(c.step)),
        (Column("× mean step", "s"), lambda c: times(c.mean_step)),
        (Column("× FLOPs a ray", "s"), lambda c: times(c.flops)),
        (Column("× Chamfer", "s"), lambda c: times(c.chamfer)),
        (Column("× equal time", "s"), lambda c: times(c.equal_time_chamfer)),
    ]
    printed = [
        Row(title, (neus, ours, gain(ours, neus), None, None, f"{-PAPER_PARAMETERS:+.0%}", *[None] * 5))
        for title, neus, ours in PAPER
    ]
    notes = ["×: how many times less than NeuS; Chamfer: of the largest components"]
    items = [(one.name, one) for one in found]
    return tabulated(name, "Ours against NeuS", "scene", figures, items, more=printed, notes=notes)
