"""Whether depth maps can be right: where their readings end, and whether other views see through them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....datasets.views.formats.depth_maps import DepthMap
from ....datasets.views.images import PosedImage, PosedImages
from ..data.measured import UNITS, said_outside
from ..data.silhouettes import named

__all__ = ["DepthCheck", "check_depths"]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

READINGS = 2000  # of each map that are looked at
PARTNERS = 4  # views that each is held against
# How far a reading lies before what another view sees there, if that contradicts it: in radii of the region, and as a
# share of the depth, which is what sensors are off by.
NEARER, NOISE = 0.02, 0.01
CONTRADICTED = 0.08  # share of the readings of the median view that others see through
ODD, TIMES = 0.15, 5.0  # the same share of one view that is named, and how many times that of the median one
BACKGROUND = 0.01  # of a mask, at most
FEWEST = 50  # readings that another view can tell something of


@dataclass(frozen=True)
class DepthCheck:
    """What is known of the depth maps of a data set.

    Attributes:
        maps: how many views have one.
        inside: share of the readings that end in the region of interest; None where their scale is not known.
        seen_through: share of the readings of the median view in whose place another view sees something further away;
            None where no two maps can be held against each other.
        warnings: one line each.
    """

    maps: int
    inside: float | None
    seen_through: float | None
    warnings: tuple[str, ...]

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
    """Hold depth maps against the region and against each other; None if there are none.

    Maps of unknown scale and shift are counted alone.
    """
    maps = [view for view in images.views if view.depth is not None]
    if not maps:
        return None
    metric = [view for view in maps if view.depth is not None and view.depth.kind == "metric"]
    places = [_places(view.depth) for view in metric if view.depth is not None]
    if not sum(map(len, places)):
        return DepthCheck(len(maps), None, None, () if not metric else ("no depth map has a reading",))
    ends = images.similarity.to_unit(np.concatenate(places))
    inside = float((np.linalg.norm(ends, axis=1) < 1).mean())
    nearer = NEARER * images.similarity.scale
    shares = np.array([_seen_through(index, places[index], metric, nearer) for index in range(len(metric))])
    known = np.isfinite(shares)
    if not known.any():
        return DepthCheck(len(maps), inside, None, tuple(_warnings(metric, shares, 0.0, inside)))
    usual = float(np.median(shares[known]))
    return DepthCheck(len(maps), inside, usual, tuple(_warnings(metric, shares, usual, inside)))


def _places(depth: DepthMap) -> Float64:
    """World coordinates ``(N, 3)`` of readings of a map, evenly over it."""
    rows = np.flatnonzero(np.isfinite(depth.numbers))
    rows = rows[np.linspace(0, len(rows) - 1, min(READINGS, len(rows))).astype(np.int64)] if len(rows) else rows
    lines = depth.camera.sight_lines().numpy().reshape(-1, 3)[rows]
    pose = depth.camera.world_from_camera.numpy()
    return (lines * depth.numbers.reshape(-1)[rows, None].astype(np.float64)) @ pose[:3, :3].T + pose[:3, 3]


def _seen_through(index: int, places: Float64, views: Sequence[PosedImage], nearer: float) -> float:
    """Share of the readings of one view in whose place the others see something further away; NaN if none can tell."""
    others = np.delete(np.arange(len(views)), index)
    told = through = 0
    for partner in others[np.linspace(0, len(others) - 1, min(PARTNERS, len(others))).astype(np.int64)]:
        z, known = _known(places, views[partner])
        told += int(np.isfinite(z).sum())
        through += int((z < (1 - NOISE) * known - nearer).sum())
    return through / told if told >= FEWEST else np.nan


def _known(places: Float64, view: PosedImage) -> tuple[Float64, Float64]:
    """Depths ``(K,)`` of the places that a view can tell something of, and how far it sees there ``(K,)``.

    Of its pixel and the eight around it the smallest depth counts, and none where one of them has none, as at rims;
    where all of them are background, it sees through.
    """
    assert view.depth is not None
    pixels, z, framed = view.depth.camera.in_view(places)
    column, row = np.rint(pixels[framed]).astype(np.int64).T
    there, z = _around(view.depth.numbers, row, column).astype(np.float64).min(axis=0), z[framed]
    if view.mask is not None:
        pixels, _, inside = view.camera.in_view(places[framed])
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        background = _around(view.mask, row, column).max(axis=0) < BACKGROUND
        there[np.flatnonzero(inside)[background]] = np.inf
    known = ~np.isnan(there)
    return z[known], there[known]


def _around(image: NDArray[np.float32], row: Int64, column: Int64) -> NDArray[np.float32]:
    """The numbers ``(9, K)`` of an image in pixels ``(K,)`` and those around them; at its border those repeat."""
    height, width = image.shape
    down, across = (step.reshape(-1, 1) for step in np.mgrid[-1:2, -1:2])
    return image[(row + down).clip(0, height - 1), (column + across).clip(0, width - 1)]


def _warnings(views: Sequence[PosedImage], shares: Float64, usual: float, inside: float) -> Iterator[str]:
    if outside := said_outside(inside):
        yield outside
    elif usual > CONTRADICTED:
        yield (
            f"the depth maps contradict each other: of the median one others see through {usual:.0%} of the readings; "
            f"are they of these photographs, and along the axis of view? If in other units, {UNITS}"
        )
    elif odd := [view.name for view, share in zip(views, shares, strict=True) if share > max(ODD, TIMES * usual)]:
        yield (
            f"{len(odd)} of {len(views)} depth maps contradict the others: {named(odd)}; are they of those photographs?"
        )
