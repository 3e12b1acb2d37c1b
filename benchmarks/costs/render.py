"""Benchmark ``render``: the rows of the paper's Tab. 4, traced by us, on a paper's budget, and naively."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import torch
from mplicits.datasets import orbit, read_cloud
from mplicits.datasets.cameras import Camera
from mplicits.neural_fields import Field, Siren
from mplicits.neural_fields.networks.multiscale import levels_of
from mplicits.neural_fields.tracing.sphere import BOUNDING_RADIUS
from mplicits.pipelines.render.trace import Seen, trace_view
from mplicits.pipelines.training.settings import FitConfig
from mplicits.pipelines.training.trainer import parameter_count
from torch import Tensor

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, ratio, tabulated
from ..shapes.fits import fit_home, kept_fit
from .render_truth import Agreement, Truth
from .speed import counted

Networks = Mapping[str, Sequence[tuple[int, int, float, int, float]]]

# The networks of Tab. 4 with our frequencies; level by level (width, depth, ω₀, steps, learning rate).
NETWORKS: Networks = MappingProxyType(
    {
        "400x4": ((400, 4, 30.0, 300, 2e-4),),
        "128x2_256x2_400x2": ((128, 2, 30.0, 1200, 4e-3), (256, 2, 80.0, 800, 5e-4), (400, 2, 160.0, 600, 3e-4)),
        "128x2_400x2": ((128, 2, 30.0, 1200, 4e-3), (400, 2, 160.0, 600, 3e-4)),
    }
)
BUDGET = (20, 5, 5)


@dataclass(frozen=True)
class _Model:
    """A row of Tab. 4: a network, the level that is traced, and the one that gives the normals."""

    name: str
    network: str
    level: int
    normal_level: int
    paper_speedup: float


MODELS = (
    _Model("(400,4)", "400x4", 0, 0, 1.0),
    _Model("(128,2)", "128x2_256x2_400x2", 0, 0, 9.5),
    _Model("(128,2)▷(256,2) NM", "128x2_256x2_400x2", 0, 1, 4.5),
    _Model("(128,2)▷(256,2)", "128x2_256x2_400x2", 1, 1, 3.7),
    _Model("(128,2)▷(400,2) NM", "128x2_400x2", 0, 1, 2.5),
    _Model("(128,2)▷(400,2)", "128x2_400x2", 1, 1, 2.0),
    _Model("(128,2)▷(256,2)▷(400,2) NM", "128x2_256x2_400x2", 1, 2, 2.3),
    _Model("(128,2)▷(256,2)▷(400,2)", "128x2_256x2_400x2", 2, 2, 1.8),
)


@dataclass(frozen=True)
class RenderRow:
    """One model, traced in one way, seen by all cameras.

    Attributes:
        shape: name of the file.
        model: as in the paper's Tab. 4.
        mode: "adaptive", "budget" (20 steps on the first level, 5 on each other) or "naive".
        seconds: per image; the mean over the cameras of the best of some repeats.
        speedup: over the (400,4) network in the same mode.
        paper_speedup: that of Tab. 4, on a GPU; None for rows that it does not have.
        parameters: of all levels used.
        evaluations: per pixel of the image, of each level, one jet counted as one.
        flops: of the matrix products for one image.
        agreement: with the converged image of what the model is to show, and with a raycast of its mesh.
    """

    shape: str
    model: str
    mode: str
    seconds: float
    speedup: float
    paper_speedup: float | None
    parameters: int
    evaluations: tuple[float, ...]
    flops: float
    agreement: Agreement


@dataclass(frozen=True, kw_only=True)
class RenderBench(Benchmark[RenderRow]):
    """The networks of Tab. 4 fitted to each shape, and the times of pictures of them.

    Attributes:
        shapes: meshes or clouds.
        config: settings of the fits, apart from the networks and their steps.
        size: width and height of the images.
        views: how many cameras, evenly around the shape.
        mesh_resolution: cells along each side of the meshes that holes are counted against.
        repeats: runs of each measurement; the best counts.
        naive: whether to time the naive tracer as well (one camera, once: it takes a minute).
        networks: what to fit; the names are those of `NETWORKS`.
    """

    name = "render"
    source = "the rows of the paper's Tab. 4"
    row = RenderRow
    apart = ("shapes",)
    shapes: Sequence[str | Path]
    config: FitConfig
    size: int = 512
    views: int = 3
    mesh_resolution: int = 512
    repeats: int = 2
    naive: bool = True
    networks: Networks = field(default_factory=lambda: NETWORKS)

    def jobs(self) -> list[Part]:
        """One for each shape; see `Benchmark.jobs`."""
        for shape in self.shapes:
            read_cloud(shape)
        return [Part(self.name, Path(shape).stem, (Path(shape),)) for shape in self.shapes]

    def measure(self, job: Part, context: Context) -> list[RenderRow]:
        """See `Benchmark.measure`; raises `InputError` where a fit has no surface."""
        (shape,) = job.files
        fields = {name: one.to(self.device).requires_grad_(False) for name, one in self.fits(shape, context).items()}
        truth = Truth(fields, resolution=self.mesh_resolution, device=self.device, report=context.say)
        corners, side = truth.outline("128x2_256x2_400x2"), self.size
        cameras = [
            orbit(corners, azimuth=30 + 360 * view / self.views, width=side, height=side) for view in range(self.views)
        ]
        rows: list[RenderRow] = []
        modes = [("adaptive", MODELS), ("budget", MODELS)] + [("naive", (MODELS[0], MODELS[-1]))] * self.naive
        for mode, models in modes:
            seen, repeats = (cameras[:1], 1) if mode == "naive" else (cameras, self.repeats)
            found: list[RenderRow] = []
            for model in models:
                context.say(f"{shape.stem}: {model.name}, {mode}")
                row = _time(fields[model.network], model, mode, seen, truth, repeats, self.device)
                base = found[0].seconds if found else row.seconds
                paper = None if mode == "naive" else row.paper_speedup
                found.append(replace(row, shape=shape.stem, speedup=base / row.seconds, paper_speedup=paper))
            rows += found
        return rows

    def fits(self, shape: Path, context: Context) -> dict[str, Field]:
        """The networks fitted to a shape, those that are there already taken as they are."""
        fields, cloud = {}, read_cloud(shape)
        for name, levels in self.networks.items():
            widths, depths, omegas, steps, rates = zip(*levels, strict=True)
            config = replace(
                self.config, widths=widths, depths=depths, omegas=omegas, steps=steps, learning_rates=rates, levels=None
            )
            home, told = fit_home(context.out, shape, config), context.stage(f"{shape.stem} {name}")
            fields[name] = kept_fit(home, cloud, config, progress=told).field
        return fields

    def tables(self, rows: Sequence[RenderRow], *, sgemm: float) -> tuple[Table, ...]:
        """Speed-ups are over (400,4) in the same mode, over it with the paper's 20 steps, and those of the paper."""
        fixed = {row.shape: row.seconds for row in rows if row.mode == "budget" and row.model == MODELS[0].name}
        figures: list[Figure[RenderRow]] = [
            (Column("parameters", ",d"), lambda r: r.parameters),
            (Column("fps", ".2f"), lambda r: 1 / r.seconds),
            (Column("× same mode", ".1f"), lambda r: r.speedup),
            (Column("× 20 steps", ".1f"), lambda r: fixed[r.shape] / r.seconds),
            (Column("× paper", ".1f"), lambda r: r.paper_speedup),
            (Column("evaluations per pixel", "s"), lambda r: " + ".join(f"{count:.2f}" for count in r.evaluations)),
            (Column("of SGEMM", ".0%"), lambda r: r.flops / r.seconds / sgemm),
            (Column("image rms", ".4f"), lambda r: r.agreement.image_error),
            (Column("depth 99.9 %", ".1e"), lambda r: r.agreement.depth_error),
            (Column("holes", "d"), lambda r: r.agreement.holes),
            (Column("per 100 K", ".1f"), lambda r: ratio(1e5 * r.agreement.holes, r.agreement.silhouette)),
            (Column("false", "d"), lambda r: r.agreement.false_hits),
        ]
        items = [(f"{row.shape} {row.mode} {row.model}", row) for row in rows]
        return (tabulated(self.name, "What a picture costs", "shape, mode, model", figures, items),)


