"""What masks say of points in space: the silhouettes that a visual hull is carved from, and which of them are wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.views.images import PosedImage
from ...neural_fields import Similarity

__all__ = [
    "OBJECT",
    "contradictions",
    "grid_in_ball",
    "holes",
    "how_turned",
    "named",
    "outliers",
    "silhouettes",
    "trusted",
]

OBJECT = 0.5  # a pixel with a larger share of object counts as one
COARSE = 32  # cells along the grid on which silhouettes are compared
MAY_DIFFER = 0.25  # share of the views that may contradict a point which most of them take for object
# A view is odd that contradicts so much of what the others agree on; whatever shape was tried, none that was right
# came to more than 0.23, and none whose mask was inverted to less than 0.5.
ODD = 0.4
# Or one that alone cuts so much from what all others leave, and so many times as much as the next one does; of few
# views each cuts much, by right.
ALONE, OF_FEW, TIMES = 0.1, 2.0, 5.0
# Or one with so much of its object where the others see none, and so many times (TIMES) as much as most have. Right
# ones have 0.018 at most, of what is thinner than a cell, or lies outside the region or the others' pictures.
SPILT, MOST = 0.03, 0.8
# A view is not trusted that alone cuts more than this of what all others leave. Of right ones, three of three hundred
# do; of masks with a hole a sixth of the picture wide, all. Of few views each may cut much, by right.
LONE, FEW = 0.02, 20
MOST_ODD = 0.1  # share of the views that may be left out because the others contradict them
# Pictures are turned if more than this share of their object is where no hull is (of right ones, whatever was tried,
# 0.001 at most), and a quarter of that once they are turned back.
NO_HULL, TURNED_BACK = 0.005, 0.25
SURE = 0.05  # share of the views that may contradict a point of the hull
TURNS = {  # what is said, and which of a mask's axes are reversed
    "mirrored, left to right": (1,),
    "mirrored, top to bottom": (0,),
    "upside down": (0, 1),
}
# Masks are inverted if the border of the usual picture is object, and its middle is not.
BORDER, MIDDLE = 0.5, 0.25
NAMED = 3  # views that a warning names


def grid_in_ball(resolution: int) -> tuple[Tensor, Tensor]:
    """Vertices of the unit ball ``(N, 3)`` float64, of a grid over [−1, 1]³, and their places in it ``(N,)``."""
    axis = torch.linspace(-1, 1, resolution + 1, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    places = (points.square().sum(dim=1) <= 1).nonzero()[:, 0]
    return points[places], places


def silhouettes(
    views: Sequence[PosedImage], similarity: Similarity, points: Tensor, edge: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """For each view, which points it sees and which of them are object ``(N,)``, each.

    Args:
        views: pictures with masks.
        similarity: from world to unit-sphere coordinates.
        points: ``(N, 3)`` float64 in the latter.
        edge: a point is object where there is object within half of it.
    """
    for view in views:
        assert view.mask is not None
        camera = view.camera.moved(similarity)
        reach = math.ceil(0.5 * edge * float(camera.intrinsics[0, 0]) / float(camera.eye.norm().clamp(min=edge)))
        mask = view.mask > OBJECT
        cut = bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())
        mask = torch.from_numpy(_widened(mask, reach))
        pixels, depth = camera.project(points)
        column, row = pixels.round().long().unbind(dim=1)
        inside = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        # What a picture does not show is no object, unless its rim cuts the object.
        yield (
            inside if cut else depth > 0,
            inside & mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)],
        )


def _widened(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """What is within so many pixels of something, in either direction ``(H, W)``."""
    window = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), window)) > 0


def contradictions(views: Sequence[PosedImage], similarity: Similarity) -> tuple[bool, list[PosedImage]]:
    """Whether masks are inverted, and the views whose silhouettes the others contradict.

    A view contradicts a point that it sees, and takes for background. Of the points that three quarters of the views
    take for object, a wrong view contradicts far more than a right one; and no right one alone cuts much from what all
    others leave. Nor is its object anywhere but where the others leave something. A wrong picture of a thing that looks
    much the same from there cannot be told by masks.

    Args:
        views: pictures, all with masks that are neither empty nor full.
        similarity: from world to unit-sphere coordinates.
    """
    if all(_looks_inverted(views)):
        return True, []
    seen, against = _told(views, similarity)
    odd = _wrong(views, similarity, seen, against) | _cuts_most(seen, against)
    return False, [view for view, is_odd in zip(views, odd.tolist(), strict=True) if is_odd]


def outliers(views: Sequence[PosedImage], similarity: Similarity) -> list[PosedImage]:
    """Views that teach nothing right, if they are a tenth of all at most.

    Of more than that nobody knows whether they are wrong, or the others are. Those of `contradictions` that only cut
    much alone are not among them: so does a single look from above, by right.

    Args:
        views: pictures, all with masks.
        similarity: from world to unit-sphere coordinates.
    """
    if all(_looks_inverted(views)):
        return []
    wrong = _wrong(views, similarity, *_told(views, similarity))
    odd = [view for view, is_wrong in zip(views, wrong.tolist(), strict=True) if is_wrong]
    return odd if len(odd) <= MOST_ODD * len(views) else []


def trusted(views: Sequence[PosedImage], similarity: Similarity) -> Sequence[PosedImage]:
    """Views that may carve a visual hull: all but those that contradict the others, or cut much that no other does.

    Args:
        views: pictures, all with masks.
        similarity: from world to unit-sphere coordinates.
    """
    if all(_looks_inverted(views)):
        return views
    seen, against = _told(views, similarity)
    wrong = _wrong(views, similarity, seen, against) | _cuts_most(seen, against) | _cuts_much(seen, against)
    return [view for view, is_wrong in zip(views, wrong.tolist(), strict=True) if not is_wrong]


def holes(views: Sequence[PosedImage], similarity: Similarity) -> dict[int, NDArray[np.bool_]]:
    """Holes in masks: background with object all around it, where all other views take for object what is behind.

    A hole in a mask cuts a tunnel through the visual hull that no other silhouette does. So does a gap through which
    only one camera looks, but of many views that one is small, and views that alone cut little are not asked. Nor are
    those that are wrong in everything (`outliers`), nor any where there are few.

    Args:
        views: pictures, all with masks.
        similarity: from world to unit-sphere coordinates.

    Returns:
        By the number of the view, for those that have any, pixels ``(H, W)``.
    """
    if all(_looks_inverted(views)):
        return {}
    seen, against = _told(views, similarity)
    alone = against & (against.sum(dim=0) == 1)
    points, found = grid_in_ball(COARSE)[0], {}
    torn = _cuts_much(seen, against) & ~_wrong(views, similarity, seen, against)
    for index in torn.nonzero()[:, 0].tolist():
        mask = views[index].mask
        assert mask is not None
        behind = _shadow(views[index], similarity, points[alone[index]], 2 / COARSE)
        hole = behind & _enclosed(mask <= OBJECT)
        if hole.any():
            found[index] = hole
    return found


def _enclosed(background: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The parts of it that reach no border of the picture ``(H, W)``."""
    labels = np.asarray(cv2.connectedComponents(background.astype(np.uint8), connectivity=4)[1])
    outer = np.unique(np.concatenate([*labels[[0, -1]], *labels[:, [0, -1]].T]))
    return background & ~np.isin(labels, outer)


