"""Depth edges, noise, smoothing and normals on the pixel grid of a depth map; depth is NaN without reading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError
from ...neural_fields.backend.arrays import Float64, Mask


@dataclass(frozen=True)
class SmoothingOptions:
    """How noise of depth maps is measured and smoothed."""

    max_radius: int = 12  # pixels; larger windows round off details
    blocks: tuple[int, int] = (2, 4)  # sides in pixels of the blocks over which noise may be correlated
    alike: float = 2.0  # noise of block means over that of independent noise, from which noise counts as correlated
    least_noise: float = 1e-4  # lower bound of the relative noise of readings that are smoothed


SMOOTHING = SmoothingOptions()


def _breaks(depth: Float64, axis: int, *, pixel_angle: float, jump: float, incidence: float) -> Mask:
    """Breaks of the surface between neighbours along ``axis``; one shorter than ``depth`` along it.

    A step is a break if it is longer than the sum of three lengths. These are ``jump`` times the nearer depth, the step
    of a plane at ``incidence``, and 1.5 times the smaller step of the same sign beside it (a steep floor continues).
    """
    z = np.moveaxis(depth, axis, 1)
    step = np.diff(z, axis=1)
    beside = np.pad(step, ((0, 0), (1, 1)), constant_values=np.nan)
    before, after = beside[:, :-2], beside[:, 2:]
    way = np.sign(step)
    # fmin ignores a missing reading on one side.
    along = np.nan_to_num(np.fmin(before * way, after * way)).clip(min=0)
    nearer = np.fmin(z[:, :-1], z[:, 1:])
    slack = jump + pixel_angle * math.tan(math.radians(incidence))
    return np.moveaxis(np.abs(step) > slack * nearer + 1.5 * along, 1, axis)


def edge_pixels(depth: Float64, *, pixel_angle: float, jump: float = 0.01, incidence: float = 75.0) -> Mask:
    """Mask ``(H, W)`` of the pixels on either side of a break, where sensors mix near and far.

    ``pixel_angle`` is the width of a pixel at depth 1, ``jump`` the largest relative step of noise, ``incidence`` the
    angle of view in degrees up to which a plane has no breaks. Of a ramp over several pixels, only the ends are marked.
    """
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        broken = _breaks(depth, axis, pixel_angle=pixel_angle, jump=jump, incidence=incidence)
        after, before = both_sides(broken, axis)
        edges |= after | before
    return edges


def both_sides(steps: NDArray[Any], axis: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Steps between neighbours along ``axis`` → the step after and the step before each element, 0 at the ends."""
    sides = ([width if k == axis else (0, 0) for k in range(steps.ndim)] for width in ((0, 1), (1, 0)))
    after, before = (np.pad(steps, side) for side in sides)
    return after, before


def noise_of(depth: Float64, *, jump: float = 0.01) -> float:
    """Relative standard deviation of the readings, from second differences of inverse depth along both axes.

    Inverse depth is linear on the image of a plane. The second difference of independent Gaussian noise σ has the mean
    magnitude √(2/π) √6 σ. Those above ``√6 · jump`` are edges and do not count; quantisation does.
    """
    inverse = 1 / depth
    found = []
    for axis in (0, 1):
        w = np.moveaxis(inverse, axis, 1)
        if w.shape[1] >= 3:
            second = np.abs(w[:, :-2] - 2 * w[:, 1:-1] + w[:, 2:]) / w[:, 1:-1]
            found.append(second[second < math.sqrt(6) * jump])
    values = np.concatenate(found) if found else np.empty(0)
    return float(values.mean() / math.sqrt(12 / math.pi)) if len(values) else 0.0


class Noise(NamedTuple):
    """The noise of a depth map."""

    deviation: float  # relative standard deviation of the readings
    radius: int  # of the smoothing window in pixels; see `smoothing_radius`
    patchy: bool  # whether it is correlated over several pixels, as that of a Kinect with its quantised steps


def measure_noise(depth: Float64, *, pixel_angle: float, jump: float = 0.01) -> Noise:
    """Measure noise of pixels, and of means of blocks, which shows whether it is correlated over several pixels.

    Independent noise is s times less in means of s × s pixels. Of correlated noise the means are measured, as readings
    s pixels apart: second differences of pixels see little of it.
    """
    fine = noise_of(depth, jump=jump)
    found = Noise(fine, smoothing_radius(fine, pixel_angle), patchy=False)
    if not found.radius:
        return found
    for side in SMOOTHING.blocks:
        coarse = noise_of(_block_means(depth, side), jump=jump)
        if side * coarse > SMOOTHING.alike * fine:
            radius = side * smoothing_radius(coarse, side * pixel_angle)
            found = Noise(
                max(found.deviation, coarse), min(max(found.radius, radius), SMOOTHING.max_radius), patchy=True
            )
    return found


