"""Benchmark ``pictures``: pictures a second of a field on a device, and how far they are from the CPU's.

And what one sample costs there: values and jets of networks at many points, without a march around them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import Field, Siren, load_field
from mplicits.pipelines.render.trace import Seen, pixel_size, trace_view
from mplicits.pipelines.training.trainer import seeded

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated

EYE, FOV = (1.6, 0.9, 2.0), 40.0
WARM = 3  # pictures before those that are timed: the first ones compile
# What a picture is allowed to be off by: of a pixel, and in degrees.
DEPTH, NORMAL = 0.01, 0.01


@dataclass(frozen=True)
class PictureRow:
    """One size and level.

    Attributes:
        size: of the image, "width×height".
        level: that is seen.
        pixels: that see the surface.
        best: pictures a second, of the fastest.
        median: of the one in the middle.
        unlike: pixels that see the surface on one device alone.
        depth: largest difference of a depth from the CPU's, in pixels.
        depths: how many differ by more than `DEPTH`.
        normal: largest angle between normals, in degrees.
        normals: how many differ by more than `NORMAL`.
    """

    size: str
    level: int
    pixels: int
    best: float
    median: float
    unlike: int
    depth: float
    depths: int
    normal: float
    normals: int


@dataclass(frozen=True)
class SampleRow:
    """One network, at many points.

    Attributes:
        network: its width and depth.
        value: nanoseconds of a value.
        value_rate: of its products, TFLOP/s.
        jet: nanoseconds of a value with its gradient.
        jet_rate: likewise.
    """

    network: str
    value: float
    value_rate: float
    jet: float
    jet_rate: float


@dataclass(frozen=True, kw_only=True)
class PicturesBench(Benchmark[PictureRow]):
    """A field from one place outside of it, in several sizes, coarsest and finest level.

    Attributes:
        run_file: run directory or field file.
        sizes: widths and heights.
        repeats: pictures that are timed.
    """

    name = "pictures"
    source = "whole pictures, the host's work included"
    row = PictureRow
    apart = ("sizes",)
    run_file: str
    sizes: tuple[tuple[int, int], ...] = ((512, 512), (1920, 1080))
    repeats: int = 30

    def jobs(self) -> list[Part]:
        """One for each size and level."""
        levels = sorted({0, self._field("cpu").num_levels - 1})
        return [
            Part(self.name, f"{w}×{h}, level {level}", options=(("width", w), ("height", h), ("level", level)))
            for w, h in self.sizes
            for level in levels
        ]

    def measure(self, job: Part, context: Context) -> list[PictureRow]:
        """See `Benchmark.measure`."""
        return [self.timed(**job.parameters)]

    def timed(self, width: int, height: int, level: int) -> PictureRow:
        """The row of one size and level."""
        view = look_at(EYE, (0.0, 0.0, 0.0), fov=FOV, width=width, height=height)
        field = self._field(self.device)
        ours, seconds = seconds_of(lambda: trace_view(field, view, level=level, device=self.device), self.repeats)
        theirs = trace_view(self._field("cpu"), view, level=level)
        off, turned, unlike = differences(ours, theirs, pixel_size(view))
        return PictureRow(
            size=f"{width}×{height}",
            level=level,
            pixels=len(ours.pixel),
            best=1 / min(seconds),
            median=1 / statistics.median(seconds),
            unlike=unlike,
            depth=float(off.max()) if len(off) else 0.0,
            depths=int((off > DEPTH).sum()),
            normal=float(turned.max()) if len(turned) else 0.0,
            normals=int((turned > NORMAL).sum()),
        )

    def tables(self, rows: Sequence[PictureRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[PictureRow]] = [
            (Column("pixels", ",.0f"), lambda r: r.pixels),
            (Column("pictures/s", ".4g"), lambda r: r.best),
            (Column("median", ".4g"), lambda r: r.median),
            (Column("unlike", ".0f"), lambda r: r.unlike),
            (Column("depth, px", ".4f"), lambda r: r.depth),
            (Column(f"> {DEPTH}", ".0f"), lambda r: r.depths),
            (Column("normal, °", ".3f"), lambda r: r.normal),
            (Column(f"> {NORMAL}", ".0f"), lambda r: r.normals),
        ]
        notes = (
            "unlike: pixels that see the surface on one device alone; largest differences from the CPU's picture.",
        )
        items = [(f"{r.size}, level {r.level}", r) for r in rows]
        return (tabulated(self.name, "Pictures", "picture", figures, items, notes=notes),)

    def _field(self, device: str) -> Field:
        path = Path(self.run_file)
        return load_field(path / "field.safetensors" if path.is_dir() else path, device=device).field


@dataclass(frozen=True, kw_only=True)
class SamplesBench(Benchmark[SampleRow]):
    """Values and jets of untrained networks.

    Attributes:
        sizes: widths and depths.
        points: at which they are evaluated.
        repeats: of each evaluation.
    """

    name = "samples"
    source = "values and jets of many points"
    row = SampleRow
    apart = ("sizes",)
    sizes: tuple[tuple[int, int], ...] = ((128, 2), (256, 2), (400, 2))
    points: int = 1 << 20
    repeats: int = 10

    def jobs(self) -> list[Part]:
        """One for each network."""
        return [Part(self.name, f"({w},{d})", options=(("width", w), ("depth", d))) for w, d in self.sizes]

    def measure(self, job: Part, context: Context) -> list[SampleRow]:
        """See `Benchmark.measure`."""
        return [self.timed(**job.parameters)]

    @torch.no_grad()
    def timed(self, width: int, depth: int) -> SampleRow:
        """The row of one network."""
        with seeded(0):
            network = Siren(width, depth).to(self.device).requires_grad_(False)
            x = (2 * torch.rand(self.points, 3) - 1).to(self.device)
        flops = 2 * ((depth - 1) * width * width + 4 * width)
        value, jet = (
            1e9 * statistics.median(seconds_of(work, self.repeats)[1]) / len(x)
            for work in (lambda: network.value(x), lambda: network.jet(x))
        )
        return SampleRow(f"({width},{depth})", value, flops / value / 1e3, jet, 2 * flops / jet / 1e3)

    def tables(self, rows: Sequence[SampleRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[SampleRow]] = [
            (Column("value, ns", ".3f"), lambda r: r.value),
            (Column("TFLOP/s", ".3g"), lambda r: r.value_rate),
            (Column("jet, ns", ".3f"), lambda r: r.jet),
            (Column("TFLOP/s", ".3g"), lambda r: r.jet_rate),
        ]
        items = [(r.network, r) for r in rows]
        return (tabulated(self.name, "Samples", "network", figures, items),)


def seconds_of(work: Callable[[], Seen | object], repeats: int) -> tuple[Seen, list[float]]:
    """The last result of ``work``, and the seconds of each repetition, with the wait for the device."""
    result, seconds = None, []
    for _ in range(WARM + repeats):
        _wait()
        begun = time.perf_counter()
        result = work()
        _wait()
        seconds.append(time.perf_counter() - begun)
    return result, seconds[WARM:]  # pyright: ignore[reportReturnType]  the caller knows what its work gives


def differences(ours: Seen, theirs: Seen, pixel: float) -> tuple[torch.Tensor, torch.Tensor, int]:
    """Of pixels that both see: differences of depths in pixels, angles of normals in degrees; and of how many not both.

    Args:
        ours: a picture.
        theirs: the same view's by other arithmetic.
        pixel: see `pixel_size`.
    """
    place = theirs.pixel.device
    kept, others = torch.isin(ours.pixel.to(place), theirs.pixel), torch.isin(theirs.pixel, ours.pixel.to(place))
    off = (ours.depth.to(place)[kept] - theirs.depth[others]).abs() / pixel
    chord = (ours.normal.to(place)[kept].double() - theirs.normal[others].double()).norm(dim=-1)
    return off, torch.rad2deg(2 * torch.asin((chord / 2).clamp(max=1))), int((~kept).sum()) + int((~others).sum())


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
