"""Visibility of a surface in photographs: points that two of them see, and how many see given points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.cameras import Camera
from ....datasets.views.images import shrink
from ....neural_fields import Field, Mesh, sphere_trace
from ...render.rasterise import mesh_view
from ...render.studio import sees
from .silhouettes import OBJECT

__all__ = ["SeenFrom", "count_views", "seen_points"]

SeenFrom = tuple[Camera, NDArray[np.float32] | None]
"""A camera in unit-sphere coordinates, and the mask ``(H, W)`` of its picture, which says what is object."""


@torch.no_grad()
def seen_points(field: Field, views: Sequence[SeenFrom]) -> tuple[Tensor, float]:
    """Points of the surface that two photographs see at least, and how far apart neighbours among them may be.

    Every view is traced in up to 10,000 pixels of what its mask calls object, and all together in 300,000. Places are
    told apart that are 1/32 of a radius apart, or as far as neighbouring pixels on a surface that is seen obliquely.

    Args:
        field: in unit-sphere coordinates.
        views: the photographs that it was trained on: cameras in the same coordinates, and masks if there are any.

    Returns:
        ``(N, 3)`` points in the unit sphere, on the CPU, and a length there.
    """
    pixels = max(1, min(300_000 // len(views), 10_000))
    points: list[Tensor] = []
    owners: list[Tensor] = []
    pitches: list[Tensor] = []
    for number, (whole, mask) in enumerate(views):
        camera = _coarse(whole, pixels)
        eye, directions = camera.rays(device=field.like.device)
        asked = torch.ones(directions.shape[:2], dtype=torch.bool)
        if mask is not None:
            asked = torch.from_numpy(shrink(mask, camera.width, camera.height) > OBJECT)
        rays = directions[asked.to(directions.device)].to(field.like)
        eyes = eye.to(rays).expand_as(rays)
        hits = sphere_trace(field, eyes, rays, tolerance=1e-3, resolution=1e-3, radius=1.0)
        found = hits.position[hits.mask].cpu().double()
        points.append(found)
        owners.append(torch.full((len(found),), number))
        pitches.append(hits.depth[hits.mask].cpu().double() / float(camera.intrinsics[0, 0]))
    every = torch.cat(points)
    if not len(every):
        return every, math.inf
    within = 2 * float(np.median(torch.cat(pitches)))
    cells = ((every + 1) / max(1 / 32, within)).floor().long()
    across = 1 + int(cells.max())
    place = (cells[:, 0] * across + cells[:, 1]) * across + cells[:, 2]
    # A view counts once in a place, however many of its pixels see it.
    pairs = torch.unique(place * len(views) + torch.cat(owners))
    known, count = torch.unique(pairs // len(views), return_counts=True)
    # What one view alone sees, it cannot measure.
    return every[torch.isin(place, known[count >= min(2, len(views))])], within


def _coarse(camera: Camera, pixels: int) -> Camera:
    """A camera in about so many pixels; as it is, if it has no more."""
    share = min(1.0, math.sqrt(pixels / (camera.width * camera.height)))
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))


def count_views(
    cameras: Sequence[Camera],
    surface: Mesh,
    points: NDArray[np.float64],
    *,
    finest: int = 1024,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.int64]:
    """How many cameras ``(N,)`` see points ``(N, 3)`` of a surface: in their picture, with nothing before them.

    Masks do not count: a place that is in a picture is seen.

    Args:
        cameras: in the coordinates of the surface.
        surface: what there is to see, and to hide.
        points: of it.
        finest: pixels of the longer side, in which it is decided what hides what. Ten of them wide is the strip beyond
            a rim that may count as seen.
        progress: called with ``(done, total)`` after every camera.
    """
    counts = np.zeros(len(points), dtype=np.int64)
    for index, camera in enumerate(cameras):
        share = finest / max(camera.width, camera.height)
        large = camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        counts += sees(large, mesh_view(surface, large), points)
        if progress is not None:
            progress(index + 1, len(cameras))
    return counts
