"""``mplicits bench render``: the rows of the paper's Tab. 4, traced by us, on a paper's budget, and naively."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from ...datasets import orbit, read_cloud
from ...datasets.cameras import Camera
from ...neural_fields import Field, Siren, levels_of, load_field
from ...neural_fields.tracing import BOUNDING_RADIUS
from ..fit.train import fit
from ..render.trace import Seen, trace_view
from ..run.folder import FIELD_FILE, STATE_FILE
from ..run.machine import format_table
from ..run.settings import FitConfig
from ..run.trainer import Progress
from .render_truth import Agreement, Truth
from .speed import counted

__all__ = ["NETWORKS", "RenderRow", "bench_render", "fit_networks", "format_render"]

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

    def as_dict(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return asdict(self)


def bench_render(
    shapes: Sequence[str | Path],
    directory: Path,
    config: FitConfig,
    *,
    size: int = 512,
    views: int = 3,
    mesh_resolution: int = 512,
    repeats: int = 2,
    naive: bool = True,
    device: str = "cpu",
    networks: Networks = NETWORKS,
    progress: Callable[[str, Progress], None] | None = None,
    report: Callable[[str], None] | None = None,
) -> list[RenderRow]:
    """Fit the networks of Tab. 4 to each shape, and time pictures of them.

    Args:
        shapes: meshes or clouds.
        directory: where the fits are kept; those that are there already are used.
        config: settings of the fits, apart from the networks and their steps.
        size: width and height of the images.
        views: how many cameras, evenly around the shape.
        mesh_resolution: cells along each side of the meshes that holes are counted against.
        repeats: the best of so many is what counts.
        naive: whether to time the naive tracer as well (one camera, once: it takes a minute).
        device: where to trace.
        networks: what to fit; the names are those of `NETWORKS`.
        progress: called with a name and the progress of a fit.
        report: called with what is going on.

    Raises:
        InputError: a file cannot be read, or a fit has no surface.
    """
    say = report or (lambda _: None)
    rows: list[RenderRow] = []
    for shape in map(Path, shapes):
        fields = fit_networks(shape, directory / shape.stem, config, networks=networks, progress=progress)
        fields = {name: field.to(device).requires_grad_(False) for name, field in fields.items()}
        truth = Truth(fields, resolution=mesh_resolution, device=device, report=say)
        corners = truth.outline("128x2_256x2_400x2")
        cameras = [orbit(corners, azimuth=30 + 360 * view / views, width=size, height=size) for view in range(views)]
        for mode in ("adaptive", "budget"):
            found: list[RenderRow] = []
            for model in MODELS:
                say(f"{shape.stem}: {model.name}, {mode}")
                row = _time(fields[model.network], model, mode, cameras, truth, repeats, device)
                base = found[0].seconds if found else row.seconds
                found.append(replace(row, shape=shape.stem, speedup=base / row.seconds))
            rows += found
        if naive:
            found = []
            for model in (MODELS[0], MODELS[-1]):
                say(f"{shape.stem}: {model.name}, naive")
                row = _time(fields[model.network], model, "naive", cameras[:1], truth, 1, device)
                base = found[0].seconds if found else row.seconds
                found.append(replace(row, shape=shape.stem, speedup=base / row.seconds, paper_speedup=None))
            rows += found
    return rows


def fit_networks(
    shape: Path,
    directory: Path,
    config: FitConfig,
    *,
    networks: Networks = NETWORKS,
    progress: Callable[[str, Progress], None] | None = None,
) -> dict[str, Field]:
    """The networks fitted to a shape; each is a run in ``directory``, and what is there is not fitted again."""
    cloud = read_cloud(shape)
    fields: dict[str, Field] = {}
    for name, levels in networks.items():
        run = directory / name
        if not (run / FIELD_FILE).is_file() or (run / STATE_FILE).is_file():
            widths, depths, omegas, steps, rates = zip(*levels, strict=True)
            settings = replace(
                config, widths=widths, depths=depths, omegas=omegas, steps=steps, learning_rates=rates, levels=None
            )
            told = None if progress is None else _named(progress, f"{shape.stem} {name}")
            fit(cloud, settings, out=run, resume=(run / STATE_FILE).is_file(), progress=told)
        fields[name] = load_field(run / FIELD_FILE).field
    return fields


def _named(progress: Callable[[str, Progress], None], name: str) -> Callable[[Progress], None]:
    return lambda step: progress(name, step)


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
        parameters=sum(p.numel() for level in levels for p in level.parameters()),
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
    """Sphere tracing as it is first written: every level everywhere, every ray to the end, all rays in one batch."""
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


def format_render(rows: Sequence[RenderRow], *, sgemm: float) -> str:
    """The table that the command prints.

    Speed-ups are over (400,4) in the same mode, over (400,4) with the paper's 20 steps, and those of the paper.

    Args:
        rows: of `bench_render`.
        sgemm: the machine's matrix rate in FLOP/s, the limit of every row.
    """
    header = (
        *("shape, mode, model", "parameters", "fps", "same mode", "20 steps", "paper", "evaluations per pixel"),
        *("of SGEMM", "image rms", "depth 99.9 %", "holes", "per 100 K", "false"),
    )
    fixed = {row.shape: row.seconds for row in rows if row.mode == "budget" and row.model == MODELS[0].name}
    cells = []
    for row in rows:
        agreement = row.agreement
        cells.append(
            (
                f"{row.shape} {row.mode:8} {row.model}",
                f"{row.parameters:,}",
                f"{1 / row.seconds:.2f}",
                f"{row.speedup:.1f}×",
                f"{fixed[row.shape] / row.seconds:.1f}×",
                "" if row.paper_speedup is None else f"{row.paper_speedup:.1f}×",
                " + ".join(f"{count:.2f}" for count in row.evaluations),
                f"{row.flops / row.seconds / sgemm:.0%}",
                f"{agreement.image_error:.4f}",
                f"{agreement.depth_error:.1e}",
                str(agreement.holes),
                f"{1e5 * agreement.holes / agreement.silhouette:.1f}" if agreement.silhouette else "",
                str(agreement.false_hits),
            )
        )
    return format_table(header, cells)
