"""Which part of a surface photographs have seen: what lies behind it is nobody's knowledge, and may be cut off."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.cameras import Camera
from ....datasets.views.pictures import shrink
from ....neural_fields import Field, sphere_trace
from .silhouettes import OBJECT

__all__ = ["SeenFrom", "seen_points"]

SeenFrom = tuple[Camera, NDArray[np.float32] | None]
"""A camera in unit-sphere coordinates, and the mask ``(H, W)`` of its picture, which says what is object."""

RAYS = 300_000  # traced, of all views together
MOST_PIXELS = 10_000  # of a view
PLACE = 1 / 32  # in radii of the region: places this far apart are told apart when views are counted, if pixels do
WITNESSES = 2  # views that must see a place: what one alone sees, it cannot measure
GRAZING = 2.0  # how much further apart than a pixel its neighbours' points may be, on a surface that is seen obliquely
TOLERANCE = 1e-3


@torch.no_grad()
def seen_points(field: Field, views: Sequence[SeenFrom]) -> tuple[Tensor, float]:
    """Points of the surface that two photographs see at least, and how far apart neighbours among them may be.

    Every view is traced in up to 10,000 pixels of what its mask calls object.

    Args:
        field: in unit-sphere coordinates.
        views: the photographs that it was trained on: cameras in the same coordinates, and masks if there are any.

    Returns:
        ``(N, 3)`` points in the unit sphere, on the CPU, and a length there.
    """
    pixels = max(1, min(RAYS // len(views), MOST_PIXELS))
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
        hits = sphere_trace(
            field, eye.to(rays).expand_as(rays), rays, tolerance=TOLERANCE, resolution=TOLERANCE, radius=1.0
        )
        found = hits.position[hits.mask].cpu().double()
        points.append(found)
        owners.append(torch.full((len(found),), number))
        pitches.append(hits.depth[hits.mask].cpu().double() / float(camera.intrinsics[0, 0]))
    every = torch.cat(points)
    if not len(every):
        return every, math.inf
    within = GRAZING * float(np.median(torch.cat(pitches)))
    cells = ((every + 1) / max(PLACE, within)).floor().long()
    across = 1 + int(cells.max())
    place = (cells[:, 0] * across + cells[:, 1]) * across + cells[:, 2]
    # A view counts once in a place, however many of its pixels see it.
    pairs = torch.unique(place * len(views) + torch.cat(owners))
    known, count = torch.unique(pairs // len(views), return_counts=True)
    witnessed = torch.isin(place, known[count >= min(WITNESSES, len(views))])
    return every[witnessed], within


def _coarse(camera: Camera, pixels: int) -> Camera:
    """A camera in about so many pixels; as it is, if it has no more."""
    share = min(1.0, math.sqrt(pixels / (camera.width * camera.height)))
    return camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))
