"""From a training that has ended to a row of ``mplicits bench reconstruct``, and the sheet of all rows of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray
from torch import nn

from ..datasets.views.images import PosedImage
from ..neural_fields.baselines import NeusSDF
from ..neural_fields.meshing import Mesh
from .bench_reconstruct_row import EQUAL_TIME, ReconstructRow, SurfaceFigures
from .bench_reconstruct_scene import BenchScene
from .bench_reconstruct_train import Watched
from .reconstruct.views import ViewImage, measure
from .render.rasterise import contact_sheet
from .run.settings import ReconstructConfig
from .surface.measure import Metrics, evaluate_surfaces
from .surface.surface import Surface, from_mesh
from .surface.trim import keep_largest

__all__ = ["common_sheet", "row_of", "surface_figures"]

Image = NDArray[np.uint8]

COMMON_VIEWS = 2  # on the sheet of all rows


def row_of(
    scene: BenchScene,
    kind: str,
    config: ReconstructConfig,
    watched: Watched,
    pairs: Sequence[tuple[PosedImage, ViewImage]],
    surface: SurfaceFigures | None,
    *,
    start_seconds: float,
    device: str,
) -> ReconstructRow:
    """All figures of a training.

    Args:
        scene: what was trained on.
        kind: see `ReconstructRow`.
        config: settings of the training.
        watched: the training.
        pairs: held-out views, and how the model renders them.
        surface: how near the surface came, if that can be said.
        start_seconds: see `ReconstructRow`.
        device: where it was trained.
    """
    trainer, model = watched.trainer, watched.trainer.model
    views = [measure(image, view, model.background) for view, image in pairs]
    inside = [figures["psnr_object"] for figures in views if "psnr_object" in figures]
    rays = trainer.step * config.rays
    neus = isinstance(model.geometry, NeusSDF)
    sizes = [(model.geometry.width, model.geometry.depth)] if neus else zip(config.widths, config.depths, strict=True)
    name = "▷".join(f"({width},{depth})" for width, depth in sizes)
    return ReconstructRow(
        scene=scene.name,
        kind=kind,
        network=f"NeuS {name}" if neus else name,
        steps=trainer.step,
        rays=config.rays,
        seconds=trainer.elapsed,
        start_seconds=start_seconds,
        step_seconds=watched.step_seconds,
        views=len(views),
        psnr=float(np.mean([figures["psnr"] for figures in views])),
        psnr_object=float(np.mean(inside)) if inside else None,
        ssim=float(np.mean([figures["ssim"] for figures in views])),
        parameters=_size(model.geometry),
        color_parameters=_size(model.color),
        outside_parameters=0 if model.outside is None else _size(model.outside),
        geometry_flops=watched.geometry_flops / rays,
        color_flops=watched.color_flops / rays,
        values_per_ray=tuple(rows / rays for rows in watched.values),
        jets_per_ray=tuple(rows / rays for rows in watched.jets),
        colors_per_ray=watched.colors / rays,
        finest_share=watched.finest_share,
        exact=scene.exact is not None,
        surface=surface,
        inv_std=float(model.inv_std),
        deltas=tuple(model.geometry.deltas.tolist()),
        device=device,
    )


def _size(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def surface_figures(mesh: Mesh, truth: Surface, *, samples: int, columns: int = 512, seed: int = 0) -> SurfaceFigures:
    """A mesh, and its largest component, against the exact surface; both in the same coordinates.

    Args:
        mesh: to be judged.
        truth: the exact surface.
        samples: points on each of them.
        columns: of the volumetric IoU, see `evaluate_surfaces`.
        seed: of the samples.
    """

    def judge(part: Mesh) -> Metrics:
        return evaluate_surfaces(from_mesh(part), truth, samples=samples, seed=seed, columns=columns)

    whole = judge(mesh)
    largest = whole if whole.components == 1 else judge(keep_largest(mesh))
    return SurfaceFigures(
        chamfer=whole.chamfer,
        floor=whole.chamfer_floor,
        largest_chamfer=largest.chamfer,
        iou=whole.iou,
        normal_consistency=whole.normal_consistency,
        components=whole.components,
    )


def common_sheet(sheets: Sequence[tuple[ReconstructRow, Path]], views: Sequence[PosedImage]) -> Image:
    """The first views as all rows render them: two lines for each, colours beside the photograph, and normals.

    Args:
        sheets: rows, and the files of their `comparison_sheet` of ``views``.
        views: the photographs.
    """
    panels = [_panels(iio.imread(path), views) for _, path in sheets]
    lines = []
    for index in range(min(COMMON_VIEWS, len(views))):
        photograph = panels[0][index][0]
        colors, normals = [("photograph", photograph)], [(views[index].name, np.full_like(photograph, 255))]
        for (row, _), found in zip(sheets, panels, strict=True):
            # OpenCV draws ASCII.
            name = "equal time" if row.kind == EQUAL_TIME else row.network.replace("▷", " > ")
            colors.append((f"{name}: {row.psnr:.2f} dB", found[index][1]))
            normals.append((f"normals, {row.steps} steps", found[index][2]))
        lines += [contact_sheet(colors), contact_sheet(normals)]
    widest = max(line.shape[1] for line in lines)
    return np.concatenate(
        [np.pad(line, ((0, 0), (0, widest - line.shape[1]), (0, 0)), constant_values=255) for line in lines]
    )


def _panels(sheet: Image, views: Sequence[PosedImage]) -> list[tuple[Image, Image, Image]]:
    """Photograph, colours and normals of each view on a `comparison_sheet`, in whole multiples of their size."""
    sizes = [view.color.shape[:2] for view in views]
    factor = sheet.shape[1] // (3 * max(width for _, width in sizes))
    gap = sheet.shape[0] // factor - sum(height for height, _ in sizes)
    found, top = [], 0
    for height, width in sizes:
        line = sheet[top : top + factor * height]
        photograph, color, normal = (line[:, k * factor * width : (k + 1) * factor * width] for k in range(3))
        found.append((photograph, color, normal))
        top += factor * height + factor * gap // len(sizes)
    return found