def _time(
    field: Field, model: _Model, mode: str, cameras: Sequence[Camera], truth: Truth, repeats: int, device: str
) -> RenderRow:
    """Time a model, then count its evaluations and judge its images, which is not timed."""
    budget = BUDGET[: model.level + 1] if mode == "budget" else None

    def draw(camera: Camera, field: Field = field) -> Seen:
        if mode == "naive":
            return naive_view(field, camera, steps=sum(BUDGET[: model.level + 1]), device=device)
        return trace_view(
            field, camera, level=model.level, normal_level=model.normal_level, budget=budget, device=device
        )

    if mode != "naive":
        draw(cameras[0].resized(64, 64))  # the first call pays for what later ones find ready
    timed = [_best([camera] * repeats, draw) for camera in cameras]
    images = [seen for _, seen in timed]
    levels = levels_of(field)[: model.normal_level + 1]
    pixels = len(cameras) * cameras[0].width * cameras[0].height
    if mode == "naive":
        values = [sum(BUDGET[: model.level + 1])] * len(levels)
        jets = [sum(len(image.pixel) for image in images) / pixels] * len(levels)
    else:
        same, counters = counted(field)
        for camera in cameras:
            draw(camera, same)
        values = [counter.values / pixels for counter in counters[: len(levels)]]
        jets = [counter.jets / pixels for counter in counters[: len(levels)]]
    products = [sum(p.numel() for p in level.parameters() if p.ndim == 2) for level in levels]
    per_pixel = sum(2 * m * (v + 2 * j) for m, v, j in zip(products, values, jets, strict=True))
    return RenderRow(
        shape="",
        model=model.name,
        mode=mode,
        seconds=sum(best for best, _ in timed) / len(cameras),
        speedup=1.0,
        paper_speedup=model.paper_speedup,
        parameters=parameter_count(*levels),
        evaluations=tuple(v + j for v, j in zip(values, jets, strict=True)),
        flops=per_pixel * pixels / len(cameras),
        agreement=truth.judge(model.network, model.level, model.normal_level, cameras, images),
    )


