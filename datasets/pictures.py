"""Photographs and masks from files, as numbers in [0, 1], and what may be done with their light."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .color_space import linear_to_srgb, srgb_to_linear

__all__ = ["read_mask", "read_picture", "resample", "shrink"]

Float32 = NDArray[np.float32]


def read_picture(path: Path) -> tuple[Float32, Float32 | None]:
    """Read a picture of 8 or 16 bits → ``(H, W, 3)`` display RGB, and ``(H, W)`` opacity if it has any.

    The colours are as they stand in the file, not multiplied by the opacity. Grey becomes RGB. How the camera was
    held (EXIF) is not asked: the cameras of all our formats belong to the pixels as they are stored.

    Raises:
        InputError: the file is missing, damaged or no picture.
    """
    image = _decode(path)
    color = np.repeat(image[..., :1], 3, axis=2) if image.shape[2] == 1 else image[..., 2::-1]  # OpenCV: blue first
    return _share(color), _share(image[..., 3]) if image.shape[2] == 4 else None


def read_mask(path: Path) -> Float32:
    """Read a mask of any bit depth, grey or RGB → ``(H, W)``: 1 where it is more than half of white, else 0.

    A file whose largest number is 1 is taken to count from 0 to 1.

    Raises:
        InputError: the file is missing, damaged or no picture.
    """
    image = _decode(path)[..., :3]
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


def _decode(path: Path) -> NDArray[Any]:
    """``(H, W, C)`` as stored, in 8 or 16 bits."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    try:
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"{path}: cannot be decoded as an image; export it again")
    stored = np.asarray(image)
    stored = stored[..., None] if stored.ndim == 2 else stored
    if stored.dtype not in (np.uint8, np.uint16) or stored.shape[2] not in (1, 3, 4):
        raise InputError(f"{path}: {stored.dtype} of shape {stored.shape}; expected a picture with 8 or 16 bits")
    return stored


def _share(stored: NDArray[Any]) -> Float32:
    return stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