def _told(views: Sequence[PosedImage], similarity: Similarity) -> tuple[Tensor, Tensor]:
    """Of each view, which points of a grid in the unit ball it sees, and which of them it contradicts ``(V, N)``."""
    points, _ = grid_in_ball(COARSE)
    told = list(silhouettes(views, similarity, points, 2 / COARSE))
    seen, objects = (torch.stack(parts) for parts in zip(*told, strict=True))
    return seen, seen & ~objects


def _lone_cuts(seen: Tensor, against: Tensor) -> Tensor:
    """What each view contradicts alone, as a share of what none does ``(V,)``."""
    times = against.sum(dim=0)
    return (against & (times == 1)).sum(dim=1) / ((times == 0) & seen.any(dim=0)).sum().clamp(min=1)


def _cuts_much(seen: Tensor, against: Tensor) -> Tensor:
    """Which views of many cut much that no other one does ``(V,)``."""
    return (_lone_cuts(seen, against) > LONE) & (len(seen) >= FEW)


def _cuts_most(seen: Tensor, against: Tensor) -> Tensor:
    """Which one cuts far more than all others do alone ``(V,)``."""
    alone = _lone_cuts(seen, against)
    next_one = alone.sort().values[-2] if len(seen) > 1 else torch.tensor(math.inf)
    return (alone > max(ALONE, OF_FEW / len(seen))) & (alone > TIMES * next_one)


