"""Silhouettes: which points are object in which mask, and masks that contradict the others."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.views.images import PosedImage
from ...neural_fields import Similarity

OBJECT = 0.5  # a pixel with a larger share of object counts as one


@dataclass(frozen=True)
class Limits:
    """When a silhouette is wrong; right ones of the synthetic scenes keep a third or more below each limit."""

    cells: int = 32  # along the grid on which silhouettes are compared
    agreed: float = 0.25  # share of the views that may contradict a point on which the views still agree
    # a view is wrong that contradicts more than this share of the points on which the others agree, or has more
    # than this share of its object outside of the visual hull
    wrong: float = 0.4
    most_wrong: float = 0.1  # share of the views that may be left out as wrong; of more, nothing says which ones are
    lone: float = 0.02  # a mask has a hole if it alone contradicts more than this share of the visual hull
    few: int = 20  # views below which none is said to have a hole: of few, each may carve much
    bare: float = 0.005  # share of the object, in the median view, that may lie outside of the visual hull
    sure: float = 0.05  # share of the views that may contradict a point of that hull


def grid_in_ball(resolution: int) -> tuple[Tensor, Tensor]:
    """Vertices of the unit ball ``(N, 3)`` float64, of a grid over [−1, 1]³, and their places in it ``(N,)``."""
    axis = torch.linspace(-1, 1, resolution + 1, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    places = (points.square().sum(dim=1) <= 1).nonzero()[:, 0]
    return points[places], places


def silhouettes(
    views: Sequence[PosedImage], similarity: Similarity, points: Tensor, edge: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """For each view, which points ``(N, 3)`` it sees, and which have object within half an ``edge``, ``(N,)`` each."""
    for view in views:
        camera, mask = view.camera.moved(similarity), _object_in(view)
        cut = bool(_border(mask).any())
        mask = _widened(mask, camera, 0.5 * edge, edge)
        pixels, depth, inside = camera.in_view(points.numpy())
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        objects = inside.copy()
        objects[inside] = mask[row, column]
        # What a picture does not show is no object, unless its rim cuts the object.
        yield torch.from_numpy(inside if cut else depth > 0), torch.from_numpy(objects)


def _widened(mask: NDArray[np.bool_], camera: Camera, length: float, nearest: float) -> NDArray[np.bool_]:
    """What is within a length, seen in the middle of the region, of something ``(H, W)``."""
    reach = math.ceil(length * float(camera.intrinsics[0, 0]) / float(camera.eye.norm().clamp(min=nearest)))
    window = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), window)) > 0


@dataclass(frozen=True, eq=False)
class Agreement:
    """What silhouettes say of the same points, and which of them the others contradict.

    A view contradicts a point that it sees and takes for background.
    """

    views: Sequence[PosedImage]  # pictures, all with masks
    similarity: Similarity  # from world to unit-sphere coordinates
    seen: Tensor  # (V, N) which points of a grid in the unit ball each view sees
    against: Tensor  # (V, N) which of them it contradicts
    limits: Limits = Limits()  # when a silhouette is wrong

    @classmethod
    def of(cls, views: Sequence[PosedImage], similarity: Similarity, limits: Limits | None = None) -> Agreement:
        """Compare views at the points of the grid."""
        limits = limits or Limits()
        told = list(silhouettes(views, similarity, grid_in_ball(limits.cells)[0], 2 / limits.cells))
        seen, objects = (torch.stack(parts) for parts in zip(*told, strict=True))
        return cls(views, similarity, seen, seen & ~objects, limits)

    def without(self, some: Sequence[PosedImage]) -> Agreement:
        """That of the other views."""
        if not some:
            return self
        left_out = {id(view) for view in some}
        rows = [row for row, view in enumerate(self.views) if id(view) not in left_out]
        views = [self.views[row] for row in rows]
        return Agreement(views, self.similarity, self.seen[rows], self.against[rows], self.limits)

    @cached_property
    def is_inverted(self) -> bool:
        """Whether the usual mask is object along its border, more than in the picture as a whole."""
        borders, wholes = zip(
            *((_border(mask).mean(), mask.mean()) for mask in map(_object_in, self.views)), strict=True
        )
        return bool(np.median(borders) > max(0.5, np.median(wholes)))

    def contradictions(self) -> list[PosedImage]:
        """Views that contradict much on which the others agree, or whose object lies mostly outside of the visual hull.

        None where all masks are inverted.
        """
        times, count = self.against.sum(dim=0), self.seen.sum(dim=0)
        agreed = self._seen_by_enough & (times <= self.limits.agreed * count)
        shares = (self.against & agreed).sum(dim=1) / (self.seen & agreed).sum(dim=1).clamp(min=1)
        wrong = (shares > self.limits.wrong) | (self._bare > self.limits.wrong)
        return [] if self.is_inverted else self._those(wrong)

    def outliers(self) -> list[PosedImage]:
        """`contradictions`, if they are a tenth of the views at most: nothing says which of more are right."""
        odd = self.contradictions()
        return odd if len(odd) <= self.limits.most_wrong * len(self.views) else []

    def trusted(self) -> Sequence[PosedImage]:
        """Views that may carve a visual hull: neither `contradictions` nor those with `holes`."""
        rest = self.without(self.contradictions())
        return rest.without(rest._those(rest._cuts_alone)).views

    def holes(self) -> dict[int, NDArray[np.bool_]]:
        """Holes ``(H, W)`` in masks, by the view's number: enclosed background where all others see object."""
        alone = self.against & (self.against.sum(dim=0) == 1)
        points, found = grid_in_ball(self.limits.cells)[0], {}
        for index in self._cuts_alone.nonzero()[:, 0].tolist():
            hole = self._shadow(self.views[index], points[alone[index]]) & _enclosed(~_object_in(self.views[index]))
            if hole.any():
                found[index] = hole
        return found

    def misfit(self) -> float:
        """Share of the object's pixels with no visual hull behind them, in the median view.

        It is 0 to a cell if poses and pictures belong together, and not if the pictures are mirrored or turned.
        """
        return float(self._bare.median())

    @cached_property
    def _bare(self) -> Tensor:
        """Share of the object's pixels with no visual hull behind them, to a cell of it ``(V,)``."""
        most = (self.limits.sure * self.seen.sum(dim=0)).clamp(min=1)  # one wrong view of few may not take the hull
        agreed = self._seen_by_enough & (self.against.sum(dim=0) <= most)
        hull, shares = grid_in_ball(self.limits.cells)[0][agreed], []
        for view in self.views:
            mask = _object_in(view)
            shares.append(float((mask & ~self._shadow(view, hull)).sum() / max(mask.sum(), 1)))
        return torch.tensor(shares)

    @property
    def _cuts_alone(self) -> Tensor:
        """Which of many views contradict much that no other one does ``(V,)``."""
        times = self.against.sum(dim=0)
        hull = ((times == 0) & self.seen.any(dim=0)).sum().clamp(min=1)
        share = (self.against & (times == 1)).sum(dim=1) / hull
        return (share > self.limits.lone) & (len(self.views) >= self.limits.few) & (not self.is_inverted)

    @property
    def _seen_by_enough(self) -> Tensor:
        return self.seen.sum(dim=0) >= max(1.0, self.limits.agreed * len(self.views))

    def _those(self, which: Tensor) -> list[PosedImage]:
        return [view for view, is_meant in zip(self.views, which.tolist(), strict=True) if is_meant]

    def _shadow(self, view: PosedImage, points: Tensor) -> NDArray[np.bool_]:
        """Where a view sees points ``(N, 3)``, and all within a cell of them ``(H, W)``."""
        camera, edge = view.camera.moved(self.similarity), 2 / self.limits.cells
        pixels, _, inside = camera.in_view(points.numpy())
        column, row = np.rint(pixels[inside]).astype(np.int64).T
        there = np.zeros((camera.height, camera.width), dtype=bool)
        there[row, column] = True
        return _widened(there, camera, edge, edge)


def _object_in(view: PosedImage) -> NDArray[np.bool_]:
    assert view.mask is not None
    return view.mask > OBJECT


def _border(picture: NDArray[np.generic]) -> NDArray[np.generic]:
    return np.concatenate([*picture[[0, -1]], *picture[:, [0, -1]].T])


def _enclosed(background: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The parts of it that reach no border of the picture ``(H, W)``."""
    labels = np.asarray(cv2.connectedComponents(background.astype(np.uint8), connectivity=4)[1])
    return background & ~np.isin(labels, _border(labels))


def named(names: Sequence[str]) -> str:
    """The first three of the views that a warning is about, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
