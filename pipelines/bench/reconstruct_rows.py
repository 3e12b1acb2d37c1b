"""One row of ``mplicits bench reconstruct``: what a geometry cost on a scene, and how near it came.

What ``mplicits bench reconstruct`` prints: the figures of all rows, and how ours compare with those of NeuS.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ..run.machine import format_table

__all__ = [
    "EQUAL_TIME",
    "MULTISCALE",
    "NEUS",
    "Comparison",
    "ReconstructRow",
    "SurfaceFigures",
    "comparisons",
    "format_reconstruct",
]

NEUS = "neus"
MULTISCALE = "multiscale"
EQUAL_TIME = "equal-time"


@dataclass(frozen=True)
class SurfaceFigures:
    """A reconstructed surface against the exact one; see `evaluate.Metrics`.

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
class ReconstructRow:
    """One geometry, trained on one scene.

    FLOPs are those of the matrix products of training; how they are counted is said in `bench_reconstruct_train`.

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
        finest_share: of the samples on a ray, how many the finest level saw while it was switched on; None if it never
            was.
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
    def rate(self) -> float:
        """FLOP/s that the training reached."""
        return self.flops_per_ray * self.rays * self.steps / self.seconds

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self) | {"flops_per_ray": self.flops_per_ray, "flops_per_second": self.rate}

    @classmethod
    def from_dict(cls, figures: Mapping[str, Any]) -> ReconstructRow:
        """The row that `as_dict` wrote.

        Raises:
            KeyError: a figure is missing.
            TypeError: a figure is of another kind.
        """
        known = {name: figures[name] for name in cls.__dataclass_fields__}
        for name in ("values_per_ray", "jets_per_ray", "deltas"):
            known[name] = tuple(known[name])
        if known["surface"] is not None:
            known["surface"] = SurfaceFigures(**known["surface"])
        return cls(**known)


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


def comparisons(rows: Sequence[ReconstructRow]) -> list[Comparison]:
    """One for every scene that has both rows of equal steps; of two or more, their means last.

    Means of decibels are arithmetic, means of ratios geometric.
    """
    found = []
    for scene in dict.fromkeys(row.scene for row in rows):
        of = {row.kind: row for row in rows if row.scene == scene}
        if NEUS in of and MULTISCALE in of:
            found.append(_comparison(of[NEUS], of[MULTISCALE], of.get(EQUAL_TIME)))
    if len(found) < 2:
        return found
    mean = Comparison(
        name=f"mean of {len(found)} scenes",
        neus=statistics.fmean(one.neus for one in found),
        ours=statistics.fmean(one.ours for one in found),
        equal_time=_mean([one.equal_time for one in found], statistics.fmean),
        fewer=statistics.fmean(one.fewer for one in found),
        step=statistics.geometric_mean(one.step for one in found),
        mean_step=statistics.geometric_mean(one.mean_step for one in found),
        flops=statistics.geometric_mean(one.flops for one in found),
        chamfer=_mean([one.chamfer for one in found], statistics.geometric_mean),
        equal_time_chamfer=_mean([one.equal_time_chamfer for one in found], statistics.geometric_mean),
    )
    return [*found, mean]


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


def _mean(numbers: Iterable[float | None], mean: Callable[[list[float]], float]) -> float | None:
    """None if one of them is."""
    known = list(numbers)
    return None if None in known else mean([number for number in known if number is not None])


def format_reconstruct(rows: Sequence[ReconstructRow], *, sgemm: float) -> str:
    """Both tables, and what their columns mean.

    Args:
        rows: of `bench_reconstruct`.
        sgemm: the machine's matrix rate in FLOP/s, the limit of every row.
    """
    header = (
        *("scene, geometry", "steps", "trained", "a step", "PSNR", "object", "SSIM", "Chamfer", "floor", "largest"),
        *("parameters", "colour", "a ray", "geometry", "fine", "GFLOP/s", "of SGEMM"),
    )
    cells = []
    for row in rows:
        surface = row.surface
        near = ("no surface" if row.exact else "", "", "")
        if surface is not None:
            largest = f"{surface.largest_chamfer:.2e}" if surface.components > 1 else ""
            near = (f"{surface.chamfer:.2e}", "" if surface.floor is None else f"{surface.floor:.2e}", largest)
        cells.append(
            (
                f"{row.scene} {row.network}{', equal time' if row.kind == EQUAL_TIME else ''}",
                f"{row.steps:,}",
                f"{row.seconds:.1f} s",
                f"{1e3 * row.step_seconds:.1f} ms",
                f"{row.psnr:.2f} dB",
                "" if row.psnr_object is None else f"{row.psnr_object:.2f} dB",
                f"{row.ssim:.4f}",
                *near,
                f"{row.parameters:,}",
                f"{row.color_parameters + row.outside_parameters:,}",
                f"{row.flops_per_ray / 1e6:.1f} MFLOP",
                f"{row.geometry_flops / 1e6:.1f}",
                "" if row.finest_share is None else f"{row.finest_share:.1%}",
                f"{row.rate / 1e9:.1f}",
                f"{row.rate / sgemm:.0%}",
            )
        )
    counts = " or ".join(map(str, sorted({row.views for row in rows})))
    notes = (
        f"PSNR and SSIM: means over the held-out views ({counts}); object: PSNR inside the masks. a step: the median.",
        "a ray: FLOPs of all matrix products of training; geometry: its own. fine: share of the samples that the",
        "finest level sees, once it is switched on. largest: Chamfer of the largest component, where there are others.",
        f"This machine multiplies float32 matrices at {sgemm / 1e9:.0f} GFLOP/s ({rows[0].device}).",
    )
    parts = [format_table(header, cells), "\n".join(notes)]
    found = comparisons(rows)
    if found:
        parts.append(_format_comparisons(found))
    return "\n\n".join(parts)


def _format_comparisons(found: Sequence[Comparison]) -> str:
    header = (
        *("ours against NeuS", "NeuS", "equal steps", "gain", "equal time", "gain", "parameters", "a step"),
        *("mean step", "FLOPs a ray", "Chamfer", "equal time"),
    )
    cells = []
    for one in found:
        timed = ("", "")
        if one.equal_time is not None:
            timed = (f"{one.equal_time:.2f} dB", f"{one.equal_time - one.neus:+.2f} dB")
        ratios = (one.step, one.mean_step, one.flops, one.chamfer, one.equal_time_chamfer)
        cells.append(
            (
                one.name,
                f"{one.neus:.2f} dB",
                f"{one.ours:.2f} dB",
                f"{one.ours - one.neus:+.2f} dB",
                *timed,
                f"{-one.fewer:+.0%}",
                *("" if ratio is None else f"{ratio:.{1 if ratio >= 1 else 3}f}×" for ratio in ratios),
            )
        )
    for name, neus, ours in PAPER:
        gain = f"{ours - neus:+.2f} dB"
        cells.append((name, f"{neus:.2f} dB", f"{ours:.2f} dB", gain, "", "", f"{-PAPER_PARAMETERS:+.0%}", *[""] * 5))
    return f"{format_table(header, cells)}\n×: how many times less than NeuS; Chamfer: of the largest components"