def _block_means(depth: Float64, side: int) -> Float64:
    """Harmonic means over blocks, because inverse depth is linear on planes; NaN where a reading is missing."""
    rows, columns = depth.shape[0] // side, depth.shape[1] // side
    blocks = (1 / depth[: rows * side, : columns * side]).reshape(rows, side, columns, side)
    return 1 / blocks.mean(axis=(1, 3))


def smoothing_radius(noise: float, pixel_angle: float, *, tilt: float = 3.0) -> int:
    """The smallest window radius in pixels where relative noise tilts a fitted plane by less than ``tilt`` degrees.

    The slope of a plane through (2r + 1)² readings of noise σ one pixel apart has the standard deviation
    ``σ √(3 / (r (r + 1) (2r + 1)²))``. At radius 0 it is that of central differences, σ / √2.
    """
    limit = math.tan(math.radians(tilt)) * pixel_angle
    if noise / math.sqrt(2) <= limit:
        return 0
    for radius in range(1, SMOOTHING.max_radius):
        if noise * math.sqrt(3 / (radius * (radius + 1) * (2 * radius + 1) ** 2)) <= limit:
            return radius
    return SMOOTHING.max_radius


def smooth_depth(
    depth: Float64, radius: int, *, noise: float, color: NDArray[np.uint8] | None = None, contrast: float = 30.0
) -> Float64:
    """Average inverse depths, which are linear on planes, by a joint bilateral filter; NaN where ``depth`` is.

    The guide is the logarithm of depth over three σ and, of a picture ``(H, W, 3)``, brightness and red-blue contrast
    over ``contrast`` of 255. Readings and their mask are filtered alike and divided, which leaves missing ones out.
    """
    known = np.isfinite(depth)
    if radius == 0 or not known.any():
        return depth
    scale = float(np.median(depth[known]))
    relative = np.where(known, depth / scale, 1.0)
    guide = np.zeros((*depth.shape, 3), np.float32)
    guide[..., 0] = np.log(relative) / (3 * max(noise, SMOOTHING.least_noise))
    if color is not None:
        red, green, blue = np.moveaxis(color.astype(np.float32), 2, 0)
        guide[..., 1] = (0.299 * red + 0.587 * green + 0.114 * blue) / contrast
        guide[..., 2] = (red - blue) / contrast
    inverse = np.where(known, 1 / relative, 0.0).astype(np.float32)
    size, spread = 2 * radius + 1, radius / 1.5
    if not hasattr(cv2, "ximgproc"):
        fix = "pip install --force-reinstall opencv-contrib-python-headless, or --smooth-depth 0"
        raise InputError(f"cv2: another package has replaced OpenCV by a build without its contributed modules; {fix}")
    blend = cv2.ximgproc.jointBilateralFilter
    weights = blend(guide, known.astype(np.float32), size, 1.0, spread)
    total = blend(guide, inverse, size, 1.0, spread)
    usable = known & (total > 0)
    return np.divide(scale * weights, total, out=np.full(depth.shape, np.nan), where=usable)


def grid_normals(points: Float64, *, pixel_angle: float, jump: float = 0.01, radius: int = 0) -> Float64:
    """Unit normals ``(H, W, 3)`` of a grid of points ``(H, W, 3)`` in camera coordinates, facing the camera.

    Tangents are means of the steps to both neighbours without breaks (see `edge_pixels`), or over windows of a
    ``radius``. NaN where a tangent is missing.
    """
    tangents = []
    for axis in (0, 1):
        step = np.diff(points, axis=axis)
        usable = np.isfinite(step).all(axis=2) & ~_breaks(
            points[..., 2], axis, pixel_angle=pixel_angle, jump=jump, incidence=75.0
        )
        tangents.append(_mean_step(np.where(usable[..., None], step, 0.0), usable, axis, radius))
    normals = np.cross(tangents[1], tangents[0])
    away = (normals * points).sum(axis=2, keepdims=True) > 0
    normals = np.where(away, -normals, normals)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return np.divide(normals, length, out=np.full_like(normals, np.nan), where=length > 0)


def _mean_step(step: Float64, usable: Mask, axis: int, radius: int) -> Float64:
    """Mean of the usable steps at a pixel, or in its window; NaN where there is none."""
    count, total = np.add(*both_sides(usable.astype(np.float64), axis)), np.add(*both_sides(step, axis))
    size = (2 * radius + 1, 2 * radius + 1)
    if radius:
        count = np.asarray(cv2.boxFilter(count, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT))
        total = np.asarray(cv2.boxFilter(total, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT))
    count = count.round()[..., None]  # the box filter leaves rounding errors instead of 0
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def specks(kept: Mask, smallest: int) -> Mask:
    """Mask of the pixels of ``kept`` ``(H, W)`` in 4-connected pieces of fewer than ``smallest`` pixels."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(kept.astype(np.uint8), connectivity=4)
    small = statistics[:, cv2.CC_STAT_AREA] < smallest
    return kept & small[np.asarray(labels, np.int64)]
