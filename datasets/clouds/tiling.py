"""Boxes for a cloud that one network cannot hold, and its points sorted into a file for each box."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...neural_fields import InputError
from ...neural_fields.fields.tiled import Split
from .large import Survey, survey, usable_pieces
from .point_cloud import Float64, Int64
from .readers.columns import CloudStream


@dataclass(frozen=True)
class TilingOptions:
    """How a cloud is cut."""

    points: int = 200_000  # of a tile, about: as many as the statues whose detail one network keeps
    sample: int = 2_000_000  # points by which boxes are chosen
    fewest: int = 2_000  # points of a tile, below which nothing is cut off
    narrowest: float = 1 / 4  # shortest edge of a box over the usual one
    blend: float = 1 / 20  # half the width of a blend over the usual edge; the reach of distances is as long


TILING = TilingOptions()


@dataclass(frozen=True)
class TilePlan:
    """Boxes of a cloud, in input coordinates and units.

    Attributes:
        cuts: the tree of planes, from its root; none for a single tile.
        blend: half the width of the blend between two tiles, and the reach of their distances.
        low: ``(3,)`` lowest corner of the points.
        high: ``(3,)`` highest corner.
        count: points with finite coordinates.
        normals: whether they have normals.
    """

    cuts: tuple[Split, ...]
    blend: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    count: int
    normals: bool

    @property
    def num_tiles(self) -> int:
        """The number of tiles."""
        return 1 + len(self.cuts)

    def rows(self, points: Float64, *, margin: float) -> Iterator[tuple[int, Int64]]:
        """Each tile with the rows of the points ``(N, 3)`` in its box and up to ``margin`` beside it."""
        waiting = [(0 if self.cuts else -1, np.arange(len(points)))]
        while waiting:
            node, rows = waiting.pop()
            if node < 0:
                yield -1 - node, rows
                continue
            cut = self.cuts[node]
            places = points[rows, cut.axis]
            waiting.append((cut.below, rows[places < cut.place + margin]))
            waiting.append((cut.above, rows[places >= cut.place - margin]))


def plan_tiles(stream: CloudStream, *, size: float | None = None, points: int | None = None) -> tuple[TilePlan, Survey]:
    """Cut a cloud, which is read once, into boxes of about ``points`` points, or with edges of ``size`` at most.

    Boxes are cut across their longest edge: at the median of their points, or in equal parts if ``size`` is given.
    They are no narrower than `TilingOptions.narrowest` allows, so that at most eight tiles meet.

    Raises:
        InputError: the points have no extent.
    """
    frame = survey(stream, TILING.sample)
    if not frame.extent > 0:
        raise InputError(f"{stream.source}: points: all of them coincide, or none is finite; export it again")
    sample = frame.sample + frame.low
    low, high = sample.min(axis=0), sample.max(axis=0)
    each = frame.finite / len(sample)
    limit = points or TILING.points
    if size is None:
        *_, middle, longest = np.sort(high - low)
        usual = math.sqrt(max(middle, longest / 100) * longest / max(1.0, frame.finite / limit))
    else:
        usual = size
    narrowest, blend = TILING.narrowest * usual, TILING.blend * usual
    cuts: list[Split] = []
    tiles = 0

    def cut(rows: Int64, low: Float64, high: Float64) -> int:
        nonlocal tiles
        part = sample[rows]
        extent = np.ptp(part, axis=0)
        large = len(rows) * each > limit if size is None else extent.max() > size
        for axis in np.argsort(extent)[::-1] if large else ():
            if high[axis] - low[axis] < 2 * narrowest:
                continue
            middle = float(np.median(part[:, axis])) if size is None else (low[axis] + high[axis]) / 2
            place = float(np.clip(middle, low[axis] + narrowest, high[axis] - narrowest))
            below = part[:, axis] < place
            if min(below.sum(), (~below).sum()) * each < TILING.fewest:
                continue
            number = len(cuts)
            cuts.append(Split(int(axis), place, blend, 0, 0))
            beside = np.arange(3) == axis
            first = cut(rows[below], low, np.where(beside, place, high))
            second = cut(rows[~below], np.where(beside, place, low), high)
            cuts[number] = Split(int(axis), place, blend, first, second)
            return number
        tiles += 1
        return -tiles

    cut(np.arange(len(sample)), low, high)
    plan = TilePlan(tuple(cuts), blend, tuple(low.tolist()), tuple(high.tolist()), frame.finite, frame.normals)
    return plan, frame


def write_tiles(
    stream: CloudStream,
    plan: TilePlan,
    frame: Survey,
    folder: Path,
    *,
    report: Callable[[int, int], object] = lambda done, total: None,
) -> list[int]:
    """Write the points of each tile to ``folder/NNNN.npy``, and return their numbers.

    Rows are x, y, z in float64, and the unit normal where the cloud has normals. A tile gets what lies within twice the
    blend of its box: half of that for the blend, and half for its distances. The cloud is read once, in pieces.

    Raises:
        InputError: the disk has not enough room.
    """
    columns = 6 if plan.normals else 3
    needed = int(plan.count * columns * 8 * 1.6)  # shares of two tiles are written twice
    if needed > (room := shutil.disk_usage(folder.parent).free):
        raise InputError(f"{folder}: the tiles need about {needed / 2**30:.1f} GiB, and {room / 2**30:.1f} are free")
    folder.mkdir(parents=True)
    counts, done = [0] * plan.num_tiles, 0
    for number in range(plan.num_tiles):
        _write_header(folder / tile_name(number), 0, columns)
    for offsets, normals, _ in usable_pieces(stream, frame):
        points = offsets + frame.low
        table = np.concatenate((points, normals), axis=1) if plan.normals else points
        for number, rows in plan.rows(points, margin=2 * plan.blend):
            counts[number] += len(rows)
            with (folder / tile_name(number)).open("ab") as file:
                file.write(np.ascontiguousarray(table[rows]).tobytes())
        done += len(points)
        report(done, plan.count)
    for number, count in enumerate(counts):
        _write_header(folder / tile_name(number), count, columns)
    return counts


def tile_name(number: int) -> str:
    """The name of the file of a tile."""
    return f"{number:04d}.npy"


def _write_header(path: Path, count: int, columns: int) -> None:
    """NumPy leaves room in the header for a longer first axis, so the header of the whole file is as long."""
    described = {"descr": "<f8", "fortran_order": False, "shape": (count, columns)}
    with path.open("r+b" if path.exists() else "wb") as file:
        np.lib.format.write_array_header_1_0(file, described)
