"""Whether depth maps can be right: where their readings end, and whether other views see through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ....datasets.views.formats.shots import DepthMap
from ....datasets.views.images import PosedImage, PosedImages
from ..data.measured import UNITS, said_outside

__all__ = ["DepthCheck", "check_depths"]

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class DepthCheck:
    """What is known of the depth maps of a data set.

    Attributes:
        maps: how many views have one.
        inside: share of the readings that end in the region of interest; None where their scale is not known.
        seen_through: share of the readings of the median view in whose place another view sees something further away;
            None where no two maps can be compared.
        warnings: one line each.
    """

    maps: int
    inside: float | None = None
    seen_through: float | None = None
    warnings: tuple[str, ...] = ()

    def in_words(self, views: int) -> str:
        """One line, for a data set of so many views."""
        words = [f"depth maps: {self.maps} of {views} photographs have one"]
        if self.inside is not None:
            words.append(f"{self.inside:.1%} of the readings end in the region")
        if self.seen_through is not None:
            words.append(f"other views see through {self.seen_through:.1%} of them")
        return "; ".join(words)

    def record(self) -> dict[str, Any]:
        """As numbers, for JSON."""
        return {"maps": self.maps, "share_inside": self.inside, "share_seen_through": self.seen_through}


def check_depths(images: PosedImages) -> DepthCheck | None:
    """Compare depth maps with the region and with each other; None if there are none.

    Maps of unknown scale and shift are only counted. A reading counts as seen through if it lies 1 % of its depth (the
    noise of sensors) and 2 % of the region's radius before what another view sees in its place.
    """
    maps = [view.depth for view in images.views if view.depth is not None]
    views = [view for view in images.views if view.depth is not None and view.depth.kind == "metric"]
    metric = [view.depth for view in views if view.depth is not None]
    if not metric:
        return DepthCheck(len(maps)) if maps else None
    places = [_places(depth) for depth in metric]
    if not sum(map(len, places)):
        return DepthCheck(len(maps), warnings=("no depth map has a reading",))
    inside = float((np.linalg.norm(images.similarity.to_unit(np.concatenate(places)), axis=1) < 1).mean())
    smallest = list(map(_smallest, views))
    margin = 0.02 * images.similarity.scale
    shares = [_seen_through(index, places[index], metric, smallest, margin) for index in range(len(metric))]
    known = [share for share in shares if share is not None]
    usual = float(np.median(known)) if known else None
    warnings = []
    if outside := said_outside(inside):
        warnings.append(outside)
    elif usual is not None and usual > 0.08:  # exact maps and those of sensors have hardly any
        warnings.append(
            f"the depth maps contradict each other: of the median one others see through {usual:.0%} of the readings; "
            f"are they of these photographs, and along the axis of view? If in other units, {UNITS}"
        )
    return DepthCheck(len(maps), inside, usual, tuple(warnings))


def _smallest(view: PosedImage) -> NDArray[np.float32]:
    """Smallest depth of each pixel and the eight around it ``(H, W)``: inf in background, -1 where one has none."""
    assert view.depth is not None
    numbers = view.depth.numbers
    if view.mask is not None and view.mask.shape == numbers.shape:
        numbers = np.where(view.mask == 0, np.float32(np.inf), numbers)
    known = np.nan_to_num(numbers, nan=-1.0, posinf=np.inf).astype(np.float32)
    return np.asarray(cv2.erode(known, np.ones((3, 3), np.uint8)), np.float32)


def _places(depth: DepthMap) -> Float64:
    """World coordinates ``(N, 3)`` of up to 2,000 readings of a map, evenly over it."""
    rows = np.flatnonzero(np.isfinite(depth.numbers))
    rows = rows[np.linspace(0, len(rows) - 1, min(2000, len(rows))).astype(np.int64)] if len(rows) else rows
    lines = depth.camera.sight_lines().numpy().reshape(-1, 3)[rows]
    pose = depth.camera.world_from_camera.numpy()
    return (lines * depth.numbers.reshape(-1)[rows, None].astype(np.float64)) @ pose[:3, :3].T + pose[:3, 3]


def _seen_through(
    index: int, places: Float64, maps: Sequence[DepthMap], smallest: Sequence[NDArray[np.float32]], margin: float
) -> float | None:
    """Share of one map's readings in whose place four others see something further away; None of fewer than 50."""
    others = np.delete(np.arange(len(maps)), index)
    told = through = 0
    for partner in others[np.linspace(0, len(others) - 1, min(4, len(others))).astype(np.int64)]:
        pixels, z, framed = maps[partner].camera.in_view(places)
        column, row = np.rint(pixels[framed]).astype(np.int64).T
        there = smallest[partner][row, column]
        known = there > 0
        told += int(known.sum())
        through += int((known & (z[framed] < 0.99 * there - margin)).sum())
    return through / told if told >= 50 else None