def _best(cameras: Sequence[Camera], draw: Callable[[Camera], Seen]) -> tuple[float, Seen]:
    """Seconds of the quickest of some drawings, and the quickest one."""
    drawn = []
    for camera in cameras:
        start = time.perf_counter()
        seen = draw(camera)
        if seen.depth.is_cuda:
            torch.cuda.synchronize()
        drawn.append((time.perf_counter() - start, seen))
    return min(drawn, key=lambda pair: pair[0])


@torch.inference_mode()
def naive_view(field: Field, camera: Camera, *, steps: int, device: torch.device | str = "cpu") -> Seen:
    """Naive sphere tracing: every level everywhere, every ray to the end, all rays in one batch."""
    eye, directions = camera.rays(device=device)
    flat = directions.reshape(-1, 3)
    depth = torch.full_like(flat[:, 0], max(float(eye.norm()) - BOUNDING_RADIUS, 0.0))
    last = depth
    for _ in range(steps):
        last = _everywhere(field, eye + depth[:, None] * flat)
        depth = depth + last
    pixel = ((last.abs() < 2e-3) & (depth < float(eye.norm()) + BOUNDING_RADIUS)).nonzero()[:, 0]
    position = eye + depth[pixel, None] * flat[pixel]
    normal = torch.nn.functional.normalize(field.jet(position).gradient, dim=-1)
    return Seen((camera.width, camera.height), pixel, depth[pixel], position, normal, flat[pixel])


def _everywhere(field: Field, x: Tensor) -> Tensor:
    """The value of the finest level, with the gates as masks on residuals that are evaluated at every point."""
    levels = levels_of(field)
    f = _unblocked(levels[0], x)
    inside = torch.ones_like(f, dtype=torch.bool)
    for residual, delta in zip(levels[1:], field.deltas, strict=True):
        inside = inside & (f.abs() < delta)
        f = f + inside * _unblocked(residual, x)
    return f


def _unblocked(level: Field, x: Tensor) -> Tensor:
    """The value of a SIREN with the activations of all rows at once."""
    assert isinstance(level, Siren)
    *hidden, weight, bias = level.folded()
    for layer_weight, layer_bias in zip(hidden[::2], hidden[1::2], strict=True):
        x = torch.addmm(layer_bias, x, layer_weight.t()).sin_()
    return torch.addmv(bias[:1], x, weight[0])
