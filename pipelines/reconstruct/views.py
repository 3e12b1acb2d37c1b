"""Pictures of a scene under training: rendered views, how near they are to the photographs, contact sheets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.views.images import PosedImage, resample, shrink
from ...neural_fields import Similarity
from ...neural_fields.volume.render import Sampling
from ...neural_fields.volume.weights import sphere_span
from ..render.picture import Image, stacked
from .data.silhouettes import OBJECT
from .model.model import SceneModel, camera_rays

__all__ = [
    "ViewImage",
    "comparison_sheet",
    "exposed_as",
    "held_out",
    "measure",
    "reduced",
    "render_camera",
    "render_image",
    "spread",
    "target_of",
]

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class ViewImage:
    """A rendered view.

    Attributes:
        color: ``(H, W, 3)`` display RGB in [0, 1].
        normal: ``(H, W, 3)`` in unit-sphere coordinates; shorter than 1 where the view passes the object.
        opacity: ``(H, W)``.
    """

    color: Float32
    normal: Float32
    opacity: Float32


def render_image(
    model: SceneModel,
    view: PosedImage,
    similarity: Similarity,
    sampling: Sampling,
    **options: Any,
) -> ViewImage:
    """Render a view with the model's volume renderer.

    Args:
        model: on any device.
        view: whose camera it is.
        similarity: from world to unit-sphere coordinates.
        sampling: where to sample.
        options: of `render_camera`.
    """
    return render_camera(model, view.camera.moved(similarity), sampling, **options)


@torch.no_grad()
def render_camera(
    model: SceneModel,
    camera: Camera,
    sampling: Sampling,
    *,
    level: int = -1,
    least_weight: float = 1e-4,
    skip: float = 1e-4,
    guide: Callable[[Tensor], Tensor] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ViewImage:
    """Render what a camera sees with the model's volume renderer, a ray through the middle of each pixel.

    Args:
        model: on any device.
        camera: in unit-sphere coordinates.
        sampling: where to sample.
        level: of the geometry.
        least_weight: see `render_volume`.
        skip: the same.
        guide: the same.
        progress: told (rays done, rays in all).
    """
    device = model.background.device
    origins, directions = (part.to(device) for part in camera_rays(camera))
    color = model.background.expand(len(origins), 3).clone()
    normal, opacity = torch.zeros_like(color), torch.zeros_like(color[:, 0])
    near, far = sphere_span(origins, directions)
    # Rays that pass the region of interest see the background, whose colour is known unless it is learnt.
    asked = (far > near).nonzero()[:, 0] if model.outside is None else torch.arange(len(origins), device=device)
    done = 0
    for rows in asked.split(4096):
        seen = model.render(
            origins[rows],
            directions[rows],
            sampling,
            level=level,
            least_weight=least_weight,
            skip=skip,
            guide=guide,
        )
        color[rows], normal[rows], opacity[rows] = seen.color, seen.normal, seen.opacity
        done += len(rows)
        if progress:
            progress(done, len(asked))
    shape = (camera.height, camera.width)
    return ViewImage(
        color.clamp(0, 1).reshape(*shape, 3).cpu().numpy(),
        normal.reshape(*shape, 3).cpu().numpy(),
        opacity.reshape(shape).cpu().numpy(),
    )


def held_out(views: Sequence[PosedImage], every: int) -> tuple[list[PosedImage], list[PosedImage]]:
    """Split views into those to train on and those held out: every n-th one, from the first; none for 0.

    At least one view is trained on, so of a single view none is held out.
    """
    if every == 0 or len(views) == 1:
        return list(views), []
    chosen = set(range(0, len(views), max(2, every)))
    train = [view for index, view in enumerate(views) if index not in chosen]
    return train, [view for index, view in enumerate(views) if index in chosen]


def spread(views: Sequence[PosedImage]) -> list[PosedImage]:
    """The views in an order whose first few, however many, are spread over all of them."""
    golden = (5**0.5 - 1) / 2
    order = sorted(range(len(views)), key=lambda index: index * golden % 1)
    return [views[index] for index in order]


def reduced(view: PosedImage, pixels: int) -> PosedImage:
    """A view in about so many pixels, in linear light; as it is, if it has no more."""
    camera = view.camera
    share = math.sqrt(pixels / (camera.width * camera.height))
    if share >= 1:
        return view
    small = camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))
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
    known background b, both 1 and 0 where there is none. The background stays as it is.
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
    figures = {
        "psnr": float(psnr(ours, theirs, 1.0)),
        "ssim": float(ssim(ours, theirs, 11).mean()),
    }
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
    return _enlarged(stacked(rows, gap=4))


def _enlarged(picture: Image, least: int = 600) -> Image:
    """Small pictures in whole multiples of their size, so that their pixels can be seen."""
    factor = max(1, least // picture.shape[1])
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)
