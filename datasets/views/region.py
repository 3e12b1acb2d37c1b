"""The region of the object in posed photographs: a sphere from cameras, sparse points, or masks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import Similarity
from ..cameras import Camera, Float64


@dataclass(frozen=True)
class RegionOptions:
    """How the sphere around the object is found."""

    parallel: float = 1e-6  # squared sine between axes of view below which they count as parallel
    clear: float = 0.9  # largest radius, as a share of the distance to the nearest camera
    margin: float = 1.05  # radius over that of what the sphere encloses
    cells: int = 64  # of the grid of the visual hull, along each side
    one_in: int = 20  # views for each one that may miss a part of the hull
    few: int = 4  # views from which one may miss a part, if the hull is empty otherwise
    fewest: int = 8  # points, of the cloud or of the grid
    tail: float = 0.02  # share of the sparse points that is ignored on either side


REGION = RegionOptions()


def region_from_cameras(cameras: Sequence[Camera]) -> Similarity:
    """The sphere that the cameras look at.

    Its centre c has the least sum of squared distances to the axes of view, ``Σ (I − d dᵀ)(c − eye) = 0``. Each camera
    gives the radius of the sphere around c that just fits the longer side of its picture. The median of these is taken,
    but at most 0.9 of the distance from c to the nearest camera.

    Raises:
        ValueError: the axes of view are parallel, or half of the cameras have the centre behind them or out of view.
    """
    eyes = np.array([camera.eye.tolist() for camera in cameras]).reshape(-1, 3)
    axes = np.array([camera.forward.tolist() for camera in cameras]).reshape(-1, 3)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # (V, 3, 3) takes the part along the axis away
    middle = eyes.mean(axis=0) if len(eyes) else np.zeros(3)  # taken off first: map coordinates have many digits
    total = across.sum(axis=0)
    if not len(eyes) or np.linalg.eigvalsh(total)[0] < REGION.parallel * len(eyes):
        raise ValueError("cameras: their axes of view are parallel, so they meet nowhere")
    center = middle + np.linalg.solve(total, np.einsum("vij,vj->i", across, eyes - middle))
    radius = float(np.median([_view_radius(camera, center) for camera in cameras]))
    if radius == 0:
        raise ValueError("cameras: half of them do not see the point that is nearest to all axes of view")
    nearest = float(np.linalg.norm(eyes - center, axis=1).min())
    if nearest == 0:
        raise ValueError("cameras: one stands where the axes of view meet")
    return _sphere(center, min(radius, REGION.clear * nearest))


def region_from_points(points: Float64, cameras: Sequence[Camera]) -> Similarity:
    """The sphere around the sparse points ``(P, 3)`` that most cameras share.

    Points count if at least half of the cameras have them in view, and if they are nearer to the point that the cameras
    look at than the median camera: the rest is background. The centre is the middle of the box between the 2 % and 98 %
    quantiles along the axes. The radius is 1.05 times the 98 % quantile of the distances from it.

    Raises:
        ValueError: fewer than eight points are left, or all of them coincide.
    """
    views = np.zeros(len(points), np.int64)
    for camera in cameras:
        views += camera.in_view(points)[2]
    kept = points[views * 2 >= len(cameras)]
    try:
        focus = np.array(region_from_cameras(cameras).center)
    except ValueError:  # cameras side by side: there is no middle to be far from
        pass
    else:
        reach = np.median([np.linalg.norm(camera.eye.numpy() - focus) for camera in cameras])
        kept = kept[np.linalg.norm(kept - focus, axis=1) < reach]
    if len(kept) < REGION.fewest:
        raise ValueError(f"points: {len(kept)} of {len(points)} are where most cameras look; expected {REGION.fewest}")
    center = np.quantile(kept, (REGION.tail, 1 - REGION.tail), axis=0).mean(axis=0)
    radius = float(np.quantile(np.linalg.norm(kept - center, axis=1), 1 - REGION.tail))
    if radius == 0:
        raise ValueError("points: all of them coincide")
    return _sphere(center, REGION.margin * radius)


def region_from_masks(cameras: Sequence[Camera], masks: Sequence[NDArray[Any]]) -> Similarity:
    """The sphere around the visual hull: the points that are object in all views that have them in the picture.

    One view in twenty may differ, because one mask may lack a part; of four views or more one, if the hull is empty
    otherwise. At least half of the views must have a point in the picture. The hull is sampled on a grid of 64³, first
    in the cube around twice the sphere of `region_from_cameras`, then in the box of the points that are left. The
    sphere is centred on the box of the hull, and reaches a step of the grid and 5 % beyond it.

    Args:
        cameras: V of them.
        masks: V times ``(H, W)``, in [0, 1] or bool; object is more than a half.

    Raises:
        ValueError: the masks show no background, the hull is empty, or as for `region_from_cameras`.
    """
    solid = [mask > 0.5 for mask in masks]
    if all(mask.all() for mask in solid):
        raise ValueError("masks: show no background")
    start = region_from_cameras(cameras)
    low, high = (np.array(start.center) + side * 2 * start.scale for side in (-1, 1))
    may_differ = len(masks) // REGION.one_in
    try:
        hull, step = _hull(low, high, cameras, solid, may_differ)
    except ValueError:
        if len(masks) < REGION.few:
            raise
        may_differ += 1
        hull, step = _hull(low, high, cameras, solid, may_differ)
    low, high = hull.min(axis=0) - step, hull.max(axis=0) + step
    hull, step = _hull(low, high, cameras, solid, may_differ)
    center = (hull.min(axis=0) + hull.max(axis=0)) / 2
    reach = np.linalg.norm(np.abs(hull - center) + step, axis=1).max()
    return _sphere(center, REGION.margin * float(reach))


def _hull(
    low: Float64, high: Float64, cameras: Sequence[Camera], solid: Sequence[NDArray[np.bool_]], may_differ: int
) -> tuple[Float64, Float64]:
    """Points of the grid between two corners, object in all views but a few ``(N, 3)``, and its steps ``(3,)``."""
    lines = [np.linspace(low[axis], high[axis], REGION.cells) for axis in range(3)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    views, against = np.zeros((2, len(points)), np.int64)
    for camera, mask in zip(cameras, solid, strict=True):
        pixels, _, inside = camera.in_view(points)
        hit = np.zeros(len(points), np.bool_)
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        hit[inside] = mask[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
        views += inside
        against += inside & ~hit
        kept = against <= may_differ
        points, views, against = points[kept], views[kept], against[kept]
    hull = points[views * 2 >= len(cameras)]
    if len(hull) < REGION.fewest:
        raise ValueError("masks: no part of space is object in enough of them")
    return hull, (high - low) / (REGION.cells - 1)


def _view_radius(camera: Camera, center: Float64) -> float:
    """The radius of the sphere at that distance that fits the picture's longer side; 0 if the point is out of view."""
    fx, fy, cx, cy = camera.fx_fy_cx_cy
    x, y, z = (camera.world_from_camera[:3, :3].T @ (torch.from_numpy(center) - camera.eye)).tolist()
    across = _clearances(x, z, (-0.5 - cx) / fx, (camera.width - 0.5 - cx) / fx)
    down = _clearances(y, z, (-0.5 - cy) / fy, (camera.height - 0.5 - cy) / fy)
    return max(sum(across), sum(down)) / 2 if min(*across, *down) > 0 else 0.0


def _clearances(place: float, z: float, low: float, high: float) -> tuple[float, float]:
    """Distances of (place, z) from the sides of the wedge with slopes low and high and its edge at the origin."""
    return (place - low * z) / math.hypot(1, low), (high * z - place) / math.hypot(1, high)


def _sphere(center: Float64, radius: float) -> Similarity:
    return Similarity((float(center[0]), float(center[1]), float(center[2])), radius)
