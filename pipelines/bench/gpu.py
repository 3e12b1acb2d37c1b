"""``mplicits bench gpu``: what pictures of a run cost on a GPU: by a model where it is not here, or timed."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ...datasets.cameras import Camera, look_at
from ...neural_fields import Field, InputError, load_field
from ...neural_fields.kernels.switch import obstacle
from ..render.trace import Seen, trace_view
from ..run.folder import find_field
from ..run.machine import choose_device
from .benchmark import Benchmark, Part
from .cells import Workplace
from .kernels import evaluated_by
from .model import FrameCounts, count_frame, model_table
from .tables import Column, Figure, Table, ratio, tabulated

__all__ = ["GpuBench", "GpuRow"]

# From outside the unit ball, which fills most of a square picture.
EYE, VIEW = (1.6, 0.9, 2.0), 40.0
# Who evaluates the networks, and how MPLICITS_KERNELS says so.
PYTORCH = "PyTorch"
EVALUATORS = {PYTORCH: "off", "fused": "auto", "3 × TF32": "tf32x3"}
REPEATS = 5


@dataclass(frozen=True)
class GpuRow:
    """One picture, made here and counted.

    Attributes:
        width: in pixels.
        height: likewise.
        level: whose surface is seen.
        levels: how many the field has.
        seconds: that it took here, counting included.
        counts: of the picture.
        rates: pictures a second where they were timed, by who evaluates the networks; empty if nowhere.
    """

    width: int
    height: int
    level: int
    levels: int
    seconds: float
    counts: FrameCounts
    rates: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class GpuBench(Benchmark[GpuRow]):
    """Pictures of the coarsest and the finest level of a field, counted on the CPU.

    Attributes:
        run_file: a run, or a .safetensors file.
        sizes: widths and heights of the pictures.
        devices: names of those that the table tells the times on.
        timed: a torch device on which pictures are timed as well, the best of five; None for none.
    """

    name = "gpu"
    source = "a model of GPUs that are not here"
    row = GpuRow
    apart = ("run_file", "sizes", "devices")
    run_file: str | Path
    sizes: tuple[tuple[int, int], ...] = ((512, 512), (1920, 1080))
    devices: tuple[str, ...] = ("h100",)
    timed: str | None = None

    def cells(self) -> list[Part]:
        """One for each size and level.

        Raises:
            InputError: the field is not three-dimensional, or there is no device to time pictures on.
        """
        if self.timed is not None:
            choose_device(self.timed, option="--timed")
        file = find_field(self.run_file)
        field = load_field(file).field
        if field.in_dim != 3:
            raise InputError(f"{file}: a field of {field.in_dim} dimensions; pictures are counted of three")
        return [
            Part(
                self.name, f"{width}×{height}, level {level}", (file,),
                (("width", width), ("height", height), ("level", level)),
            )
            for width, height in self.sizes
            for level in sorted({0, field.num_levels - 1})
        ]  # fmt: skip

    def measure(self, cell: Part, work: Workplace) -> list[GpuRow]:
        """See `Benchmark.measure`."""
        (file,), options = cell.files, cell.parameters
        return [self.counted(load_field(file).field.requires_grad_(False), **options)]

    def counted(self, field: Field, width: int, height: int, level: int) -> GpuRow:
        """The row of one picture."""
        camera = look_at(EYE, (0.0, 0.0, 0.0), fov=VIEW, width=width, height=height)

        def draw(same: Field) -> Seen:
            return trace_view(same, camera, level=level)

        start = time.perf_counter()
        counts = count_frame(field, draw, width * height)
        seconds = time.perf_counter() - start
        rates = {} if self.timed is None else picture_rates(field, camera, level, choose_device(self.timed))
        return GpuRow(width, height, level, field.num_levels, seconds, counts, rates)

    def tables(self, rows: Sequence[GpuRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        named = [(f"{row.width}×{row.height}, {'all levels' if row.level else 'level 0'}", row) for row in rows]
        model = model_table([(name, row.seconds, row.counts) for name, row in named], self.devices)
        timed = [(name, row) for name, row in named if row.rates]
        if not timed:
            return (model,)

        def shown(evaluator: str) -> Figure[GpuRow]:
            return (Column(evaluator, ".1f"), lambda row: row.rates.get(evaluator))

        def faster(row: GpuRow) -> float | None:
            return ratio(row.rates["fused"], row.rates[PYTORCH]) if "fused" in row.rates else None

        figures = [*map(shown, EVALUATORS), (Column("× PyTorch", ".1f"), faster)]
        notes = (f"Pictures a second on {self.timed}, the best of {REPEATS}; a kernel is compiled before.",)
        return model, tabulated(
            f"{self.name}-timed", "Pictures that were timed", "picture", figures, timed, notes=notes
        )


def picture_rates(field: Field, camera: Camera, level: int, device: torch.device) -> dict[str, float]:
    """Pictures a second of a level of a field on a device, by each of `EVALUATORS` that it has."""
    there, rates = field.to(device), {}
    for evaluator, mode in EVALUATORS.items():
        if evaluator != PYTORCH and (device.type != "cuda" or obstacle(device, mode)):
            continue
        times = []
        with evaluated_by(mode):
            for _ in range(1 + REPEATS):
                start = time.perf_counter()
                seen = trace_view(there, camera, level=level, device=device)
                seen.pixel.sum().item()  # which a GPU has to have finished for
                times.append(time.perf_counter() - start)
        rates[evaluator] = 1 / min(times[1:])
    return rates
