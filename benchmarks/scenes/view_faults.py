"""Faults of posed photographs, one at a time, to test checks and trainings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from mplicits.datasets.views.formats.shots import DepthMap
from mplicits.datasets.views.images import PosedImage, PosedImages
from mplicits.neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from scipy.spatial.transform import Rotation


def with_fault(images: PosedImages, fault: str, seed: int = 0) -> PosedImages:
    """The data set with one of the `VIEW_FAULTS`.

    ``poses``: each camera is turned about its eye by 0.5° (standard deviation) about each axis, and moved by 0.5 % of
    the region's radius along each; ``pose``: one camera looks 30° past the object; ``image``: one photograph is that of
    another camera; ``mirrored``: all pictures, left to right; ``masks``: object and background are exchanged;
    ``holes``: every twelfth mask has a hole in the middle of the object, a fifth of the picture wide; ``exposure``:
    every other photograph has half of the light. The one picture, and the first with a hole, is the third, which is not
    held out.
    """
    change = VIEW_FAULTS[fault]
    if len(images.views) < 3:
        raise ValueError(f"{len(images.views)} views; a fault needs three")
    return replace(images, views=tuple(change(images, np.random.default_rng(seed))))


def _poses(images: PosedImages, random: np.random.Generator) -> list[PosedImage]:
    radius = images.similarity.scale
    return [_turned(view, random.normal(0, 0.5, 3), random.normal(0, 0.005 * radius, 3)) for view in images.views]


def _pose(images: PosedImages, _: np.random.Generator) -> list[PosedImage]:
    views = list(images.views)
    views[2] = _turned(views[2], np.array([0, 30.0, 0]), np.zeros(3))
    return views


def _turned(view: PosedImage, degrees: np.ndarray, shift: np.ndarray) -> PosedImage:
    """The view with its camera turned about its eye, in its own axes, and moved in the world's."""
    pose = view.camera.world_from_camera.clone()
    turn = torch.from_numpy(Rotation.from_rotvec(degrees, degrees=True).as_matrix()).to(pose)
    pose[:3, :3] = pose[:3, :3] @ turn
    pose[:3, 3] += torch.from_numpy(shift).to(pose)
    depth = None if view.depth is None else _placed(view.depth, pose)
    return replace(view, camera=replace(view.camera, world_from_camera=pose), depth=depth)


def _placed(depth: DepthMap, pose: torch.Tensor) -> DepthMap:
    """The depth map with another pose."""
    return replace(depth, camera=replace(depth.camera, world_from_camera=pose))


def _image(images: PosedImages, _: np.random.Generator) -> list[PosedImage]:
    views = list(images.views)
    there, shown = views[2], views[1]
    depth = None if shown.depth is None else _placed(shown.depth, there.camera.world_from_camera)
    views[2] = replace(there, color=shown.color, mask=shown.mask, depth=depth)
    return views


def _mirrored(images: PosedImages, _: np.random.Generator) -> list[PosedImage]:
    def mirrored(view: PosedImage) -> PosedImage:
        mask = None if view.mask is None else view.mask[:, ::-1]
        depth = None if view.depth is None else replace(view.depth, numbers=view.depth.numbers[:, ::-1])
        return replace(view, color=view.color[:, ::-1], mask=mask, depth=depth)

    return [mirrored(view) for view in images.views]


def _masks(images: PosedImages, _: np.random.Generator) -> list[PosedImage]:
    return [replace(view, mask=None if view.mask is None else 1 - view.mask) for view in images.views]


def _holes(images: PosedImages, _: np.random.Generator) -> list[PosedImage]:
    views = list(images.views)
    views[2::12] = [_torn(view) for view in views[2::12]]
    return views


def _torn(view: PosedImage) -> PosedImage:
    if view.mask is None or not view.mask.any():
        return view
    y, x = np.indices(view.mask.shape)
    down, across = (np.average(axis, weights=view.mask) for axis in (y, x))
    hole = (y - down) ** 2 + (x - across) ** 2 < (0.1 * view.mask.shape[1]) ** 2
    return replace(view, mask=np.where(hole, 0, view.mask).astype(view.mask.dtype))


def _exposure(images: PosedImages, _: np.random.Generator) -> list[PosedImage]:
    return [
        replace(view, color=linear_to_srgb(0.5 * srgb_to_linear(view.color)).astype(np.float32)) if odd % 2 else view
        for odd, view in enumerate(images.views)
    ]


VIEW_FAULTS: dict[str, Callable[[PosedImages, np.random.Generator], list[PosedImage]]] = {
    "poses": _poses,
    "pose": _pose,
    "image": _image,
    "mirrored": _mirrored,
    "masks": _masks,
    "holes": _holes,
    "exposure": _exposure,
}
