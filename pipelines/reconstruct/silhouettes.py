"""What masks say of points in space: the silhouettes that a visual hull is carved from, and which of them are wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from ...datasets.views.images import PosedImage
from ...neural_fields import Similarity

__all__ = ["OBJECT", "contradictions", "grid_in_ball", "how_turned", "named", "silhouettes"]

OBJECT = 0.5  # a pixel with a larger share of object counts as one
COARSE = 32  # cells along the grid on which silhouettes are compared
MAY_DIFFER = 0.25  # share of the views that may contradict a point which most of them take for object
# A view is odd that contradicts so much of what the others agree on; whatever shape was tried, none that was right
# came to more than 0.23, and none whose mask was inverted to less than 0.5.
ODD = 0.4
# Or one that alone cuts so much from what all others leave, and so many times as much as the next one does; of few
# views each cuts much, by right.
ALONE, OF_FEW, TIMES = 0.1, 2.0, 5.0
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
        mask = torch.from_numpy(view.mask > OBJECT).float()
        cut = bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())
        mask = nn.functional.max_pool2d(mask[None, None], 2 * reach + 1, stride=1, padding=reach)[0, 0] > 0
        pixels, depth = camera.project(points)
        column, row = pixels.round().long().unbind(dim=1)
        inside = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        # What a picture does not show is no object, unless its rim cuts the object.
        yield (
            inside if cut else depth > 0,
            inside & mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)],
        )


def contradictions(views: Sequence[PosedImage], similarity: Similarity) -> tuple[bool, list[PosedImage]]:
    """Whether masks are inverted, and the views whose silhouettes the others contradict.

    A view contradicts a point that it sees, and takes for background. Of the points that three quarters of the views
    take for object, a wrong view contradicts far more than a right one; and no right one alone cuts much from what all
    others leave. A wrong picture of a thing that looks much the same from there cannot be told by masks.

    Args:
        views: pictures, all with masks that are neither empty nor full.
        similarity: from world to unit-sphere coordinates.
    """
    if all(_looks_inverted(views)):
        return True, []
    points, _ = grid_in_ball(COARSE)
    told = list(silhouettes(views, similarity, points, 2 / COARSE))
    seen, objects = (torch.stack(parts) for parts in zip(*told, strict=True))
    against = seen & ~objects
    times, count = against.sum(dim=0), seen.sum(dim=0)
    agreed = (count >= max(1.0, MAY_DIFFER * len(views))) & (times <= MAY_DIFFER * count)
    shares = (against & agreed).sum(dim=1) / (seen & agreed).sum(dim=1).clamp(min=1)
    alone = (against & (times == 1)).sum(dim=1) / ((times == 0) & (count > 0)).sum().clamp(min=1)
    next_one = alone.sort().values[-2] if len(views) > 1 else torch.tensor(math.inf)
    odd = (shares > ODD) | ((alone > max(ALONE, OF_FEW / len(views))) & (alone > TIMES * next_one))
    return False, [view for view, is_odd in zip(views, odd.tolist(), strict=True) if is_odd]


def how_turned(views: Sequence[PosedImage], similarity: Similarity) -> str | None:
    """One of `TURNS`, if the pictures look so; None if they look right, or wrong in another way.

    The visual hull is behind all object in right silhouettes, and less so in those of mirrored pictures. It is carved
    anew from masks that are turned back, and if they fit it that much better, that is what is wrong. Of a thing and
    cameras that mirrored look the same nothing is said, nor need be.

    Args:
        views: pictures, all with masks that are neither empty nor full.
        similarity: from world to unit-sphere coordinates.
    """
    as_given = _without_hull(views, similarity)
    if as_given <= NO_HULL:
        return None
    turned = {said: _without_hull([_flipped(view, axes) for view in views], similarity) for said, axes in TURNS.items()}
    best = min(turned, key=lambda said: turned[said])
    return best if turned[best] < TURNED_BACK * as_given else None


def _flipped(view: PosedImage, axes: tuple[int, ...]) -> PosedImage:
    assert view.mask is not None
    return replace(view, mask=np.ascontiguousarray(np.flip(view.mask, axes)))


def _without_hull(views: Sequence[PosedImage], similarity: Similarity) -> float:
    """Share of the object's pixels with no visual hull behind them, to a cell of it; of the median view."""
    edge = 2 / COARSE
    points, _ = grid_in_ball(COARSE)
    seen, objects = (torch.stack(parts) for parts in zip(*silhouettes(views, similarity, points, edge), strict=True))
    count = seen.sum(dim=0)
    hull = points[(count >= max(1.0, MAY_DIFFER * len(views))) & ((seen & ~objects).sum(dim=0) <= SURE * count)]
    shares = []
    for view in views:
        assert view.mask is not None
        camera = view.camera.moved(similarity)
        reach = math.ceil(edge * float(camera.intrinsics[0, 0]) / float(camera.eye.norm().clamp(min=edge)))
        pixels, depth = camera.project(hull)
        column, row = pixels.round().long().unbind(dim=1)
        inside = (depth > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        there = torch.zeros(camera.height, camera.width)
        there[row[inside], column[inside]] = 1
        there = nn.functional.max_pool2d(there[None, None], 2 * reach + 1, stride=1, padding=reach)[0, 0] > 0
        mask = torch.from_numpy(view.mask > OBJECT)
        shares.append(float((mask & ~there).sum() / mask.sum().clamp(min=1)))
    return float(np.median(shares))


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
