"""``mplicits bench gpu``: what pictures of a run would cost on a GPU that is not here, by the model of `model`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...datasets.cameras import look_at
from ...neural_fields import Field, InputError, load_field
from ..render.trace import Seen, trace_view
from ..run.folder import find_field
from .benchmark import Benchmark, Part
from .cells import Workplace
from .model import FrameCounts, count_frame, model_table
from .tables import Table

__all__ = ["GpuBench", "GpuRow"]

# From outside the unit ball, which fills most of a square picture.
EYE, VIEW = (1.6, 0.9, 2.0), 40.0


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
    """

    width: int
    height: int
    level: int
    levels: int
    seconds: float
    counts: FrameCounts


@dataclass(frozen=True, kw_only=True)
class GpuBench(Benchmark[GpuRow]):
    """Pictures of the coarsest and the finest level of a field, counted on the CPU.

    Attributes:
        run_file: a run, or a .safetensors file.
        sizes: widths and heights of the pictures.
        devices: names of those that the table tells the times on.
    """

    name = "gpu"
    source = "a model of GPUs that are not here"
    row = GpuRow
    apart = ("run_file", "sizes", "devices")
    run_file: str | Path
    sizes: tuple[tuple[int, int], ...] = ((512, 512), (1920, 1080))
    devices: tuple[str, ...] = ("h100",)

    def cells(self) -> list[Part]:
        """One for each size and level; raises `InputError` for a field that is not three-dimensional."""
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
        return GpuRow(width, height, level, field.num_levels, time.perf_counter() - start, counts)

    def tables(self, rows: Sequence[GpuRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        items = [(f"{r.width}×{r.height}, {'all levels' if r.level else 'level 0'}", r.seconds, r.counts) for r in rows]
        return (model_table(items, self.devices),)
