"""Photographs and masks from files, as numbers in [0, 1], and what may be done with their light.

Distorted photographs → the pictures of a pinhole, with OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras import Camera
from ..color_space import linear_to_srgb, srgb_to_linear
from ..files import read_rgb, unit_range

__all__ = ["read_mask", "read_picture", "resample", "shrink", "undistort", "undistorted_camera"]

Float32 = NDArray[np.float32]


def read_picture(path: Path) -> tuple[Float32, Float32 | None]:
    """Read a picture of 8 or 16 bits → ``(H, W, 3)`` display RGB, and ``(H, W)`` opacity if it has any.

    The colours are as they stand in the file, not multiplied by the opacity. Grey becomes RGB. How the camera was
    held (EXIF) is not asked: the cameras of all our formats belong to the pixels as they are stored.

    Raises:
        InputError: the file is missing, damaged or no picture.
    """
    color, opacity = read_rgb(path)
    return unit_range(color), None if opacity is None else unit_range(opacity)


def read_mask(path: Path) -> Float32:
    """Read a mask of any bit depth, grey or RGB → ``(H, W)``: 1 where it is more than half of white, else 0.

    A file whose largest number is 1 is taken to count from 0 to 1.

    Raises:
        InputError: the file is missing, damaged or no picture.
    """
    image, _ = read_rgb(path)
    white = 1 if image.max() <= 1 else np.iinfo(image.dtype).max
    return (image.max(axis=2) > white / 2).astype(np.float32)


def resample(color: Float32, alpha: Float32 | None, change: Callable[[Float32], Float32]) -> tuple[Float32, Float32]:
    """Average pixels in linear light, each as much as it is opaque.

    Args:
        color: ``(H, W, 3)`` display RGB.
        alpha: ``(H, W)`` opacity; None is 1.
        change: makes of a picture ``(H, W, 4)`` another, each of its pixels a weighted average.

    Returns:
        display RGB and opacity of the new picture.
    """
    weight = np.ones(color.shape[:2], np.float32) if alpha is None else alpha
    light = np.dstack((srgb_to_linear(color) * weight[..., None], weight))
    changed = change(light)
    opacity = changed[..., 3]
    mean = changed[..., :3] / np.where(opacity > 0, opacity, 1)[..., None]
    return linear_to_srgb(mean.clip(0, 1)).astype(np.float32), opacity.clip(0, 1)


def shrink(image: Float32, width: int, height: int) -> Float32:
    """A smaller picture ``(height, width, ...)``, by the averages over its pixels' areas."""
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.float32)


Float64 = NDArray[np.float64]

UNDISTORTION = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)  # OpenCV's own five steps leave 1e-3
EXACT = 0.01  # pixels that distorting an undistorted point may miss it by


def undistorted_camera(camera: Camera, distortion: Sequence[float]) -> Camera:
    """The pinhole whose whole image a distorted camera has seen.

    It stands where the camera stands and has as many pixels. Its image is the largest rectangle, in the plane at depth
    1, with none of the distorted image's border inside it; so nothing is black, and no mask of valid pixels is needed.

    Args:
        camera: what is left of the distorted camera without its distortion.
        distortion: k1, k2, p1, p2, k3, k4, k5, k6 of OpenCV's model, or the first of them.

    Raises:
        ValueError: the distortion folds the image over, so that it cannot be undone.
    """
    if not any(distortion):
        return camera
    across, down = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    right, bottom = np.float64(camera.width - 1), np.float64(camera.height - 1)
    x0, x1 = (_plane(camera, distortion, np.broadcast_to(x, down.shape), down)[:, 0] for x in (0 * right, right))
    y0, y1 = (_plane(camera, distortion, across, np.broadcast_to(y, across.shape))[:, 1] for y in (0 * bottom, bottom))
    (left, width), (top, height) = (x0.max(), x1.min() - x0.max()), (y0.max(), y1.min() - y0.max())
    if not (width > 0 and height > 0):
        raise ValueError(f"distortion={tuple(distortion)}: leaves nothing of the image")
    fx, fy = right / width, bottom / height
    matrix = [[fx, 0, -fx * left], [0, fy, -fy * top], [0, 0, 1]]
    pinhole = replace(camera, intrinsics=torch.tensor(matrix, dtype=torch.float64))
    x, y = _maps(camera, distortion, pinhole)
    # Where neighbours change places, two directions share a pixel.
    if np.diff(x, axis=1).min() <= 0 or np.diff(y, axis=0).min() <= 0:
        raise ValueError(f"distortion={tuple(distortion)}: folds the image over")
    return pinhole


def undistort(image: Float32, camera: Camera, distortion: Sequence[float], pinhole: Camera) -> Float32:
    """What ``pinhole`` sees, taken out of a distorted picture by linear interpolation.

    Args:
        image: ``(H, W)`` or ``(H, W, C)``, C at most 4.
        camera: of the distorted picture, without its distortion.
        distortion: see `undistorted_camera`.
        pinhole: from `undistorted_camera`.
    """
    x, y = _maps(camera, distortion, pinhole)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _maps(camera: Camera, distortion: Sequence[float], pinhole: Camera) -> tuple[Float32, Float32]:
    """Where in the distorted picture the pixels of the pinhole are, ``(H, W)`` each."""
    matrices = camera.intrinsics.numpy(), pinhole.intrinsics.numpy()
    size = (pinhole.width, pinhole.height)
    x, y = cv2.initUndistortRectifyMap(matrices[0], _padded(distortion), np.eye(3), matrices[1], size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _plane(camera: Camera, distortion: Sequence[float], x: Float64, y: Float64) -> Float64:
    """The points ``(N, 2)`` of the plane at depth 1 that the distorted camera sees in pixels x, y ``(N,)``."""
    matrix, coefficients = camera.intrinsics.numpy(), _padded(distortion)
    pixels = np.stack((x, y), axis=1)
    found = cv2.undistortPoints(pixels[:, None], matrix, coefficients, criteria=UNDISTORTION)
    points = np.asarray(found, np.float64).reshape(-1, 2)
    seen = np.column_stack((points, np.ones(len(points))))[:, None]
    again = np.asarray(cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, coefficients)[0]).reshape(-1, 2)
    if not np.abs(again - pixels).max() < EXACT:
        raise ValueError(f"distortion={tuple(distortion)}: cannot be undone at the image's border")
    return points


def _padded(distortion: Sequence[float]) -> Float64:
    """Eight coefficients: OpenCV takes 4, 5 or 8."""
    return np.array((*distortion, *(0.0,) * (8 - len(distortion))), np.float64)
