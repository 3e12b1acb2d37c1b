"""Depth maps → an oriented coloured cloud and a report: `frame_cloud` of one, `fuse_frames` of several with poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError
from ...neural_fields.backend.errors import renamed
from ..clouds.point_cloud import Float64, Int64, PointCloud, colors_from, select, spread, thin
from ..clouds.readers.reading import MIN_POINTS
from .cleaning import edge_pixels, grid_normals, measure_noise, smooth_depth, specks
from .frame import RgbdFrame

Int32 = NDArray[np.int32]


@dataclass(frozen=True)
class FusionOptions:
    """How depth maps are joined."""

    typical: float = 0.99  # share of the points nearer than the typical depth
    stray: float = 1.5  # furthest over typical depth from which the report suggests --max-depth
    tolerance: float = 0.03  # of the depth, by which a point is in front of a frame's surface, or on it
    views: int = 12  # frames that each point is projected into, for linear time
    room: int = 2  # points that are kept for the vote, over those that stay


FUSION = FusionOptions()


@dataclass(frozen=True)
class DepthSettings:
    """How depth maps become clouds.

    Attributes:
        max_depth: readings beyond it are dropped, in the unit of depth; None keeps them.
        jump: largest step between neighbours, relative to depth, that is noise and no edge.
        max_incidence: degrees between the view and the normal beyond which a point is dropped.
        smoothing: radius of the smoothing windows in pixels; None derives it from the noise of the readings.
        smallest_piece: pieces of the map with a smaller share of its pixels than this are dropped.
        max_points: of the whole cloud, which is thinned by voxels.

    Raises:
        ValueError: a setting is out of its range.
    """

    max_depth: float | None = None
    jump: float = 0.01
    max_incidence: float = 84.0
    smoothing: int | None = None
    smallest_piece: float = 1e-4
    max_points: int = 200_000

    def __post_init__(self) -> None:
        allowed = {
            "max_depth": self.max_depth is None or self.max_depth > 0,
            "jump": 0 < self.jump < 1,
            "max_incidence": 0 < self.max_incidence <= 90,
            "smoothing": self.smoothing is None or self.smoothing >= 0,
            "smallest_piece": 0 <= self.smallest_piece < 1,
            "max_points": self.max_points > 0,
        }
        for name in (name for name, good in allowed.items() if not good):
            raise ValueError(f"{name}={getattr(self, name)}: out of its range; see the documentation")


@dataclass(frozen=True)
class DepthReport:
    """Report on the pixels of one or several depth maps; lengths are in the unit of the maps."""

    frames: int  # number of depth maps
    pixels: int  # of all maps
    without_reading: int
    out_of_range: int  # pixels beyond ``max_depth``
    edges: int  # pixels beside a break of the surface
    grazing: int  # pixels seen edge-on, or without a normal
    specks: int  # pixels in pieces that are too small
    kept: int  # points of the cloud
    noise: float  # relative standard deviation of the readings, the median over the frames
    smoothing: int  # radius of the smoothing windows in pixels, the largest over the frames
    nearest: float  # smallest depth of a kept point
    furthest: float  # largest depth of a kept point
    typical: float  # 99 % quantile of the depths of kept points; of several frames, the largest
    seen_through: int = 0  # points that other frames see through
    thinned: int = 0  # points that were dropped by thinning
    lost: int = 0  # depth maps that were left out, since their pose is lost

    def summary(self) -> str:
        """The report in a few lines."""
        dropped = {
            "without a reading": self.without_reading,
            "beyond the largest depth": self.out_of_range,
            "at depth edges": self.edges,
            "seen edge-on": self.grazing,
            "in specks": self.specks,
            "seen through by other frames": self.seen_through,
            "thinned": self.thinned,
        }
        parts = ", ".join(f"{count:,} {what}" for what, count in dropped.items() if count)
        maps = "1 depth map" if self.frames == 1 else f"{self.frames} depth maps"
        maps += f" ({self.lost} without a pose left out)" if self.lost else ""
        smoothing = f"smoothed over {self.smoothing} pixels" if self.smoothing else "not smoothed"
        lines = [
            f"{maps}: {self.kept:,} points of {self.pixels:,} pixels" + (f"; dropped {parts}" if parts else ""),
            f"depths {self.nearest:.4g} to {self.furthest:.4g} units, noise {self.noise:.2%}, {smoothing}",
        ]
        if self.furthest > FUSION.stray * self.typical:
            limit = f"--max-depth {1.05 * self.typical:.2g}"
            lines.append(f"hint: 99 % of the points are nearer than {self.typical:.3g}; {limit} makes them finer")
        return "\n".join(lines)


def frame_cloud(frame: RgbdFrame, settings: DepthSettings | None = None) -> tuple[PointCloud, DepthReport]:
    """An oriented, coloured cloud of a depth map in world coordinates, and a report.

    Depth edges are cut on both sides. The rest is smoothed according to its noise, unprojected, and given normals that
    face the camera.

    Raises:
        InputError: fewer than ten points are left.
    """
    settings = settings or DepthSettings()
    depth, pixel_angle = frame.depth, frame.camera.pixel_angle
    read = np.isfinite(depth)
    depth = depth if settings.max_depth is None else np.where(depth <= settings.max_depth, depth, np.nan)
    ranged = np.isfinite(depth)
    edges = edge_pixels(depth, pixel_angle=pixel_angle, jump=settings.jump) & ranged
    noise = measure_noise(np.where(edges, np.nan, depth), pixel_angle=pixel_angle, jump=settings.jump)
    radius = noise.radius if settings.smoothing is None else settings.smoothing
    if radius:
        depth = smooth_depth(np.where(edges, np.nan, depth), radius, noise=noise.deviation, color=frame.color)
    points = frame.camera.unproject(depth)
    # The filter keeps some of the steps between plateaus; a mean of many tangents does not.
    window = radius if noise.patchy else radius // 2
    normals = grid_normals(points, pixel_angle=pixel_angle, jump=settings.jump, radius=window)
    facing = -(normals * points).sum(axis=2) / np.linalg.norm(points, axis=2)
    clear = ranged & ~edges & (facing >= np.cos(np.radians(settings.max_incidence)))
    small = specks(clear, max(4, round(settings.smallest_piece * depth.size)))
    kept = clear & ~small
    if kept.sum() < MIN_POINTS:
        raise InputError(
            f"{frame.source}: only {int(kept.sum())} of {int(read.sum())} readings lie on a surface; check scale and "
            f"intrinsics ({MIN_POINTS} points are needed)"
        )
    rotation = frame.world_from_camera[:3, :3]
    cloud = PointCloud(
        points[kept] @ rotation.T + frame.eye,
        (normals[kept] @ rotation.T).astype(np.float32),
        None if frame.color is None else colors_from(frame.color[kept]),
        frame.source,
    )
    report = DepthReport(
        frames=1,
        pixels=depth.size,
        without_reading=int((~read).sum()),
        out_of_range=int((read & ~ranged).sum()),
        edges=int(edges.sum()),
        grazing=int((ranged & ~edges & ~clear).sum()),
        specks=int(small.sum()),
        kept=len(cloud),
        noise=noise.deviation,
        smoothing=radius,
        nearest=float(depth[kept].min()),
        furthest=float(depth[kept].max()),
        typical=float(np.quantile(depth[kept], FUSION.typical)),
    )
    return cloud, report


@partial(renamed, witnesses="views")
def fuse_frames(
    frames: Iterable[RgbdFrame],
    settings: DepthSettings | None = None,
    *,
    tolerance: float = FUSION.tolerance,
    views: int = FUSION.views,
) -> tuple[PointCloud, DepthReport]:
    """Join one or more depth maps in world coordinates → a cloud and a report.

    Each frame becomes a cloud (see `frame_cloud`). A point is dropped if more of the other frames see through it than
    see it: flying points, and things that moved. The rest is thinned by voxels.

    Args:
        frames: with poses in one world, and depths in the unit of the poses. They are iterated twice and not held: an
            iterable that reads its frames needs memory for one.
        settings: of the cleaning; ``max_points`` is for all frames together.
        tolerance: relative difference of depths up to which a frame sees the same point.
        views: number of other frames, spread evenly, in which the visibility of a point is tested.

    Raises:
        InputError: there are no frames, nothing is left, or only some frames have colours.
        ValueError: ``tolerance`` is not in (0, 1), ``views`` is negative, or ``frames`` is an iterator.
    """
    settings = settings or DepthSettings()
    if not 0 < tolerance < 1 or views < 0:
        raise ValueError(f"tolerance={tolerance}, views={views}: expected one in (0, 1) and one >= 0")
    if isinstance(frames, Iterator):
        raise ValueError("frames: an iterator, which ends after one pass; expected a list, or what begins anew")
    pool = _Pool(settings)
    # `map`, because the variable of a loop would hold a frame until the next has been read.
    reports = list(map(pool.add, frames))
    if not reports:
        raise InputError("frames: none given; name at least one depth map")
    (cloud, owner), seen_through = pool.joined(), 0
    if len(reports) > 1 and views:
        votes = partial(_votes, cloud.points, owner, _other_frames(len(reports), views), tolerance)
        through = sum(map(votes, count(), frames), np.zeros(len(cloud), np.int64))
        seen_through = int((through > 0).sum())
        cloud = select(cloud, through <= 0)
    cloud = thin(cloud, settings.max_points)
    if not len(cloud):
        raise InputError(f"{pool.source}: the frames see through all of each other's points; check the poses")
    return cloud, _summed(reports, kept=len(cloud), seen_through=seen_through)


class _Pool:
    """The points of the frames so far and the number of their frame, thinned to a multiple of those that stay."""

    def __init__(self, settings: DepthSettings) -> None:
        self.settings = settings
        self.clouds: list[PointCloud] = []
        self.owners: list[Int32] = []
        self.frames = 0
        self.source, self.colored = "", False

    def add(self, frame: RgbdFrame) -> DepthReport:
        """Add the points of the next frame."""
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
        if sum(map(len, self.clouds)) > 2 * FUSION.room * self.settings.max_points:
            cloud, owner = self.joined()
            kept = spread(cloud.points, FUSION.room * self.settings.max_points)
            self.clouds, self.owners = [select(cloud, kept)], [owner[kept]]
        return report

    def joined(self) -> tuple[PointCloud, Int32]:
        """All points, and the number of the frame of each."""
        points, normals, colors = zip(*((each.points, each.normals, each.colors) for each in self.clouds), strict=True)
        colors = np.concatenate(colors) if self.colored else None
        cloud = PointCloud(np.concatenate(points), np.concatenate(normals), colors, self.source)
        return cloud, np.concatenate(self.owners)


def _other_frames(frames: int, limit: int) -> Int64:
    """At most ``limit`` of the other frames, evenly spread, for each frame ``(frames, K)``."""
    others = np.linspace(0, frames - 2, min(limit, frames - 1)).round().astype(np.int64)
    return others + (others >= np.arange(frames)[:, None])


def _votes(points: Float64, owner: Int32, others: Int64, tolerance: float, index: int, frame: RgbdFrame) -> Int64:
    """Votes of a frame, see `_verdict`, on the points ``(N, 3)`` of frames with it among their ``others``; else 0."""
    mine = np.flatnonzero((others == index).any(axis=1)[owner])
    votes = np.zeros(len(points), np.int64)
    votes[mine] = _verdict(points[mine], frame, tolerance)
    return votes


def _verdict(points: Float64, frame: RgbdFrame, tolerance: float) -> Int64:
    """For each point ``(N, 3)`` in world coordinates: 1 if the frame sees through it, −1 if it sees it, else 0."""
    # The least among a pixel and its eight neighbours, or 0 where one has no reading: so slanted surfaces, and rims in
    # front of a far background, are not seen through.
    nearest = np.asarray(cv2.erode(np.nan_to_num(frame.depth, nan=0.0), np.ones((3, 3), np.uint8)), np.float64)
    pixels, depths, inside = frame.view.in_view(points)
    index = np.flatnonzero(inside)
    u, v = np.rint(pixels[index]).astype(np.int64).T
    u, v = u.clip(0, frame.camera.width - 1), v.clip(0, frame.camera.height - 1)
    z, there = depths[index], np.nan_to_num(frame.depth[v, u], nan=0.0)
    verdict = np.zeros(len(points), np.int64)
    verdict[index] = (z < (1 - tolerance) * nearest[v, u]).astype(np.int64)
    verdict[index[np.abs(z - there) <= tolerance * there]] = -1
    return verdict


def _summed(reports: Sequence[DepthReport], *, kept: int, seen_through: int) -> DepthReport:
    """One report of all frames."""
    counts = ("pixels", "without_reading", "out_of_range", "edges", "grazing", "specks")
    return dataclasses.replace(
        reports[0],
        **{name: sum(getattr(report, name) for report in reports) for name in counts},
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
