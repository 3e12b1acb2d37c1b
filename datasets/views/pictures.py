"""Photographs and masks: from files to numbers in [0, 1], from distorted to those of a pinhole, to fewer pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cameras import Camera, intrinsics
from ..color_space import linear_to_srgb, srgb_to_linear
from ..files import read_rgb, unit_range

__all__ = ["read_mask", "read_picture", "resample", "shrink", "undistort", "undistorted_camera"]

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

EXACT = 0.01  # pixels that distorting an undistorted point may miss it by


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


def undistorted_camera(camera: Camera) -> Camera:
    """The pinhole whose whole image a distorted camera has seen.

    It stands where the camera stands and has as many pixels. Its image is the largest rectangle, in the plane at depth
    1, with none of the distorted image's border inside it; so nothing is black, and no mask of valid pixels is needed.

    Raises:
        ValueError: the distortion folds the image over, so that it cannot be undone.
    """
    if not camera.distortion:
        return camera
    across, down = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    right, bottom = np.float64(camera.width - 1), np.float64(camera.height - 1)
    x0, x1 = (_border(camera, np.broadcast_to(x, down.shape), down)[:, 0] for x in (0 * right, right))
    y0, y1 = (_border(camera, across, np.broadcast_to(y, across.shape))[:, 1] for y in (0 * bottom, bottom))
    (left, width), (top, height) = (x0.max(), x1.min() - x0.max()), (y0.max(), y1.min() - y0.max())
    if not (width > 0 and height > 0):
        raise ValueError(f"distortion={camera.distortion}: leaves nothing of the image")
    fx, fy = right / width, bottom / height
    pinhole = replace(camera, intrinsics=intrinsics(fx, fy, -fx * left, -fy * top), distortion=())
    x, y = _maps(camera, pinhole)
    # Where neighbours change places, two directions share a pixel.
    if np.diff(x, axis=1).min() <= 0 or np.diff(y, axis=0).min() <= 0:
        raise ValueError(f"distortion={camera.distortion}: folds the image over")
    return pinhole


def undistort(image: Float32, camera: Camera, pinhole: Camera) -> Float32:
    """What ``pinhole`` sees, taken out of a distorted picture by linear interpolation.

    Args:
        image: ``(H, W)`` or ``(H, W, C)``, C at most 4.
        camera: of the distorted picture.
        pinhole: from `undistorted_camera`.
    """
    x, y = _maps(camera, pinhole)
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _maps(camera: Camera, pinhole: Camera) -> tuple[Float32, Float32]:
    """Where in the distorted picture the pixels of the pinhole are, ``(H, W)`` each."""
    size, target = (pinhole.width, pinhole.height), pinhole.intrinsics.numpy()
    x, y = cv2.initUndistortRectifyMap(*camera.for_opencv, np.eye(3), target, size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def _border(camera: Camera, x: Float64, y: Float64) -> Float64:
    """The slopes ``(N, 2)`` at pixels x, y ``(N,)``, if they lead back to them."""
    pixels = np.stack((x, y), axis=1)
    slopes = camera.slopes_at(pixels)
    if not np.abs(camera.pixels_at(slopes) - pixels).max() < EXACT:
        raise ValueError(f"distortion={camera.distortion}: cannot be undone at the image's border")
    return slopes
