"""Clouds of many millions of points in bounded memory: points of a voxel with like normals become their mean.

Like is the dominant direction of ±x, ±y, ±z: the two sides of a thin sheet stay apart. Planes stay exactly; a curved
surface moves by less than a tenth of the voxel squared times its curvature.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from .cleaning.orientation import query
from .point_cloud import (
    Float64,
    Int64,
    PointCloud,
    begins,
    color_scale,
    colors_from,
    normals_from,
    unit_rows,
    usable_rows,
)
from .readers.columns import CloudStream


@dataclass(frozen=True)
class MergeOptions:
    """How points are merged in voxels."""

    rows: int = 1 << 19  # points read at once; with intermediate arrays about 200 MiB
    sample: int = 200_000  # points from which the size of the voxels is estimated
    bits: int = 20  # of a cell number; three of them and one of seven directions fit an int64
    run: int = 16  # largest number of voxels along a normal that are merged
    nowhere: int = 6  # the direction of a point without a normal


MERGE = MergeOptions()


@dataclass(frozen=True)
class Merging:
    """Report of `merge_cloud`."""

    read: int  # points in the file
    kept: int  # means
    dropped_nan: int  # points with a coordinate that is not finite
    dropped_isolated: int
    voxel: float  # edge of the voxels, in input units
    seconds: float  # reading included

    def summary(self) -> str:
        """One line for people."""
        text = f"{self.read:,} points merged to {self.kept:,} in voxels of {self.voxel:.3g}"
        counts = {"not finite": self.dropped_nan, "isolated": self.dropped_isolated}
        dropped = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)
        return f"{text}; dropped {dropped}" if dropped else text


class Survey(NamedTuple):
    """The bounds of a cloud, and which columns it has."""

    low: Float64  # (3,) lowest corner of the finite points
    extent: float  # longest side of their box
    finite: int  # number of finite points
    sample: Float64  # (M, 3) offsets of some of them from ``low``, evenly chosen
    normals: bool  # whether there are any
    scale: float | None  # see `color_scale`; None without colours
    read: int  # number of all points


class _Groups(NamedTuple):
    """Sums over the points of a voxel that face one way."""

    keys: Int64  # (n,), ascending: three cell numbers and a direction
    sums: Float64  # (n, 7 or 10): count, offsets from the lowest corner, unit normals, colours if there are any


def merge_cloud(
    stream: CloudStream,
    limit: int,
    *,
    isolation: float | None = 30.0,
    voxel: float | None = None,
    frame: Survey | None = None,
) -> tuple[PointCloud, Merging] | None:
    """At most ``limit`` means of the points of a stream, which is read twice, or once with its ``frame`` of `survey`.

    None if all points coincide.

    Points with less than 1 / ``isolation`` of the median number of points in the 27 voxels around them are dropped:
    they would weigh as much as means of many. ``voxel`` is the first edge in input units; None for one by ``limit``.
    """
    if limit < 1:
        raise ValueError(f"limit={limit}: expected at least one")
    started = time.monotonic()
    frame = frame or survey(stream)
    if not frame.extent > 0:
        return None
    groups, size = _grouped(stream, frame, voxel or _first_size(frame, limit), limit)
    before = groups.sums[:, 0].sum()
    groups = groups if isolation is None else _without_isolated(groups, isolation)
    while len(rows := _without_scraps(_along_normals(groups), size)) > limit:
        groups, size = _coarser(groups), 2 * size
    count = rows[:, :1]
    cloud = PointCloud(
        rows[:, 1:4] / count + frame.low,
        unit_rows(rows[:, 4:7]).astype(np.float32) if frame.normals else None,
        None if frame.scale is None else (rows[:, 7:10] / count).clip(0, 1).astype(np.float32),
        stream.source,
        reading=stream.reading,
    )
    return cloud, Merging(
        read=frame.read,
        kept=len(cloud),
        dropped_nan=frame.read - frame.finite,
        dropped_isolated=round(float(before - count.sum())),
        voxel=size,
        seconds=round(time.monotonic() - started, 3),
    )


def survey(stream: CloudStream, sample: int | None = None) -> Survey:
    """Read a stream once, and keep about ``sample`` of its points, by default enough to estimate the size of voxels."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    read, finite, normals = 0, 0, False
    stride = 1 + stream.count // (sample or MERGE.sample)
    samples: list[Float64] = []
    colors: list[NDArray[Any]] = []
    for piece in stream.pieces(MERGE.rows):
        points = piece.points.astype(np.float64)
        points = points[usable_rows(points)]
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        finite, normals = finite + len(points), piece.normals is not None
        samples.append(points[::stride].copy())
        if piece.colors is not None:
            colors.append(piece.colors[::stride].copy())
        read += len(piece.points)
    extent = float((high - low).max()) if finite else 0.0
    scale = color_scale(np.concatenate(colors)) if colors else None
    return Survey(low, extent, finite, np.concatenate(samples) - low, normals, scale, read)


