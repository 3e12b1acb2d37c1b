"""What makes a depth map fit to become a surface: edges without curtains, less noise, and normals.

Everything here works on the grid of pixels. Where there is no reading, depth is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Noise",
    "both_sides",
    "edge_pixels",
    "grid_normals",
    "measure_noise",
    "noise_of",
    "smooth_depth",
    "smoothing_radius",
    "specks",
]

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SmoothingOptions:
    """How noise of depth maps is measured and smoothed."""

    max_radius: int = 12  # pixels; beyond that smoothing rounds off what the sensor did see
    blocks: tuple[int, int] = (2, 4)  # sides in pixels of the blocks over which noise may be alike
    alike: float = 2.0  # averages of blocks have so many times the noise that they would have if it were independent
    least_noise: float = 1e-4  # for readings without any noise, whose smoothing somebody asks for


SMOOTHING = SmoothingOptions()


def _breaks(depth: Float64, axis: int, *, pixel_angle: float, jump: float, incidence: float) -> Mask:
    """Between which neighbours along ``axis`` the surface breaks off; one shorter than ``depth`` along it.

    A step from z to z' is a break if it is longer than ``jump`` times the nearer depth (noise), plus what a plane
    seen under ``incidence`` climbs in a pixel, plus one and a half times the step before or after it, whichever is
    less and if it goes the same way: a steep floor goes on on both sides, a step does not.
    """
    z = np.moveaxis(depth, axis, 1)
    step = np.diff(z, axis=1)
    nothing = np.full((len(z), 1), np.nan)
    before = np.concatenate((nothing, step[:, :-1]), axis=1)
    after = np.concatenate((step[:, 1:], nothing), axis=1)
    way = np.sign(step)
    # Where the reading on one side is missing, fmin takes the other; where both are, there is nothing to compare.
    along = np.nan_to_num(np.fmin(before * way, after * way)).clip(min=0)
    nearer = np.fmin(z[:, :-1], z[:, 1:])
    slack = jump + pixel_angle * math.tan(math.radians(incidence))
    return np.moveaxis(np.abs(step) > slack * nearer + 1.5 * along, 1, axis)


def edge_pixels(depth: Float64, *, pixel_angle: float, jump: float = 0.01, incidence: float = 75.0) -> Mask:
    """Pixels ``(H, W)`` on either side of a break of the surface: the rims, and what flies between them.

    Sensors mix near and far there. At a sharp step one pixel on each side goes; of a ramp over several pixels, its
    ends, which leaves between them what `grid_normals` shows to be seen edge-on.

    Args:
        depth: ``(H, W)``, NaN without reading.
        pixel_angle: slope between the rays of neighbouring pixels (1 / focal length in pixels).
        jump: relative step that noise alone may make.
        incidence: degrees between view and normal up to which a plane is never a break, however noisy.
    """
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        broken = _breaks(depth, axis, pixel_angle=pixel_angle, jump=jump, incidence=incidence)
        after, before = both_sides(broken, axis)
        edges |= after | before
    return edges


def both_sides(steps: NDArray[Any], axis: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """What is known between neighbours along ``axis`` → the step after and the step before each of them, 0 at ends."""
    sides = ([width if k == axis else (0, 0) for k in range(steps.ndim)] for width in ((0, 1), (1, 0)))
    after, before = (np.pad(steps, side) for side in sides)
    return after, before


def noise_of(depth: Float64, *, jump: float = 0.01) -> float:
    """Relative standard deviation of the readings, from second differences of inverse depth along both axes.

    Inverse depth is linear on the image of any plane, so planes have none, however steep. Of independent Gaussian
    noise σ, the second difference has √6 σ and the mean of its magnitude is √(2/π) of that. Those above
    ``√6 · jump`` are edges and do not count. Quantised depth counts as noise, as it should.
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
    """What is known of the noise of a depth map.

    Attributes:
        deviation: relative standard deviation of the readings.
        radius: of the window in pixels that averages it away; see `smoothing_radius`.
        patchy: whether it is alike over several pixels, as a Kinect's, whose steps of depth have plateaus between them.
    """

    deviation: float
    radius: int
    patchy: bool


def measure_noise(depth: Float64, *, pixel_angle: float, jump: float = 0.01) -> Noise:
    """Measure noise pixel by pixel, and on averages of blocks, which shows whether it is alike over several pixels.

    Noise that is independent from pixel to pixel is s times less in averages of s × s. Where it hardly gets less, the
    second differences of pixels see little of it, and the averages count: as readings s pixels apart.

    Args:
        depth: ``(H, W)``, NaN without reading.
        pixel_angle: slope between the rays of neighbouring pixels.
        jump: see `noise_of`.
    """
    fine = noise_of(depth, jump=jump)
    found = Noise(fine, smoothing_radius(fine, pixel_angle), patchy=False)
    if not found.radius:  # what is left is shape
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
    """Harmonic means over blocks, since inverse depth is linear on planes; NaN where a reading is missing."""
    rows, columns = depth.shape[0] // side, depth.shape[1] // side
    blocks = (1 / depth[: rows * side, : columns * side]).reshape(rows, side, columns, side)
    return 1 / blocks.mean(axis=(1, 3))


