"""The second table of ``kernels``: whole fields of levels, with and without a taper of their gates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from mplicits.neural_fields import MultiscaleSDF, Siren
from mplicits.pipelines.training.trainer import seeded
from torch import Tensor

from ..harness.benchmark import Benchmark, Part, network_name
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .kernels import JET, MANY, POINT, evaluated_by, staged_bytes
from .rounding import gated_bound, rounding_bound
from .traffic import traffic_of

SIZES = (((16, 1), (24, 2)), ((64, 2), (128, 2)), ((128, 2), (256, 2), (400, 2)))
TAPERS = (0.0, 0.5)
# Of points that come to a band, the share that lies in it.
INSIDE = 0.5
LISTED = 16  # bytes of a row on the list of a band in `kernels/levels.py`, written and read


@dataclass(frozen=True)
class LevelsRow:
    """One field of levels, its jet at some points.

    Attributes:
        name: of its networks.
        taper: see `MultiscaleSDF`.
        inside: of all points, the share that each residual is evaluated at.
        value_error: largest distance of a fused value from that of float64, where rounding decides no gate.
        pytorch_value_error: the same of PyTorch's float32.
        gradient_error: largest distance of an entry of a fused gradient.
        pytorch_gradient_error: the same of PyTorch's.
        share: the largest share of its own bound that any fused value or entry is off by.
        unfused_bytes: of a point, that PyTorch's operations read and write.
        fused_bytes: of a point, that the kernel reads and writes, lists of rows in bands included.
        staged_bytes: of a point, that the kernel puts aside in caches, and reads again.
        unfused_launches: of a call.
        unfused_waits: of a call; the kernel is one launch without a wait.
    """

    name: str
    taper: float
    inside: tuple[float, ...]
    value_error: float
    pytorch_value_error: float
    gradient_error: float
    pytorch_gradient_error: float
    share: float
    unfused_bytes: float
    fused_bytes: float
    staged_bytes: float
    unfused_launches: int
    unfused_waits: int

    @property
    def less(self) -> float:
        """How many times less is moved, with what is put aside counted as if no cache held it."""
        return self.unfused_bytes / (self.fused_bytes + self.staged_bytes)


@dataclass(frozen=True, kw_only=True)
class LevelsBench(Benchmark[LevelsRow]):
    """Jets of fields of levels in one launch, and by PyTorch, against the same weights in float64.

    Attributes:
        fields: widths and depths of the levels of each field.
        points: at which they are compared; half of those that come to a band are in it.
        seed: of points and weights.
    """

    name = "kernel levels"
    source = "fused levels against float64"
    row = LevelsRow
    apart = ("fields",)
    fields: tuple[tuple[tuple[int, int], ...], ...] = SIZES
    points: int = 65
    seed: int = 0

    def jobs(self) -> list[Part]:
        """One for each field and taper."""
        return [
            Part(self.name, f"{network_name(sizes)}, taper {taper:g}", options=(("sizes", sizes), ("taper", taper)))
            for sizes in self.fields
            for taper in TAPERS
        ]

    def measure(self, job: Part, context: Context) -> list[LevelsRow]:
        """See `Benchmark.measure`."""
        return [self.compared(**job.parameters)]

    @torch.no_grad()
    def compared(self, sizes: Sequence[tuple[int, int]], taper: float) -> LevelsRow:
        """The row of one field."""
        with seeded(self.seed):
            omegas = [10.0 * 2**index for index in range(len(sizes))]
            field = MultiscaleSDF.from_widths(sizes, omegas=omegas, taper=taper, residual_gain=0.3)
        x = 2 * torch.rand(self.points, 3, generator=torch.Generator().manual_seed(self.seed)) - 1
        field.requires_grad_(False)
        exact = MultiscaleSDF.from_widths(sizes, omegas=omegas, taper=taper).double().requires_grad_(False)
        with evaluated_by("off"):
            inside = _set_bands(field, x)
        exact.load_state_dict({name: part.double() for name, part in field.state_dict().items()})
        jets = [part.jet(x.double()) for part in exact.levels]
        bounds = []
        for part in field.levels:
            assert isinstance(part, Siren)
            bounds.append(rounding_bound(x, part.raw(), part.omega, halves=True))
        sure, *limits = gated_bound([(jet.value, jet.gradient) for jet in jets], bounds, exact.deltas, taper)
        expected = exact.jet(x.double())

        def off() -> tuple[Tensor, Tensor]:
            jet = field.to(self.device).jet(x.to(self.device))
            value, gradient = jet.value.cpu().double(), jet.gradient.cpu().double()
            return (value - expected.value).abs()[sure], (gradient - expected.gradient).abs()[sure]

        fused = off()
        with evaluated_by("off"):
            plain = off()
            many, same = x.repeat(MANY, 1), field.cpu()
            traffic = traffic_of(lambda: same.jet(many))
        evaluated = (1.0, *inside)
        return LevelsRow(
            name=network_name(sizes),
            taper=taper,
            inside=inside,
            value_error=float(fused[0].max()),
            pytorch_value_error=float(plain[0].max()),
            gradient_error=float(fused[1].max()),
            pytorch_gradient_error=float(plain[1].max()),
            share=max(float((error / limit[sure]).max()) for error, limit in zip(fused, limits, strict=True)),
            unfused_bytes=traffic.moved / len(many),
            fused_bytes=POINT + JET + sum(inside) * (POINT + JET + LISTED + JET),
            staged_bytes=sum(part * staged_bytes(*size) for part, size in zip(evaluated, sizes, strict=True)),
            unfused_launches=traffic.launches,
            unfused_waits=traffic.waits,
        )

    def tables(self, rows: Sequence[LevelsRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[LevelsRow]] = [
            (Column("in bands", "s"), lambda r: " ".join(f"{share:.0%}" for share in r.inside)),
            (Column("value", ".1e"), lambda r: r.value_error),
            (Column("PyTorch", ".1e"), lambda r: r.pytorch_value_error),
            (Column("gradient", ".1e"), lambda r: r.gradient_error),
            (Column("PyTorch", ".1e"), lambda r: r.pytorch_gradient_error),
            (Column("of bound", ".1%"), lambda r: r.share),
            (Column("B/point, PyTorch", ",.0f"), lambda r: r.unfused_bytes),
            (Column("fused", ",.0f"), lambda r: r.fused_bytes),
            (Column("in caches", ",.0f"), lambda r: r.staged_bytes),
            (Column("× less", ".1f"), lambda r: r.less),
            (Column("launches, PyTorch", "d"), lambda r: r.unfused_launches),
            (Column("waits", "d"), lambda r: r.unfused_waits),
        ]
        notes = (
            "Largest errors of jets against float64, at points where rounding decides no gate. "
            "The kernel is one launch, and nobody waits.",
            "in bands: of all points, those that each residual is evaluated at. B/point and × less: as above.",
        )
        items = [(f"{r.name}, taper {r.taper:g}", r) for r in rows]
        return (tabulated(self.name, "Fused levels", "networks", figures, items, notes=notes),)


def _set_bands(field: MultiscaleSDF, x: Tensor) -> tuple[float, ...]:
    """Bands that hold `INSIDE` of the points that come to them → the share of all points in each."""
    there, shares = torch.ones(len(x), dtype=torch.bool), []
    for index in range(len(field.deltas)):
        value = field.value(x, level=index).abs()
        field.deltas[index] = value[there].quantile(INSIDE)
        there = there & (value < field.deltas[index])
        shares.append(float(there.float().mean()))
    return tuple(shares)