def _first_size(frame: Survey, limit: int) -> float:
    """The edge of voxels, if a surface meets about half of ``limit``; their number goes as one over it squared."""
    size, found = frame.extent, 1
    # With 20 points of the sample per cell, nearly all cells of the surface are found.
    while found * 20 < len(frame.sample) and size > frame.extent / 2**MERGE.bits:
        size /= 2
        found = len(np.unique(_cell_keys(frame.sample, size)))
    return size * math.sqrt(found / (0.5 * limit))


def _grouped(stream: CloudStream, frame: Survey, size: float, limit: int) -> tuple[_Groups, float]:
    """Sums of all points by voxel and direction, and the edge of the voxels, doubled whenever there are too many."""
    size = max(size, frame.extent / ((1 << MERGE.bits) - 2))
    groups = _Groups(np.empty(0, np.int64), np.empty((0, 7 if frame.scale is None else 10)))
    for offsets, normals, colors in usable_pieces(stream, frame):
        keys = _cell_keys(offsets, size) << 3 | _directions(normals)
        ones = np.ones((len(keys), 1))
        fresh = _summed(keys, np.concatenate((ones, offsets, normals, colors), axis=1))
        groups = _summed(np.concatenate((groups.keys, fresh.keys)), np.concatenate((groups.sums, fresh.sums)))
        # Several of them become one along the normals.
        while len(groups.keys) > 4 * limit:
            groups, size = _coarser(groups), 2 * size
    return groups, size


def usable_pieces(stream: CloudStream, frame: Survey) -> Iterator[tuple[Float64, Float64, Float64]]:
    """Of the finite points: offsets from ``frame.low``, unit normals (zero where unusable), colours (or no columns)."""
    for piece in stream.pieces(MERGE.rows):
        points = piece.points.astype(np.float64)
        finite = usable_rows(points)
        count = int(finite.sum())
        normals = np.zeros((count, 3)) if piece.normals is None else unit_rows(normals_from(piece.normals[finite]))
        if piece.colors is None or frame.scale is None:
            colors = np.empty((count, 0))
        else:
            colors = colors_from(piece.colors[finite], scale=frame.scale).astype(np.float64)
        yield points[finite] - frame.low, normals, colors


def _cell_keys(offsets: Float64, size: float) -> Int64:
    """One number per cell: three of ``bits`` bits each."""
    x, y, z = (np.floor(axis / size).astype(np.int64) for axis in offsets.T)
    return (x << MERGE.bits | y) << MERGE.bits | z


def _directions(normals: Float64) -> Int64:
    """0 to 5 for normals closest to +x, −x, +y, −y, +z, −z; `nowhere` for a normal of no length: ``(n,)``."""
    axis = np.abs(normals).argmax(axis=1)
    along = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0]
    return np.where(along == 0, MERGE.nowhere, 2 * axis + (along < 0))