def smoothing_radius(noise: float, pixel_angle: float, *, tilt: float = 3.0) -> int:
    """The smallest window radius in pixels where relative noise tilts a fitted plane by less than ``tilt`` degrees.

    The slope of a plane through (2r + 1)² readings of noise σ one pixel apart has the standard deviation
    ``σ √(3 / (r (r + 1) (2r + 1)²))``; a pixel is ``pixel_angle`` times the depth wide. 0 where single
    differences do (σ / √2), and at most `max_radius`.
    """
    limit = math.tan(math.radians(tilt)) * pixel_angle
    if noise / math.sqrt(2) <= limit:
        return 0
    for radius in range(1, SMOOTHING.max_radius):
        if noise * math.sqrt(3 / (radius * (radius + 1) * (2 * radius + 1) ** 2)) <= limit:
            return radius
    return SMOOTHING.max_radius


def smooth_depth(
    depth: Float64,
    radius: int,
    *,
    noise: float,
    color: NDArray[np.uint8] | None = None,
    contrast: float = 30.0,
) -> Float64:
    """Average inverse depths over windows, weighted by distance, by likeness of depth, and by likeness of colour.

    OpenCV's joint bilateral filter; its guide is the logarithm of depth (coarse steps of the surface are kept) and,
    if there is a picture, its brightness and its red-blue contrast. The weights depend on the guide alone, so
    filtering readings and their mask alike and dividing leaves pixels without reading out. Inverse depth is what
    is averaged because it is linear on planes.

    Args:
        depth: ``(H, W)``, NaN without reading.
        radius: of the windows, in pixels; 0 returns ``depth``.
        noise: relative standard deviation of the readings; see `noise_of`.
        color: ``(H, W, 3)`` display RGB.
        contrast: difference of brightness, of 255, that parts surfaces as much as a step of three σ.

    Returns:
        ``(H, W)``, NaN where ``depth`` is.
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
    inverse = np.where(known, 1 / relative, 0.0).astype(np.float32)  # the filter works in 32 bits; noise is far above
    size, spread = 2 * radius + 1, radius / 1.5
    # Plain builds of OpenCV lack its contributed modules; other packages may have put one of them here.
    blend = cv2.ximgproc.jointBilateralFilter if hasattr(cv2, "ximgproc") else joint_bilateral
    weights = blend(guide, known.astype(np.float32), size, 1.0, spread)
    total = blend(guide, inverse, size, 1.0, spread)
    usable = known & (total > 0)
    return np.divide(scale * weights, total, out=np.full(depth.shape, np.nan), where=usable)


def joint_bilateral(
    guide: NDArray[np.float32], image: NDArray[np.float32], size: int, spread: float, reach: float
) -> NDArray[np.float32]:
    """OpenCV's ``ximgproc.jointBilateralFilter``: averages over discs, weighted by nearness in the guide and in place.

    A pixel q at distance |q − p| ≤ size / 2 counts exp(−‖g(q) − g(p)‖₁² / (2 spread²) − |q − p|² / (2 reach²)); beyond
    the edges the image is mirrored. OpenCV takes the exponential from a table.

    Args:
        guide: ``(H, W, C)``.
        image: ``(H, W)``.
        size: diameter of the disc in pixels, odd.
        spread: σ of differences in the guide.
        reach: σ of distances in pixels.
    """
    radius, (rows, columns) = size // 2, image.shape
    near = np.pad(guide, ((radius, radius), (radius, radius), (0, 0)), mode="reflect")
    values = np.pad(image, radius, mode="reflect")
    total, weights = np.zeros_like(image), np.zeros_like(image)
    for down in range(size):
        for right in range(size):
            away = (down - radius) ** 2 + (right - radius) ** 2
            if away > radius**2:
                continue
            part = slice(down, down + rows), slice(right, right + columns)
            apart = np.abs(near[part] - guide).sum(axis=2)
            weight = np.exp(-(apart**2) / (2 * spread**2) - away / (2 * reach**2)).astype(np.float32)
            total += weight * values[part]
            weights += weight
    return total / weights


def grid_normals(points: Float64, *, pixel_angle: float, jump: float = 0.01, radius: int = 0) -> Float64:
    """Unit normals ``(H, W, 3)`` of a grid of points ``(H, W, 3)`` in camera coordinates, facing the camera.

    The cross product of the tangents along columns and rows; each tangent is the mean of the steps to the
    neighbours on either side (a central difference, one-sided at breaks; see `edge_pixels`), and with a ``radius``
    the mean over the window. NaN where a tangent is missing.
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
    """Mean of the usable steps that touch a pixel, or of its window; NaN where there is none."""
    count, total = np.add(*both_sides(usable.astype(np.float64), axis)), np.add(*both_sides(step, axis))
    size = (2 * radius + 1, 2 * radius + 1)
    if radius:
        count = np.asarray(cv2.boxFilter(count, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT))
        total = np.asarray(cv2.boxFilter(total, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT))
    count = count.round()[..., None]  # a box filter adds and subtracts, and leaves rounding where it should leave 0
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def specks(kept: Mask, smallest: int) -> Mask:
    """Pixels of ``kept`` ``(H, W)`` in pieces (joined along rows and columns) of fewer than ``smallest`` pixels."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(kept.astype(np.uint8), connectivity=4)
    small = statistics[:, cv2.CC_STAT_AREA] < smallest
    return kept & small[np.asarray(labels, np.int64)]
