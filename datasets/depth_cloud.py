"""``frame_cloud``: one depth map → an oriented coloured cloud, and what became of its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .clouds.point_cloud import PointCloud, colors_from
from .clouds.reading import MIN_POINTS
from .depth_cleaning import edge_pixels, grid_normals, measure_noise, smooth_depth, specks
from .rgbd import RgbdFrame

__all__ = ["DepthReport", "DepthSettings", "frame_cloud"]

Float64 = NDArray[np.float64]

TYPICAL = 0.99  # share of the points that are nearer than what is called typical
STRAY = 1.5  # what is further away than so many times that makes everything else coarse


@dataclass(frozen=True)
class DepthSettings:
    """How depth maps become clouds.

    Attributes:
        max_depth: readings beyond it are dropped, in the unit of depth; None keeps them.
        jump: step between neighbours, relative to depth, that noise may make; beyond it there is an edge.
        max_incidence: degrees between the view and the normal beyond which a point is dropped: what is seen edge-on
            is hardly measured, and curtains between near and far are.
        smoothing: radius of the smoothing windows in pixels; None is as much as the noise of the readings asks for.
        smallest_piece: pieces of the map with a smaller share of its pixels than this are dropped.
        max_points: of the whole cloud; more are thinned by voxels.

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
    """What became of the pixels of one or several depth maps.

    Attributes:
        frames: depth maps.
        pixels: of all of them.
        without_reading: pixels whose depth the sensor did not give.
        out_of_range: pixels beyond ``max_depth``.
        edges: pixels beside a break of the surface.
        grazing: pixels seen edge-on, or too lonely for a normal.
        specks: pixels in pieces too small to be a surface.
        kept: points of the cloud.
        noise: relative standard deviation of the readings, the median over the frames.
        smoothing: radius of the smoothing windows in pixels, the largest over the frames.
        nearest: the smallest depth of a point kept.
        furthest: the largest one.
        typical: the depth below which 99 % of them are; of several frames, the largest.
        seen_through: points where other frames see free space.
        thinned: points that others stand for, after thinning.
    """

    frames: int
    pixels: int
    without_reading: int
    out_of_range: int
    edges: int
    grazing: int
    specks: int
    kept: int
    noise: float
    smoothing: int
    nearest: float
    furthest: float
    typical: float
    seen_through: int = 0
    thinned: int = 0

    def summary(self) -> str:
        """A few lines for people; lengths are in the unit of the depth map."""
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
        smoothing = f"smoothed over {self.smoothing} pixels" if self.smoothing else "not smoothed"
        lines = [
            f"{maps}: {self.kept:,} points of {self.pixels:,} pixels" + (f"; dropped {parts}" if parts else ""),
            f"depths {self.nearest:.4g} to {self.furthest:.4g} units, noise {self.noise:.2%}, {smoothing}",
        ]
        if self.furthest > STRAY * self.typical:
            limit = f"--max-depth {1.05 * self.typical:.2g}"
            lines.append(f"hint: 99 % of the points are nearer than {self.typical:.3g}; {limit} makes them finer")
        return "\n".join(lines)


def frame_cloud(frame: RgbdFrame, settings: DepthSettings | None = None) -> tuple[PointCloud, DepthReport]:
    """Make an oriented, coloured cloud of a depth map, in world coordinates.

    Depth edges are cut on both sides, the rest is smoothed as far as its noise asks for it, moved out along the
    rays of the pixels, given normals that face the camera, and thinned by voxels.

    Returns:
        The cloud, and what became of the pixels.

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
    # The filter keeps some of the steps between plateaus; the mean of many tangents does not.
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
        typical=float(np.quantile(depth[kept], TYPICAL)),
    )
    return cloud, report