def _summed(keys: Int64, values: Float64) -> _Groups:
    """Add up the rows with equal keys."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(begins(ordered))
    if len(starts) == 0:
        return _Groups(ordered, values)
    return _Groups(ordered[starts], np.add.reduceat(values[order], starts, axis=0))


def _cells(keys: Int64) -> tuple[Int64, Int64, Int64]:
    mask = (1 << MERGE.bits) - 1
    return keys >> (3 + 2 * MERGE.bits) & mask, keys >> (3 + MERGE.bits) & mask, keys >> 3 & mask


def _coarser(groups: _Groups) -> _Groups:
    """The same points in voxels of twice the edge."""
    x, y, z = (cell >> 1 for cell in _cells(groups.keys))
    return _summed(((x << MERGE.bits | y) << MERGE.bits | z) << 3 | groups.keys & 7, groups.sums)


def _along_normals(groups: _Groups) -> Float64:
    """Sums as in `_Groups`, of voxels joined along the axis that their points face: noise may be wider than one."""
    direction, cells = groups.keys & 7, _cells(groups.keys)
    joined = [groups.sums[direction == MERGE.nowhere]]
    for axis in range(3):
        rows = np.flatnonzero(direction >> 1 == axis)
        if len(rows) == 0:
            continue
        along, (u, v) = cells[axis][rows], (cells[other][rows] for other in range(3) if other != axis)
        # Numbers one apart are neighbours in one column, facing the same way; the last cell number is never used.
        columns = ((u << MERGE.bits | v) << 1 | direction[rows] & 1) << MERGE.bits | along
        order = np.argsort(columns, kind="stable")
        first = begins(columns[order], step=1)
        place = np.arange(len(rows))
        place -= np.maximum.accumulate(np.where(first, place, 0))
        joined.append(np.add.reduceat(groups.sums[rows[order]], np.flatnonzero(place % MERGE.run == 0), axis=0))
    return np.concatenate(joined)


def _without_scraps(rows: Float64, size: float, *, share: float = 1 / 4) -> Float64:
    """Rows with less than ``share`` of the points of a row within two voxels that faces the same way, added to that.

    They occur at the rims of noise and between two directions, and would weigh as much as means of many points.
    """
    count = rows[:, 0]
    few = count < share * np.median(count)
    if not few.any() or few.all():
        return rows
    small, large = rows[few], rows[~few]
    normals = unit_rows(large[:, 4:7])
    tree = KDTree(large[:, 1:4] / large[:, :1])
    found, near = query(tree, small[:, 1:4] / small[:, :1], 8, within=2 * size)
    near = np.where(np.isfinite(found), near, 0)
    agrees = np.einsum("mkd,md->mk", normals[near], unit_rows(small[:, 4:7])) > 0.5
    agrees |= (small[:, 4:7] == 0).all(axis=1)[:, None]
    fits = np.isfinite(found) & agrees & (count[few][:, None] < share * large[near, 0])
    given = fits.any(axis=1)
    owner = near[given, fits[given].argmax(axis=1)]
    for column in range(rows.shape[1]):
        large[:, column] += np.bincount(owner, small[given, column], minlength=len(large))
    return np.concatenate((large, small[~given]))


def _without_isolated(groups: _Groups, factor: float) -> _Groups:
    """Drop voxels with too few points in and around them; see `merge_cloud`."""
    voxels = _summed(groups.keys >> 3, groups.sums[:, :1])
    counts = voxels.sums[:, 0]
    usual = 9 * float(np.median(counts))  # a surface crosses about nine of the 27 voxels around one of its points
    few = np.flatnonzero(counts * factor < usual)
    around = np.zeros(len(few))
    for x, y, z in itertools.product((-1, 0, 1), repeat=3):
        shifted = voxels.keys[few] + (((x << MERGE.bits) + y) << MERGE.bits) + z
        at = np.searchsorted(voxels.keys, shifted).clip(max=len(counts) - 1)
        around += np.where(voxels.keys[at] == shifted, counts[at], 0)
    kept = ~np.isin(groups.keys >> 3, voxels.keys[few[around * factor < usual]])
    return _Groups(groups.keys[kept], groups.sums[kept])
