"""Benchmark ``normal-map``: what the normals of a fine level do for a coarse surface, judged by the original."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from mplicits.datasets import Camera, turntable
from mplicits.neural_fields import Field, InputError, Mesh, load_field
from mplicits.neural_fields.backend.devices import choose_device
from mplicits.neural_fields.meshing.extract import NoSurfaceError, extract_mesh, map_normals
from mplicits.neural_fields.networks.multiscale import levels_of
from mplicits.pipelines.render.picture import check_picture_path, contact_sheet, write_picture
from mplicits.pipelines.render.rasterise import mesh_view
from mplicits.pipelines.render.shade import ShadeOptions, compose, shade
from mplicits.pipelines.render.trace import Seen, trace_view
from mplicits.pipelines.surface.surface import read_reference
from mplicits.pipelines.training.folder import find_field
from mplicits.pipelines.training.trainer import parameter_count
from torch import Tensor

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated
from .compare import ImageError, draw, image_error, psnr

# A reference whose vertices are mostly further than this from the coarse surface is another shape (unit sphere).
ELSEWHERE = 0.1
PROBED = 10_000
PLAIN = ShadeOptions(shadows=False, occlusion=False)

View = Callable[[Camera], Seen]


@dataclass(frozen=True)
class NormalMapRow:
    """One way to draw the run, compared with the original, all cameras together.

    Attributes:
        method: whose surface with whose normals.
        parameters: of the levels that are evaluated.
        error: of the shaded images, display RGB in [0, 1].
        degrees: mean angle between the normals, over the pixels that see the shape in both images.
        seconds: per image; the mean over the cameras of the best of some repeats.
        prepare_seconds: extraction of the mesh, if one is drawn.
    """

    method: str
    parameters: int
    error: ImageError
    degrees: float
    seconds: float
    prepare_seconds: float

    @property
    def rmse_either(self) -> float:
        """Over the pixels that see the shape in either image."""
        return math.sqrt(self.error.either)

    @property
    def rmse_both(self) -> float:
        """Over the pixels that are inside both."""
        return math.sqrt(self.error.both)

    @property
    def psnr_either(self) -> float:
        """The same in dB."""
        return psnr(self.error.either)

    @property
    def psnr_both(self) -> float:
        """The same in dB."""
        return psnr(self.error.both)


@dataclass(frozen=True)
class _Method:
    name: str
    levels: int
    prepare_seconds: float
    view: View


@dataclass(frozen=True, kw_only=True)
class NormalMapBench(Benchmark[NormalMapRow]):
    """Every level of a run, and the coarsest with the normals of the finest, drawn as the original is drawn.

    The original's normals are those of its vertices, interpolated. No shadows or occlusion: they would add errors of
    their own.

    Attributes:
        run_file: run directory or .safetensors file of at least two levels.
        reference: the mesh that the run was fitted to, in the same coordinates.
        shading: "headlight", "lambert" or "normals".
        size: width and height of the images.
        views: how many cameras, evenly around the shape.
        up: "y" or "z".
        resolution: of the marching cubes of the coarsest level.
        repeats: runs per image; its time is the best of them.
        picture: a contact sheet: one line per camera, the original first.
    """

    name = "normal-map"
    source = "what the normals of a fine level do for a coarse surface"
    row = NormalMapRow
    apart = ("run_file", "reference")
    run_file: str | Path
    reference: str | Path
    shading: str = "headlight"
    size: int = 512
    views: int = 3
    up: str = "y"
    resolution: int = 256
    repeats: int = 2
    picture: Path | None = None

    def jobs(self) -> list[Part]:
        """One; see `Benchmark.jobs`."""
        if self.picture is not None:
            check_picture_path(self.picture)
        file, reference = find_field(self.run_file), Path(self.reference)
        read_reference(reference)
        return [Part(self.name, f"{file.parent.name} against {reference.name}", (file, reference))]

    def measure(self, job: Part, context: Context) -> list[NormalMapRow]:
        """See `Benchmark.measure`."""
        (file, reference), place, shading = job.files, choose_device(self.device), self.shading
        field, similarity, _ = load_field(file, device=place)
        if field.num_levels < 2:
            raise InputError(f"{file}: has one level; normals are mapped from a finer level to a coarser one")
        original = read_reference(reference).moved(similarity)
        _check_place(field, original, f"{reference}", place)
        cameras = turntable(original.used_vertices(), self.views, width=self.size, height=self.size, up=self.up)
        context.say("the original")
        truth = [(mesh_view(original, camera), camera) for camera in cameras]
        wanted = [draw(seen, shade(seen, shading, camera=c, options=PLAIN)) for seen, c in truth]
        rows, lines = [], [[("original", _image(seen, c, shading))] for seen, c in truth]
        for method in _methods(field, f"{file}", self.resolution, place, context.say):
            context.say(method.name)
            method.view(cameras[0].resized(64, 64))  # the first call pays for what later ones find ready
            timed = [_best(method.view, camera, shading, self.repeats) for camera in cameras]
            drawings = [draw(seen, colors) for _, seen, colors in timed]
            rows.append(
                NormalMapRow(
                    method=method.name,
                    parameters=parameter_count(*levels_of(field)[: method.levels]),
                    error=image_error(zip(wanted, drawings, strict=True)),
                    degrees=_degrees([(one, seen) for (one, _), (_, seen, _) in zip(truth, timed, strict=True)]),
                    seconds=sum(seconds for seconds, _, _ in timed) / len(cameras),
                    prepare_seconds=method.prepare_seconds,
                )
            )
            for line, (_, seen, colors) in zip(lines, timed, strict=True):
                line.append((method.name, compose(seen, colors)))
        if self.picture is not None:
            write_picture(self.picture, contact_sheet(*lines))
        return rows

    def tables(self, rows: Sequence[NormalMapRow], *, sgemm: float) -> tuple[Table, ...]:
        """Errors over the pixels that see the shape in either image, or in both."""
        figures: list[Figure[NormalMapRow]] = [
            (Column("parameters", ",d"), lambda r: r.parameters),
            (Column("RMSE either", ".4f"), lambda r: r.rmse_either),
            (Column("PSNR, dB", ".1f"), lambda r: r.psnr_either),
            (Column("RMSE both", ".4f"), lambda r: r.rmse_both),
            (Column("PSNR, dB", ".1f"), lambda r: r.psnr_both),
            (Column("normals", "s"), lambda r: f"{r.degrees:.1f}°"),
            (Column("ms per image", ".0f"), lambda r: 1e3 * r.seconds),
            (Column("mesh, s", ".1f"), lambda r: r.prepare_seconds or None),
        ]
        items = [(row.method, row) for row in rows]
        return (tabulated(self.name, "Normals of a fine level on a coarse surface", "method", figures, items),)


def _check_place(field: Field, original: Mesh, name: str, device: torch.device) -> None:
    points = torch.from_numpy(original.used_vertices().clip(-1.5, 1.5)).float()
    probed = points[:: max(1, len(points) // PROBED)]
    with torch.inference_mode():
        distance = float(field.value(probed.to(device), level=0).abs().median())
    if distance > ELSEWHERE:
        raise InputError(
            f"{name}: half of its vertices are further than {ELSEWHERE:g} of the run's size from its surface; give the "
            "mesh that was fitted, in the same coordinates"
        )


def _methods(
    field: Field, name: str, resolution: int, device: torch.device, say: Callable[[str], None]
) -> list[_Method]:
    finest = field.num_levels - 1
    traced = partial(trace_view, field, device=device)
    say("the mesh of level 0")
    started = time.perf_counter()
    try:
        mesh = extract_mesh(field, resolution=resolution, level=0)
    except NoSurfaceError as error:
        raise InputError(f"{name}: level 0 has no surface ({error}); train it longer") from error
    extracted = time.perf_counter()
    mapped = map_normals(mesh, field, level=finest)
    done = time.perf_counter()
    fine = f"normals of level {finest}"
    return [
        _Method("level 0", 1, 0.0, partial(traced, level=0)),
        _Method(f"level 0 + {fine}", finest + 1, 0.0, partial(traced, level=0, normal_level=finest)),
        _Method("mesh of level 0", 1, extracted - started, partial(mesh_view, mesh)),
        _Method(f"mesh of level 0 + {fine}", finest + 1, done - started, partial(mesh_view, mapped)),
        *(_Method(f"level {level}", level + 1, 0.0, partial(traced, level=level)) for level in range(1, finest + 1)),
    ]


@torch.inference_mode()
def _best(view: View, camera: Camera, shading: str, repeats: int) -> tuple[float, Seen, Tensor]:
    """Seconds of the quickest of some drawings, what is seen in it, and its colours."""
    drawn = []
    for _ in range(repeats):
        start = time.perf_counter()
        seen = view(camera)
        colors = shade(seen, shading, camera=camera, options=PLAIN)
        if colors.is_cuda:
            torch.cuda.synchronize()
        drawn.append((time.perf_counter() - start, seen, colors))
    return min(drawn, key=lambda one: one[0])


def _image(seen: Seen, camera: Camera, shading: str) -> Any:
    return compose(seen, shade(seen, shading, camera=camera, options=PLAIN))


def _degrees(pairs: Sequence[tuple[Seen, Seen]]) -> float:
    """Mean angle between the normals of pixels that both see."""
    angles = []
    for first, second in pairs:
        mine, other = (torch.zeros(first.size[0] * first.size[1], 3, dtype=torch.float64) for _ in range(2))
        mine[first.pixel.cpu()], other[second.pixel.cpu()] = first.normal.cpu().double(), second.normal.cpu().double()
        shared = first.pixel.cpu()[torch.isin(first.pixel.cpu(), second.pixel.cpu())]
        sine = torch.linalg.cross(mine[shared], other[shared]).norm(dim=1)
        angles.append(torch.atan2(sine, (mine[shared] * other[shared]).sum(dim=1)))
    return math.degrees(float(torch.cat(angles).mean()))
