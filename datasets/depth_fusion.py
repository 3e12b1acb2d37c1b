"""``fuse_frames``: several posed depth maps → one cloud, without what some of them see through."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import count

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .clouds.point_cloud import PointCloud, select, spread, thin
from .depth_cloud import DepthReport, DepthSettings, frame_cloud
from .rgbd import RgbdFrame

__all__ = ["fuse_frames"]

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

TOLERANCE = 0.03  # of the depth: a point this much nearer than what a frame sees there is in its way
WITNESSES = 12  # frames that are asked about each point, so that long sequences take linear time
ROOM = 2  # times as many points as will stay are kept until all frames have been asked about them


def fuse_frames(
    frames: Iterable[RgbdFrame],
    settings: DepthSettings | None = None,
    *,
    tolerance: float = TOLERANCE,
    witnesses: int = WITNESSES,
) -> tuple[PointCloud, DepthReport]:
    """Join depth maps in world coordinates; one frame alone is fine.

    Each frame becomes a cloud (see `frame_cloud`). A point of it is dropped if more of the other frames see through it
    than see it: flying points, and what moved away. The rest is thinned by voxels, which also joins what several
    frames saw.

    Args:
        frames: with poses in one world, and depths in one unit, that of the poses. They are gone through twice, and
            none is held longer than it is looked at: what reads its frames anew each time needs memory for one of
            them, however many there are.
        settings: of the cleaning; ``max_points`` is for all frames together.
        tolerance: relative difference of depths up to which a frame sees the same point.
        witnesses: how many other frames, evenly spread over the sequence, are asked about a frame's points.

    Returns:
        The cloud, and what became of the pixels.

    Raises:
        InputError: there are no frames, nothing is left, or only some frames have colours.
        ValueError: ``tolerance`` is not between 0 and 1, ``witnesses`` is negative, or ``frames`` is an iterator.
    """
    settings = settings or DepthSettings()
    if not 0 < tolerance < 1 or witnesses < 0:
        raise ValueError(f"tolerance={tolerance}, witnesses={witnesses}: expected one in (0, 1) and one >= 0")
    if isinstance(frames, Iterator):
        raise ValueError("frames: an iterator, which ends after one pass; expected a list, or what begins anew")
    pool = _Pool(settings)
    # `map` and not a loop over frames, whose variable would hold each of them until the next has been read.
    reports = list(map(pool.add, frames))
    if not reports:
        raise InputError("frames: none given; name at least one depth map")
    (cloud, owner), seen_through = pool.joined(), 0
    if len(reports) > 1 and witnesses:
        asked = _witnesses(len(reports), witnesses)
        ask = partial(_votes, cloud.points, owner, asked, tolerance)
        through = sum(map(ask, count(), frames), np.zeros(len(cloud), np.int64))
        seen_through = int((through > 0).sum())
        cloud = select(cloud, through <= 0)
    cloud = thin(cloud, settings.max_points)
    if not len(cloud):
        raise InputError(f"{pool.source}: the frames see through all of each other's points; check the poses")
    return cloud, _summed(reports, kept=len(cloud), seen_through=seen_through)


class _Pool:
    """The points of the frames so far, and which frame each of them is from; never many more than will stay."""

    def __init__(self, settings: DepthSettings) -> None:
        self.settings = settings
        self.clouds: list[PointCloud] = []
        self.owners: list[Int32] = []
        self.frames = 0
        self.source, self.colored = "", False

    def add(self, frame: RgbdFrame) -> DepthReport:
        """Take in the points of the next frame."""
        colored = frame.color is not None
        if not self.frames:
            self.source, self.colored = frame.source, colored
        if colored != self.colored:
            bare = self.source if colored else frame.source
            raise InputError(f"{bare}: has no colour picture, but other frames have one")
        cloud, report = frame_cloud(frame, self.settings)
        self.clouds.append(thin(cloud, self.settings.max_points))
        self.owners.append(np.full(len(self.clouds[-1]), self.frames, np.int32))
        self.frames += 1
        if sum(map(len, self.clouds)) > 2 * ROOM * self.settings.max_points:
            cloud, owner = self.joined()
            kept = spread(cloud.points, ROOM * self.settings.max_points)
            self.clouds, self.owners = [select(cloud, kept)], [owner[kept]]
        return report

    def joined(self) -> tuple[PointCloud, Int32]:
        """All points, and the number of the frame of each."""
        return _concatenated(self.clouds), np.concatenate(self.owners)


def _witnesses(frames: int, limit: int) -> Int64:
    """At most ``limit`` of the other frames, evenly spread, for each frame ``(frames, K)``."""
    others = np.linspace(0, frames - 2, min(limit, frames - 1)).round().astype(np.int64)
    return others + (others >= np.arange(frames)[:, None])


def _votes(points: Float64, owner: Int32, asked: Int64, tolerance: float, index: int, frame: RgbdFrame) -> Int64:
    """What a frame has to say of the points ``(N, 3)`` of those frames that ask it, see `_verdict`; else 0."""
    mine = np.flatnonzero((asked == index).any(axis=1)[owner])
    votes = np.zeros(len(points), np.int64)
    votes[mine] = _verdict(points[mine], frame, _nearest_around(frame.depth), tolerance)
    return votes


def _nearest_around(depth: Float64) -> Float64:
    """The nearest depth among a pixel and its eight neighbours ``(H, W)``; 0 where one of them has no reading.

    So that a surface seen at a slant, or the rim of a thing with something far behind it, is not seen through.
    """
    return np.asarray(cv2.erode(np.nan_to_num(depth, nan=0.0), np.ones((3, 3), np.uint8)), np.float64)


def _verdict(points: Float64, frame: RgbdFrame, nearest: Float64, tolerance: float) -> Int64:
    """Of each point ``(N, 3)`` in world coordinates: 1 if the frame sees through it, −1 if it sees it, else 0."""
    seen = (points - frame.eye) @ frame.world_from_camera[:3, :3]
    pixels, inside = frame.camera.project(seen)
    index = np.flatnonzero(inside)
    u, v = np.rint(pixels[index]).astype(np.int64).T
    u, v = u.clip(0, frame.camera.width - 1), v.clip(0, frame.camera.height - 1)
    z, there = seen[index, 2], np.nan_to_num(frame.depth[v, u], nan=0.0)
    verdict = np.zeros(len(points), np.int64)
    verdict[index] = (z < (1 - tolerance) * nearest[v, u]).astype(np.int64)
    verdict[index[np.abs(z - there) <= tolerance * there]] = -1
    return verdict


def _concatenated(clouds: Sequence[PointCloud]) -> PointCloud:
    normals = [cloud.normals for cloud in clouds if cloud.normals is not None]
    colors = [cloud.colors for cloud in clouds if cloud.colors is not None]
    return PointCloud(
        np.concatenate([cloud.points for cloud in clouds]),
        np.concatenate(normals),
        np.concatenate(colors) if colors else None,
        clouds[0].source,
    )


def _summed(reports: Sequence[DepthReport], *, kept: int, seen_through: int) -> DepthReport:
    """One report of all frames."""
    counts = ("pixels", "without_reading", "out_of_range", "edges", "grazing", "specks")
    totals = {name: sum(getattr(report, name) for report in reports) for name in counts}
    return dataclasses.replace(
        reports[0],
        **totals,
        frames=len(reports),
        noise=float(np.median([report.noise for report in reports])),
        smoothing=max(report.smoothing for report in reports),
        nearest=min(report.nearest for report in reports),
        furthest=max(report.furthest for report in reports),
        typical=max(report.typical for report in reports),
        seen_through=seen_through,
        thinned=sum(report.kept for report in reports) - seen_through - kept,
        kept=kept,
    )
