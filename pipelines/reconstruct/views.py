"""Pictures of a scene under training: rendered views, how near they are to the photographs, contact sheets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.files import unit_range
from ...datasets.views.images import OBJECT, PosedImage, resample, shrink
from ...neural_fields import Field, Mesh, sphere_trace
from ...neural_fields.backend.arrays import Float32
from ...neural_fields.volume.render import Sampling
from ..render.picture import Image, stacked
from ..render.rasterise import mesh_view
from ..render.studio import sees
from .model import SceneModel, meets_sphere


@dataclass(frozen=True)
class ViewImage:
    """A rendered view."""

    color: Float32  # (H, W, 3) display RGB in [0, 1]
    normal: Float32  # (H, W, 3) in unit-sphere coordinates; shorter than 1 where the view passes the object
    opacity: Float32  # (H, W)


@torch.no_grad()
def render_camera(
    model: SceneModel,
    camera: Camera,
    sampling: Sampling,
    *,
    level: int = -1,
    sdf_grid: Callable[[Tensor], Tensor] | None = None,
) -> ViewImage:
    """Volume-render the image of a camera in unit-sphere coordinates, a ray through the middle of each pixel.

    ``level`` and ``sdf_grid`` are those of `SceneModel.render`.
    """
    device = model.background.device
    eye, directions = camera.rays(device=device)
    directions = directions.reshape(-1, 3)
    origins = eye.expand_as(directions)
    color = model.background.expand(len(origins), 3).clone()
    normal, opacity = torch.zeros_like(color), torch.zeros_like(color[:, 0])
    # Rays that pass the region of interest see the background, whose colour is known unless it is learnt.
    cast = torch.from_numpy(np.flatnonzero(meets_sphere(camera) | (model.outside is not None))).to(device)
    how = {"level": level, "early_stop_eps": 1e-4, "alpha_threshold": 1e-4, "sdf_grid": sdf_grid}
    for rows in cast.split(4096):
        rendered = model.render(origins[rows], directions[rows], sampling, **how)
        color[rows], normal[rows], opacity[rows] = rendered.color, rendered.normal, rendered.opacity
    shape = (camera.height, camera.width)
    return ViewImage(
        color.clamp(0, 1).reshape(*shape, 3).cpu().numpy(),
        normal.reshape(*shape, 3).cpu().numpy(),
        opacity.reshape(shape).cpu().numpy(),
    )


def held_out(views: Sequence[PosedImage], every: int) -> tuple[list[PosedImage], list[PosedImage]]:
    """The views to train on, and those held out: every n-th, from the first; none for 0, and none of a single view."""
    if every == 0 or len(views) == 1:
        return list(views), []
    step = max(2, every)
    return [view for index, view in enumerate(views) if index % step], list(views[::step])


def spread(views: Sequence[PosedImage]) -> list[PosedImage]:
    """The views in an order whose first few, however many, are spread over all of them."""
    golden = (5**0.5 - 1) / 2
    return [views[index] for index in sorted(range(len(views)), key=lambda index: index * golden % 1)]


def reduced(view: PosedImage, pixels: int) -> PosedImage:
    """A view in at most about ``pixels`` pixels, in linear light."""
    small = _coarse(view.camera, pixels)
    if small is view.camera:
        return view
    step = partial(shrink, width=small.width, height=small.height)
    mask = None if view.mask is None else step(view.mask)
    return PosedImage(view.name, small, resample(view.color, None, step)[0], mask)


def target_of(view: PosedImage, background: Tensor) -> Float32:
    """The photograph ``(H, W, 3)`` on the scene's background, where a mask says what is object."""
    if view.mask is None:
        return view.color
    share = view.mask[..., None]
    return (share * view.color + (1 - share) * background.cpu().numpy()).astype(np.float32)


def exposed_as(image: ViewImage, view: PosedImage, background: Tensor) -> ViewImage:
    """A rendered view with the gain and offset of each channel that bring it nearest to its photograph.

    By least squares over the object's pixels: g C + α o = p − (1 − α) b of the rendered object C, its opacity α and the
    known background b, both 1 and 0 where there is none. The background stays unchanged.
    """
    target, share = target_of(view, background), np.ones_like(image.opacity)
    behind = np.zeros_like(image.color)
    chosen = np.ones(share.shape, bool)
    if view.mask is not None:
        share, chosen = image.opacity, view.mask > 0
        behind = (1 - share)[..., None] * background.cpu().numpy()
    color = image.color.copy()
    for channel in range(3):
        columns = np.stack((image.color[..., channel] - behind[..., channel], share), axis=-1)
        wanted = (target - behind)[..., channel]
        solved = np.linalg.lstsq(columns[chosen], wanted[chosen])[0]
        color[..., channel] = columns @ solved + behind[..., channel]
    return replace(image, color=np.clip(color, 0, 1))


