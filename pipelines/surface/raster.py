"""Triangles seen along an axis: which columns of a regular grid each one covers, for volumetric IoU and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...neural_fields.backend.arrays import Float64, Int64

Faces = NDArray[np.integer]


class Coverage(NamedTuple):
    """Pairs of a triangle and a column that it covers.

    Attributes:
        face: ``(K,)`` index of the triangle.
        column: ``(K,)`` index of the column, ``x * ny + y``.
        weights: ``(K, 3)`` barycentric coordinates of the column's point.
        sign: ``(K,)`` +1 where the triangle runs counter-clockwise (its normal points to +z), −1 otherwise.
    """

    face: Int64
    column: Int64
    weights: Float64
    sign: NDArray[np.int8]


def clip(vertices: Float64, height: Float64, faces: Faces) -> tuple[Float64, Faces, Int64]:
    """Cut triangles where ``height`` ``(V,)``, linear over each, is zero, and keep where it is positive.

    Returns the vertices, old ones first; the triangles; and for each the old triangle that it is a part of. A cut
    quadrilateral becomes two triangles. Neighbours cut their common edge at exactly the same place.
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
    share = (height[kept] / (height[kept] - height[dropped]))[:, None]
    made = (1 - share) * vertices[kept] + share * vertices[dropped]
    return np.concatenate((vertices, made)), np.concatenate(parts), np.concatenate(owner)


def cover(
    xy: NDArray[np.floating], faces: Faces, shape: tuple[int, int], *, chunk: int = 1 << 20
) -> Iterator[Coverage]:
    """Yield the columns that triangles ``(F, 3)`` cover; column (i, j) is the point (i, j) of the plane of ``xy``.

    Two triangles never both claim or both leave a point on their common edge, because its side is computed from the
    edge's lower-numbered end. So on a closed mesh without duplicate vertices, signs sum to zero over each column.
    ``chunk`` pairs of a triangle and a column are tested at a time: a million take 200 MB.
    """
    corners = xy[faces]  # (F, 3, 2)
    top = np.asarray(shape) - 1
    low = np.clip(np.ceil(corners.min(axis=1)), 0, top + 1).astype(np.int64)  # (F, 2)
    high = np.clip(np.floor(corners.max(axis=1)), -1, top).astype(np.int64)
    lines = np.where((high >= low).all(axis=1), high[:, 0] - low[:, 0] + 1, 0)
    used = np.flatnonzero(lines)
    for start, stop in _groups(lines[used], chunk):
        some = used[start:stop]
        row = np.repeat(np.arange(len(some)), lines[some])
        i = low[some, 0][row] + _within(lines[some])
        first, count = _between(corners[some], row, i, low[some, 1], high[some, 1])
        for begin, end in _groups(count, chunk):
            times = count[begin:end]
            j = np.repeat(first[begin:end], times) + _within(times)
            yield _inside(
                xy, faces[some], some, np.repeat(row[begin:end], times), np.repeat(i[begin:end], times), j, shape[1]
            )


def _groups(count: Int64, chunk: int) -> Iterator[tuple[int, int]]:
    """Consecutive ranges of ``count`` whose sums are at most ``chunk``, or that have one member."""
    ends = np.cumsum(count)
    start = 0
    while start < len(count):
        base = ends[start - 1] if start else 0
        stop = max(int(np.searchsorted(ends, base + chunk, side="right")), start + 1)
        yield start, stop
        start = stop


def _within(count: Int64) -> Int64:
    """0 … count[0] − 1, 0 … count[1] − 1, and so on: ``(Σ count,)``."""
    return np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)


def _between(corners: NDArray[np.floating], row: Int64, i: Int64, low: Int64, high: Int64) -> tuple[Int64, Int64]:
    """First column to test on the line x = ``i`` through the triangle ``corners[row]``, and how many.

    The interval between the two crossed edges is widened by the error of a column's test. On an edge from (x₀, y₀) by
    (Δx, Δy) that is a few roundings of |Δx||j − y₀| + |Δy||i − x₀|. In y it is a few roundings of the height.
    """
    lowest, highest = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for k in range(3):
        start, end = corners[:, k], corners[:, (k + 1) % 3]
        left, right = np.minimum(start[:, 0], end[:, 0])[row], np.maximum(start[:, 0], end[:, 0])[row]
        (x, y), (dx, dy) = start[row].T, (end - start)[row].T
        crossed = (left <= i) & (i <= right) & (dx != 0)
        y = y + dy * np.divide(i - x, dx, out=np.zeros_like(x), where=crossed)
        np.minimum(lowest, y, out=lowest, where=crossed)
        np.maximum(highest, y, out=highest, where=crossed)
    low, high = low[row], high[row]
    wider = 64 * np.finfo(np.float64).eps * (np.abs(corners[..., 1]).max(axis=1)[row] + 1)
    first = np.ceil(np.clip(lowest - wider, low, high + 1)).astype(np.int64)
    last = np.floor(np.clip(highest + wider, low - 1, high)).astype(np.int64)
    return first, np.maximum(last - first + 1, 0)


def _inside(xy: NDArray[np.floating], faces: Faces, some: Int64, row: Int64, i: Int64, j: Int64, ny: int) -> Coverage:
    """Those of the columns (``i``, ``j``) that are in the triangle ``faces[row]``, number ``some[row]`` of all."""
    sides = np.empty((len(row), 3))  # twice the signed area of the point with each edge
    left = np.empty((len(row), 3), dtype=bool)
    for k in range(3):  # the edge opposite vertex k
        a, b = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
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
    sign = np.where(total[hit] == 3, 1, -1).astype(np.int8)
    return Coverage(some[row[hit]], (i * ny + j)[hit], weights, sign)
