"""``fuse_frames``: several posed depth maps → one cloud, without what some of them see through."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .depth_cloud import DepthReport, DepthSettings, frame_cloud
from .point_cloud import PointCloud
from .rgbd import RgbdFrame
from .voxels import select, thin

__all__ = ["fuse_frames"]

Float64 = NDArray[np.float64]

TOLERANCE = 0.03  # of the depth: a point this much nearer than what a frame sees there is in its way
WITNESSES = 12  # frames that are asked about each point, so that long sequences take linear time


def fuse_frames(
    frames: Sequence[RgbdFrame],
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
        frames: with poses in one world, and depths in one unit, that of the poses.
        settings: of the cleaning; ``max_points`` is for all frames together.
        tolerance: relative difference of depths up to which a frame sees the same point.
        witnesses: how many other frames, evenly spread over the sequence, are asked about a frame's points.

    Returns:
        The cloud, and what became of the pixels.

    Raises:
        InputError: there are no frames, nothing is left, or only some frames have colours.
        ValueError: ``tolerance`` is not between 0 and 1, or ``witnesses`` is negative.
    """
    settings = settings or DepthSettings()
    if not 0 < tolerance < 1 or witnesses < 0:
        raise ValueError(f"tolerance={tolerance}, witnesses={witnesses}: expected one in (0, 1) and one >= 0")
    if not frames:
        raise InputError("frames: none given; name at least one depth map")
    colored = [frame.color is not None for frame in frames]
    if any(colored) != all(colored):
        raise InputError(f"{frames[colored.index(False)].source}: has no colour picture, but other frames have one")
    clouds, reports, seen_through = [], [], 0
    nearest_depths = [_nearest_around(frame.depth) for frame in frames]
    for index, frame in enumerate(frames):
        cloud, report = frame_cloud(frame, settings)
        cloud = thin(cloud, settings.max_points)
        through = np.zeros(len(cloud), np.int64)
        for other in _witnesses(index, len(frames), witnesses):
            through += _verdict(cloud.points, frames[other], nearest_depths[other], tolerance)
        seen_through += int((through > 0).sum())
        clouds.append(select(cloud, through <= 0))
        reports.append(report)
    thinned = thin(_concatenated(clouds), settings.max_points)
    if not len(thinned):
        raise InputError(f"{frames[0].source}: the frames see through all of each other's points; check the poses")
    return thinned, _summed(reports, kept=len(thinned), seen_through=seen_through)


def _witnesses(index: int, count: int, limit: int) -> list[int]:
    """At most ``limit`` of the other frames, evenly spread."""
    others = [other for other in range(count) if other != index]
    if len(others) <= limit:
        return others
    return [others[k] for k in np.linspace(0, len(others) - 1, limit).round().astype(int)]


def _nearest_around(depth: Float64) -> Float64:
    """The nearest depth among a pixel and its eight neighbours ``(H, W)``; 0 where one of them has no reading.

    So that a surface seen at a slant, or the rim of a thing with something far behind it, is not seen through.
    """
    return np.asarray(cv2.erode(np.nan_to_num(depth, nan=0.0), np.ones((3, 3), np.uint8)), np.float64)


def _verdict(points: Float64, frame: RgbdFrame, nearest: Float64, tolerance: float) -> NDArray[np.int64]:
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
        seen_through=seen_through,
        thinned=sum(report.kept for report in reports) - seen_through - kept,
        kept=kept,
    )
