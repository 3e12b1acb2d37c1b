"""Benchmark ``kernels``: how far the fused kernels are from exact values, and what they move, network by network.

Without CUDA they run by Triton's interpreter, which takes some seconds for each wide network.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from mplicits.neural_fields import InputError, Siren
from mplicits.neural_fields.backend.kernels.packing import Shape
from mplicits.neural_fields.backend.kernels.switch import VARIABLE, choose
from mplicits.pipelines.training.trainer import seeded
from torch import Tensor

from ..harness.benchmark import Benchmark, Part, network_name
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .rounding import rounding_bound
from .traffic import traffic_of

POINT, JET = 12, 16  # bytes of a point, and of a value with its gradient
# Factor on the number of points whose bytes are counted, so that those of weights do not count.
MANY = 64
SIZES = tuple((width, depth) for width in (16, 64, 128, 256, 400) for depth in (1, 2, 3))


@dataclass(frozen=True)
class KernelRow:
    """One network, its jet at some points.

    Attributes:
        width: of its layers.
        depth: how many.
        value_error: largest distance of a fused value from that of float64.
        pytorch_value_error: the same of PyTorch's float32.
        value_bound: largest bound on it.
        gradient_error: largest distance of an entry of a fused gradient.
        pytorch_gradient_error: the same of PyTorch's.
        gradient_bound: largest bound on it.
        share: the largest share of its own bound that any fused value or entry is off by.
        unfused_bytes: of a point, that PyTorch's operations read and write.
        fused_bytes: of a point, that the kernel reads from the GPU's memory and writes to it.
        staged_bytes: of a point, that the kernel puts aside in caches, and reads again.
    """

    width: int
    depth: int
    value_error: float
    pytorch_value_error: float
    value_bound: float
    gradient_error: float
    pytorch_gradient_error: float
    gradient_bound: float
    share: float
    unfused_bytes: float
    fused_bytes: float
    staged_bytes: float

    @property
    def less(self) -> float:
        """How many times less is moved, with what is put aside counted as if no cache held it."""
        return self.unfused_bytes / (self.fused_bytes + self.staged_bytes)


@dataclass(frozen=True, kw_only=True)
class KernelsBench(Benchmark[KernelRow]):
    """Jets by the fused kernels, and by PyTorch, against the same weights in float64.

    Attributes:
        sizes: widths and depths of the networks.
        points: at which they are compared.
        seed: of points and weights.
    """

    name = "kernels"
    source = "fused kernels against float64"
    row = KernelRow
    apart = ("sizes",)
    sizes: tuple[tuple[int, int], ...] = SIZES
    points: int = 65
    seed: int = 0

    def jobs(self) -> list[Part]:
        """One for each network; raises `InputError` where the kernels cannot run."""
        if reason := choose(torch.empty(0, 3, device=self.device), width=16, depth=1).reason:
            raise InputError(f"the fused kernels cannot run here: {reason}")
        return [Part(self.name, network_name([s]), options=(("width", s[0]), ("depth", s[1]))) for s in self.sizes]

    def measure(self, job: Part, context: Context) -> list[KernelRow]:
        """See `Benchmark.measure`."""
        return [self.compared(**job.parameters)]

    @torch.no_grad()
    def compared(self, width: int, depth: int) -> KernelRow:
        """The row of one network."""
        with seeded(self.seed):
            network = Siren(width, depth).requires_grad_(False)
        x = 2 * torch.rand(self.points, 3, generator=torch.Generator().manual_seed(self.seed)) - 1
        bounds = rounding_bound(x, network.raw(), network.omega, halves=True)
        exact = Siren(width, depth).double()
        exact.load_state_dict({name: part.double() for name, part in network.state_dict().items()})
        expected = exact.jet(x.double())

        def off() -> tuple[Tensor, Tensor]:
            jet = network.to(self.device).jet(x.to(self.device))
            value, gradient = jet.value.cpu().double(), jet.gradient.cpu().double()
            return (value - expected.value).abs(), (gradient - expected.gradient).abs()

        fused = off()
        with evaluated_by("off"):
            plain = off()
            many, own = x.repeat(MANY, 1), network.cpu()
            traffic = traffic_of(lambda: own.jet(many))
        shares = [float((error / bound).max()) for error, bound in zip(fused, bounds, strict=True)]
        return KernelRow(
            width=width,
            depth=depth,
            value_error=float(fused[0].max()),
            pytorch_value_error=float(plain[0].max()),
            value_bound=float(bounds[0].max()),
            gradient_error=float(fused[1].max()),
            pytorch_gradient_error=float(plain[1].max()),
            gradient_bound=float(bounds[1].max()),
            share=max(shares),
            unfused_bytes=traffic.moved / len(many),
            fused_bytes=POINT + JET,
            staged_bytes=staged_bytes(width, depth),
        )

    def tables(self, rows: Sequence[KernelRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[KernelRow]] = [
            (Column("value", ".1e"), lambda r: r.value_error),
            (Column("PyTorch", ".1e"), lambda r: r.pytorch_value_error),
            (Column("bound", ".1e"), lambda r: r.value_bound),
            (Column("gradient", ".1e"), lambda r: r.gradient_error),
            (Column("PyTorch", ".1e"), lambda r: r.pytorch_gradient_error),
            (Column("bound", ".1e"), lambda r: r.gradient_bound),
            (Column("of bound", ".1%"), lambda r: r.share),
            (Column("B/point, PyTorch", ",.0f"), lambda r: r.unfused_bytes),
            (Column("fused", ",.0f"), lambda r: r.fused_bytes),
            (Column("in caches", ",.0f"), lambda r: r.staged_bytes),
            (Column("× less", ".1f"), lambda r: r.less),
        ]
        notes = (
            "Largest errors of jets against float64, and the largest bound on them (rounding, depth and weights).",
            "of bound: the largest share of its own bound that a fused number is off by.",
            "Bytes of a point, weights not counted. × less: with what is put aside in caches counted in full.",
        )
        items = [(f"({r.width},{r.depth})", r) for r in rows]
        return (tabulated(self.name, "Fused jets", "network", figures, items, notes=notes),)


def staged_bytes(width: int, depth: int) -> float:
    """What the kernel of a jet puts aside and reads again, of a point; as `kernels/tensor_tiles.py` does it.

    A number is two of float16. Each product reads a layer once for each block of units that it makes, but where it
    makes that layer itself.
    """
    shape = Shape.of(width, depth)
    if shape.direct:
        return 0.0
    blocks, numbers = shape.width // shape.columns, 0
    for layer in range(depth - 1):  # up: sines, and the cosines of all but the first
        numbers += (layer > 0 or blocks > 1) * (1 + blocks) + (layer > 0)
    # The last layer's s; then each product back, with the cosines and the next s.
    numbers += 1 + (depth - 1) * blocks + (depth - 2) * 2
    return 4.0 * numbers * shape.width


@contextmanager
def evaluated_by(mode: str) -> Iterator[None]:
    """Use the kernels in ``mode``, one of `MODES`, inside the context; it overrides the environment."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = mode
    try:
        yield
    finally:
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before