def measure(image: ViewImage, view: PosedImage, background: Tensor) -> dict[str, float]:
    """PSNR in dB and SSIM of a rendered view against its photograph; with a mask, PSNR inside the object as well."""
    from kornia.metrics import psnr, ssim

    target = target_of(view, background)
    ours, theirs = (torch.from_numpy(picture).permute(2, 0, 1)[None] for picture in (image.color, target))
    figures = {"psnr": float(psnr(ours, theirs, 1.0)), "ssim": float(ssim(ours, theirs, 11).mean())}
    if view.mask is not None and bool((view.mask > OBJECT).any()):
        inside = torch.from_numpy(view.mask > OBJECT)
        figures["psnr_object"] = float(psnr(ours[0, :, inside], theirs[0, :, inside], 1.0))
    return figures


def comparison_sheet(pairs: Sequence[tuple[PosedImage, ViewImage]], background: Tensor) -> Image:
    """Photograph, rendering and normals of each view, side by side, one row per view."""
    rows: list[Image] = []
    for view, image in pairs:
        normals = 0.5 + 0.5 * image.normal
        normals = image.opacity[..., None] * normals + (1 - image.opacity[..., None])
        panels = [target_of(view, background), image.color, np.clip(normals, 0, 1)]
        rows.append((np.concatenate(panels, axis=1) * 255).round().astype(np.uint8))
    picture = stacked(rows, gap=4)
    factor = max(1, 600 // picture.shape[1])  # so that pixels of small pictures can be seen
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


MaskedCamera = tuple[Camera, NDArray[np.float32] | NDArray[np.uint8] | None]
"""A camera in unit-sphere coordinates, and the mask ``(H, W)`` of the object in its picture, which may be in bytes."""


@torch.no_grad()
def visible_points(field: Field, views: Sequence[MaskedCamera]) -> tuple[Tensor, float]:
    """Points ``(N, 3)`` of the surface visible in at least two views, on the CPU, and the distance of neighbours.

    Each view is traced in up to 10,000 pixels inside its mask, and all views together in up to 300,000. Points in one
    voxel count as one. Its edge is 1/32 of a radius, or the distance of neighbouring pixels on an oblique surface.
    ``views`` are cameras in the field's unit-sphere coordinates, and masks if there are any.
    """
    pixels = max(1, min(300_000 // len(views), 10_000))
    points: list[Tensor] = []
    owners: list[Tensor] = []
    pitches: list[Tensor] = []
    for number, (whole, mask) in enumerate(views):
        camera = _coarse(whole, pixels)
        eye, directions = camera.rays(device=field.like.device)
        traced = torch.ones(directions.shape[:2], dtype=torch.bool)
        if mask is not None:
            traced = torch.from_numpy(shrink(unit_range(mask), camera.width, camera.height) > OBJECT)
        rays = directions[traced.to(directions.device)].to(field.like)
        hits = sphere_trace(field, eye.to(rays).expand_as(rays), rays, tolerance=1e-3, resolution=1e-3, radius=1.0)
        points.append(hits.position[hits.mask].cpu().double())
        owners.append(torch.full((len(points[-1]),), number))
        pitches.append(hits.depth[hits.mask].cpu().double() / float(camera.intrinsics[0, 0]))
    every = torch.cat(points)
    if not len(every):
        return every, math.inf
    within = 2 * float(np.median(torch.cat(pitches)))
    cells = ((every + 1) / max(1 / 32, within)).floor().long()
    across = 1 + int(cells.max())
    place = (cells[:, 0] * across + cells[:, 1]) * across + cells[:, 2]
    # A view counts once in a place, for any number of its pixels.
    pairs = torch.unique(place * len(views) + torch.cat(owners))
    cell, view_count = torch.unique(pairs // len(views), return_counts=True)
    # A single view does not determine depth.
    return every[torch.isin(place, cell[view_count >= min(2, len(views))])], within


def _coarse(camera: Camera, pixels: int) -> Camera:
    """A camera of at most about ``pixels`` pixels."""
    share = math.sqrt(pixels / (camera.width * camera.height))
    return camera if share >= 1 else _scaled(camera, share)


def _scaled(camera: Camera, share: float) -> Camera:
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def count_views(
    views: Sequence[MaskedCamera],
    surface: Mesh,
    points: NDArray[np.float64],
    *,
    finest: int = 1024,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.int64]:
    """How many ``views`` ``(N,)`` see points ``(N, 3)`` of a surface: in picture and mask, with nothing before them.

    Cameras are in the surface's coordinates. ``finest`` pixels of the longer side decide what hides what. Ten of them
    wide is the strip beyond a rim that may count as seen. ``progress`` is called with ``(done, total)`` after every
    camera.
    """
    counts = np.zeros(len(points), dtype=np.int64)
    for index, (camera, mask) in enumerate(views):
        large = _scaled(camera, finest / max(camera.width, camera.height))
        seen = sees(large, mesh_view(surface, large), points)
        if mask is not None:
            column, row = np.rint(camera.in_view(points[seen])[0]).astype(np.int64).T
            place = row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)
            seen[seen] = unit_range(mask[place]) > OBJECT
        counts += seen
        if progress is not None:
            progress(index + 1, len(views))
    return counts