def _wrong(views: Sequence[PosedImage], similarity: Similarity, seen: Tensor, against: Tensor) -> Tensor:
    """Which views contradict most of what the others agree on, or have object where they leave none ``(V,)``."""
    times, count = against.sum(dim=0), seen.sum(dim=0)
    agreed = (count >= max(1.0, MAY_DIFFER * len(views))) & (times <= MAY_DIFFER * count)
    shares = (against & agreed).sum(dim=1) / (seen & agreed).sum(dim=1).clamp(min=1)
    # One wrong view of few may not take the hull from the others.
    spilt = _without_hull(views, similarity, seen, against, (SURE * count).clamp(min=1))
    spills = (spilt > SPILT) & (spilt > TIMES * np.quantile(spilt, MOST))
    return (shares > ODD) | torch.from_numpy(spills)


def how_turned(views: Sequence[PosedImage], similarity: Similarity) -> str | None:
    """One of `TURNS`, if the pictures look so; None if they look right, or wrong in another way.

    The visual hull is behind all object in right silhouettes, and less so in those of mirrored pictures. It is carved
    anew from masks that are turned back, and if they fit it that much better, that is what is wrong. Of a thing and
    cameras that mirrored look the same nothing is said, nor need be.

    Args:
        views: pictures, all with masks that are neither empty nor full.
        similarity: from world to unit-sphere coordinates.
    """
    as_given = _usually_without(views, similarity)
    if as_given <= NO_HULL:
        return None
    flipped = {said: [_flipped(view, axes) for view in views] for said, axes in TURNS.items()}
    turned = {said: _usually_without(some, similarity) for said, some in flipped.items()}
    best = min(turned, key=lambda said: turned[said])
    return best if turned[best] < TURNED_BACK * as_given else None


def _flipped(view: PosedImage, axes: tuple[int, ...]) -> PosedImage:
    assert view.mask is not None
    return replace(view, mask=np.ascontiguousarray(np.flip(view.mask, axes)))


def _usually_without(views: Sequence[PosedImage], similarity: Similarity) -> float:
    """Share of the object's pixels with no visual hull behind them, to a cell of it; of the median view."""
    seen, against = _told(views, similarity)
    return float(np.median(_without_hull(views, similarity, seen, against, SURE * seen.sum(dim=0))))


def _without_hull(
    views: Sequence[PosedImage], similarity: Similarity, seen: Tensor, against: Tensor, may_differ: Tensor
) -> NDArray[np.float64]:
    """Of each view, the share of the object's pixels with no visual hull behind them, to a cell of it ``(V,)``.

    The hull is of the points ``(N,)`` that no more views contradict than ``may_differ``.
    """
    hull = (seen.sum(dim=0) >= max(1.0, MAY_DIFFER * len(views))) & (against.sum(dim=0) <= may_differ)
    points, shares = grid_in_ball(COARSE)[0][hull], []
    for view in views:
        assert view.mask is not None
        mask = view.mask > OBJECT
        shares.append((mask & ~_shadow(view, similarity, points, 2 / COARSE)).sum() / max(mask.sum(), 1))
    return np.array(shares)


def _shadow(view: PosedImage, similarity: Similarity, points: Tensor, edge: float) -> NDArray[np.bool_]:
    """Where a view sees points ``(N, 3)``, and all within a cell of them ``(H, W)``."""
    camera = view.camera.moved(similarity)
    reach = math.ceil(edge * float(camera.intrinsics[0, 0]) / float(camera.eye.norm().clamp(min=edge)))
    pixels, depth = camera.project(points)
    column, row = pixels.round().long().unbind(dim=1)
    inside = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    there = np.zeros((camera.height, camera.width), dtype=bool)
    there[row[inside].numpy(), column[inside].numpy()] = True
    return _widened(there, reach)


def _looks_inverted(views: Sequence[PosedImage]) -> tuple[bool, bool]:
    """Whether the border of the usual mask is object, and whether its middle is background."""
    borders, middles = [], []
    for view in views:
        assert view.mask is not None
        height, width = view.mask.shape
        borders.append(np.concatenate([*view.mask[[0, -1]], *view.mask[:, [0, -1]].T]).mean())
        middles.append(view.mask[height // 3 : -(height // 3) or None, width // 3 : -(width // 3) or None].mean())
    return bool(np.median(borders) > BORDER), bool(np.median(middles) < MIDDLE * np.median(borders))


def named(names: Sequence[str]) -> str:
    """The first of the views that a warning is about, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
