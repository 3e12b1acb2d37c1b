"""Triangles seen along an axis: which columns of a regular grid each one covers, and where.

One routine serves the volumetric IoU (columns through space) and the pictures (pixels of an image).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Clipped", "Coverage", "clip", "cover"]

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

CHUNK = 1 << 20  # candidate (triangle, column) pairs held at a time: about 200 MB


class Coverage(NamedTuple):
    """Pairs of a triangle and a column it covers.

    Attributes:
        face: ``(K,)`` index of the triangle.
        column: ``(K,)`` index of the column, ``x * ny + y``.
        weights: ``(K, 3)`` barycentric coordinates of the column's point in the triangle.
        sign: ``(K,)`` +1 where the triangle runs counter-clockwise (its normal points to +z), −1 otherwise.
    """

    face: Int64
    column: Int64
    weights: Float64
    sign: NDArray[np.int8]


class Clipped(NamedTuple):
    """What is left of triangles cut at a plane; vertex V + k is ``(1 − share[k]) kept[k] + share[k] dropped[k]``.

    Attributes:
        faces: ``(F', 3)`` indices of old vertices, and of new ones from V on.
        owner: ``(F',)`` the old triangle that each is a part of.
        kept: ``(K,)`` old vertex on the near side of the edge that new vertex k cuts.
        dropped: ``(K,)`` the one on the far side.
        share: ``(K,)`` how far from the first to the second the plane is.
    """

    faces: Int64
    owner: Int64
    kept: Int64
    dropped: Int64
    share: Float64


def clip(height: Float64, faces: Int64) -> Clipped:
    """Cut triangles where ``height`` ``(V,)``, linear over each, is zero, and keep where it is positive.

    A corner cut off leaves a quadrilateral, which becomes two triangles; two corners cut off leave one.
    Neighbours cut their common edge at exactly the same place.
    """
    positive = height > 0
    count = positive[faces].sum(axis=1)
    owner = [np.flatnonzero(count == 3)]
    parts, ends = [faces[owner[0]]], []
    new = len(height)
    for corners in (1, 2):
        of = np.flatnonzero(count == corners)
        cut = faces[of]
        # Turn the corner that is alone on its side to the front; the order of the other two stays.
        alone = (positive[cut] == (corners == 1)).argmax(axis=1)
        a, b, c = cut[np.arange(len(cut))[:, None], (alone[:, None] + np.arange(3)) % 3].T
        ab, ac = new + np.arange(len(cut)), new + len(cut) + np.arange(len(cut))
        new += 2 * len(cut)
        if corners == 1:
            owner.append(of)
            parts.append(np.stack((a, ab, ac), axis=1))
            ends.append((np.concatenate((a, a)), np.concatenate((b, c))))
        else:
            owner += [of, of]
            parts.extend((np.stack((ab, b, c), axis=1), np.stack((ab, c, ac), axis=1)))
            ends.append((np.concatenate((b, c)), np.concatenate((a, a))))
    kept, dropped = (np.concatenate(side) for side in zip(*ends, strict=True))
    share = height[kept] / (height[kept] - height[dropped])
    return Clipped(np.concatenate(parts), np.concatenate(owner), kept, dropped, share)


def cover(xy: Float64, faces: Int64, shape: tuple[int, int], *, chunk: int = CHUNK) -> Iterator[Coverage]:
    """Yield the columns that triangles cover; column (i, j) is the point (i, j) of the plane.

    Two triangles with a common edge never both claim or both leave a point on it, because the side of
    an edge is computed once, from its lower-numbered end, whichever triangle asks. On a closed mesh
    (with duplicate vertices merged) the signs over each column therefore sum to zero.

    Args:
        xy: ``(V, 2)`` vertices, in units of the grid.
        faces: ``(F, 3)`` vertex indices.
        shape: columns along x and y.
        chunk: how many candidate pairs to hold at a time.
    """
    corners = xy[faces]  # (F, 3, 2)
    top = np.asarray(shape) - 1
    low = np.clip(np.ceil(corners.min(axis=1)), 0, top + 1).astype(np.int64)  # (F, 2)
    high = np.clip(np.floor(corners.max(axis=1)), -1, top).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    used = np.flatnonzero(count)
    ends = np.cumsum(count[used])
    start = 0
    while start < len(used):
        base = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, base + chunk, side="right")), start + 1)
        some = used[start:stop]
        yield _cover_candidates(xy, faces, some, low[some], size[some], shape[1])
        start = stop


def _cover_candidates(xy: Float64, faces: Int64, some: Int64, low: Int64, size: Int64, ny: int) -> Coverage:
    """Test every column in the bounding boxes of the triangles ``some``."""
    count = size[:, 0] * size[:, 1]
    row = np.repeat(np.arange(len(some)), count)
    within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    i = low[row, 0] + within // size[row, 1]
    j = low[row, 1] + within % size[row, 1]
    face = some[row]
    sides = np.empty((len(row), 3))  # twice the signed area of the point with each edge
    left = np.empty((len(row), 3), dtype=bool)
    for k in range(3):  # the edge opposite vertex k
        a, b = faces[some, (k + 1) % 3], faces[some, (k + 2) % 3]
        forward = a < b
        first, second = xy[np.where(forward, a, b)], xy[np.where(forward, b, a)]
        along = (second - first)[row]
        first = first[row]
        area = along[:, 0] * (j - first[:, 1]) - along[:, 1] * (i - first[:, 0])
        forward = forward[row]
        left[:, k] = (area > 0) == forward
        sides[:, k] = np.where(forward, area, -area)
    total = left.sum(axis=1)
    hit = (total == 3) | (total == 0)
    sides = np.abs(sides[hit])
    area = sides.sum(axis=1, keepdims=True)
    weights = np.divide(sides, area, out=np.full_like(sides, 1 / 3), where=area > 0)
    return Coverage(face[hit], (i * ny + j)[hit], weights, np.where(total[hit] == 3, 1, -1).astype(np.int8))
