"""What masks say of points in space: the silhouettes that a visual hull is carved from, and which of them are wrong."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.views.images import PosedImage
from ....neural_fields import Similarity

__all__ = ["OBJECT", "Agreement", "grid_in_ball", "named", "silhouettes"]

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
        camera = view.camera.moved(similarity)
        reach = math.ceil(0.5 * edge * float(camera.intrinsics[0, 0]) / float(camera.eye.norm().clamp(min=edge)))
        mask = _object_in(view)
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


@dataclass(frozen=True, eq=False)
class Agreement:
    """What silhouettes say of the same points, and which of them the others contradict.

    A view contradicts a point that it sees, and takes for background. Of the points that three quarters of the views
    take for object, a wrong view contradicts far more than a right one; and no right one of many alone cuts much from
    what all others leave. Nor is its object anywhere but where the others leave something. A wrong picture of a thing
    that looks much the same from there cannot be told by masks.

    Attributes:
        views: pictures, all with masks.
        similarity: from world to unit-sphere coordinates.
        seen: which points of a grid in the unit ball each view sees ``(V, N)``.
        against: which of them it contradicts ``(V, N)``.
    """

    views: Sequence[PosedImage]
    similarity: Similarity
    seen: Tensor
    against: Tensor

    @classmethod
    def of(cls, views: Sequence[PosedImage], similarity: Similarity) -> Agreement:
        """Ask each view for each point of the grid."""
        told = list(silhouettes(views, similarity, grid_in_ball(COARSE)[0], 2 / COARSE))
        seen, objects = (torch.stack(parts) for parts in zip(*told, strict=True))
        return cls(views, similarity, seen, seen & ~objects)

    def without(self, some: Sequence[PosedImage]) -> Agreement:
        """That of the other views."""
        if not some:
            return self
        left_out = {id(view) for view in some}
        rows = [row for row, view in enumerate(self.views) if id(view) not in left_out]
        views = [self.views[row] for row in rows]
        return Agreement(views, self.similarity, self.seen[rows], self.against[rows])

    def contradictions(self) -> tuple[bool, list[PosedImage]]:
        """Whether the masks are inverted, and if they are not, the views that the others contradict."""
        return self.is_inverted, self._those(self._wrong | self._cuts_most)

    def outliers(self) -> list[PosedImage]:
        """Views that teach nothing right, if they are a tenth of all at most.

        Of more than that nobody knows whether they are wrong, or the others are. Those of `contradictions` that only
        cut much alone are not among them: so does a single look from above, by right.
        """
        odd = self._those(self._wrong)
        return odd if len(odd) <= MOST_ODD * len(self.views) else []

    def trusted(self) -> Sequence[PosedImage]:
        """Views that may carve a visual hull: all but those of `contradictions`, and those that alone cut much."""
        return self.without(self._those(self._wrong | self._cuts_most | self._cuts_much)).views

    def holes(self) -> dict[int, NDArray[np.bool_]]:
        """Holes in masks: background with object all around it, where all other views take for object what is behind.

        A hole in a mask cuts a tunnel through the visual hull that no other silhouette does. So does a gap through
        which only one camera looks, but of many views that one is small, and views that alone cut little are not
        asked. Nor are those that are wrong in everything (`outliers`), nor any where there are few.

        Returns:
            By the number of the view, for those that have any, pixels ``(H, W)``.
        """
        alone = self.against & (self.against.sum(dim=0) == 1)
        points, found = grid_in_ball(COARSE)[0], {}
        torn = self._cuts_much & ~self._wrong & (not self.is_inverted)
        for index in torn.nonzero()[:, 0].tolist():
            view = self.views[index]
            behind = _shadow(view, self.similarity, points[alone[index]], 2 / COARSE)
            hole = behind & _enclosed(~_object_in(view))
            if hole.any():
                found[index] = hole
        return found

    def how_turned(self) -> str | None:
        """One of `TURNS`, if the pictures look so; None if they look right, or wrong in another way.

        The visual hull is behind all object in right silhouettes, and less so in those of mirrored pictures. It is
        carved anew from masks that are turned back, and if they fit it that much better, that is what is wrong. Of a
        thing and cameras that mirrored look the same nothing is said, nor need be.
        """
        as_given = self._usually_without_hull()
        if as_given <= NO_HULL:
            return None
        flipped = {said: [_flipped(view, axes) for view in self.views] for said, axes in TURNS.items()}
        turned = {said: Agreement.of(views, self.similarity)._usually_without_hull() for said, views in flipped.items()}
        best = min(turned, key=lambda said: turned[said])
        return best if turned[best] < TURNED_BACK * as_given else None

    @cached_property
    def is_inverted(self) -> bool:
        """Whether the border of the usual mask is object, and its middle is background."""
        borders, middles = [], []
        for view in self.views:
            mask = _mask(view)
            height, width = mask.shape
            borders.append(np.concatenate([*mask[[0, -1]], *mask[:, [0, -1]].T]).mean())
            middles.append(mask[height // 3 : -(height // 3) or None, width // 3 : -(width // 3) or None].mean())
        border = np.median(borders)
        return bool(border > BORDER and np.median(middles) < MIDDLE * border)

    @cached_property
    def _wrong(self) -> Tensor:
        """Which contradict most of what the others agree on, or have object where they leave none ``(V,)``."""
        times, count = self.against.sum(dim=0), self.seen.sum(dim=0)
        agreed = self._seen_by_enough & (times <= MAY_DIFFER * count)
        shares = (self.against & agreed).sum(dim=1) / (self.seen & agreed).sum(dim=1).clamp(min=1)
        # One wrong view of few may not take the hull from the others.
        spilt = self._without_hull((SURE * count).clamp(min=1))
        spills = (spilt > SPILT) & (spilt > TIMES * np.quantile(spilt, MOST))
        return (shares > ODD) | torch.from_numpy(spills)

    @cached_property
    def _lone_cuts(self) -> Tensor:
        """What each view contradicts alone, as a share of what none does ``(V,)``."""
        times = self.against.sum(dim=0)
        return (self.against & (times == 1)).sum(dim=1) / ((times == 0) & self.seen.any(dim=0)).sum().clamp(min=1)

    @property
    def _cuts_much(self) -> Tensor:
        """Which of many cut much that no other one does ``(V,)``."""
        return (self._lone_cuts > LONE) & (len(self.views) >= FEW)

    @property
    def _cuts_most(self) -> Tensor:
        """Which one cuts far more than all others do alone ``(V,)``."""
        alone, count = self._lone_cuts, len(self.views)
        next_one = alone.sort().values[-2] if count > 1 else torch.tensor(math.inf)
        return (alone > max(ALONE, OF_FEW / count)) & (alone > TIMES * next_one)

    @property
    def _seen_by_enough(self) -> Tensor:
        return self.seen.sum(dim=0) >= max(1.0, MAY_DIFFER * len(self.views))

    def _those(self, which: Tensor) -> list[PosedImage]:
        """The views that are meant; none where all masks are inverted, which contradict each other by right."""
        if self.is_inverted:
            return []
        return [view for view, is_meant in zip(self.views, which.tolist(), strict=True) if is_meant]

    def _usually_without_hull(self) -> float:
        return float(np.median(self._without_hull(SURE * self.seen.sum(dim=0))))

    def _without_hull(self, may_differ: Tensor) -> NDArray[np.float64]:
        """Of each view, the share of the object's pixels with no visual hull behind them, to a cell of it ``(V,)``.

        The hull is of the points ``(N,)`` that no more views contradict than ``may_differ``.
        """
        hull = grid_in_ball(COARSE)[0][self._seen_by_enough & (self.against.sum(dim=0) <= may_differ)]
        shares = []
        for view in self.views:
            mask = _object_in(view)
            bare = mask & ~_shadow(view, self.similarity, hull, 2 / COARSE)
            shares.append(bare.sum() / max(mask.sum(), 1))
        return np.array(shares)


def _mask(view: PosedImage) -> NDArray[np.float32]:
    assert view.mask is not None
    return view.mask


def _object_in(view: PosedImage) -> NDArray[np.bool_]:
    return _mask(view) > OBJECT


def _enclosed(background: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The parts of it that reach no border of the picture ``(H, W)``."""
    labels = np.asarray(cv2.connectedComponents(background.astype(np.uint8), connectivity=4)[1])
    outer = np.unique(np.concatenate([*labels[[0, -1]], *labels[:, [0, -1]].T]))
    return background & ~np.isin(labels, outer)


def _flipped(view: PosedImage, axes: tuple[int, ...]) -> PosedImage:
    return replace(view, mask=np.ascontiguousarray(np.flip(_mask(view), axes)))


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


def named(names: Sequence[str]) -> str:
    """The first of the views that a warning is about, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
