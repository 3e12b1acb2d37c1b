"""Depth maps and their colour pictures, from files: 16-bit PNG, TIFF, NPY and NPZ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from ..files import DEPTH_SUFFIXES, numeric, read_arrays, read_image, read_rgb, readable, to_bytes

Bytes = NDArray[np.uint8]

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
DEPTH_SCALE = 1000.0
"""Steps of an integer depth image per unit by default: millimetres in a metre."""

ASPECT = 0.01  # largest relative difference of the aspect ratios of one picture


def read_depth(
    path: str | Path,
    *,
    scale: float | None = None,
    integer_scale: float | None = None,
    inverse: bool = False,
    saturates: bool = True,
) -> Float64:
    """Read a depth map.

    Args:
        path: PNG (16 bits), TIFF (16 bits or float), NPY, or NPZ with an array ``depth`` or a single array.
        scale: numbers in the file per unit: 1000 for millimetres, 5000 for the TUM benchmark. None is
            ``integer_scale`` for integers and 1 for floating-point numbers.
        integer_scale: of the camera's integer images; None is 1000.
        inverse: whether the numbers are inverse depths (disparities), ``z = scale / number``; then ``scale`` is by
            default 1.
        saturates: whether the largest number of the type, 65535 and their like in other units are no readings. It is
            ignored for inverse depths, whose largest number is the nearest.

    Returns:
        ``(H, W)`` depth z along the camera's axis; NaN without reading (zero, negative, NaN, infinite, saturated).

    Raises:
        InputError: the file is missing or damaged, has 8 bits or several channels, or no reading at all.
        ValueError: ``scale`` is not positive.
    """
    path = Path(path)
    if scale is not None and not 0 < scale < np.inf:
        raise ValueError(f"scale={scale}: expected a finite number > 0")
    if path.suffix.lower() not in DEPTH_SUFFIXES:
        raise InputError(
            f"{path}: unknown extension {path.suffix!r}; depth maps are read from {', '.join(DEPTH_SUFFIXES)}"
        )
    with readable(path):
        return _depth(path, scale, integer_scale, inverse=inverse, saturates=saturates and not inverse)


def _depth(path: Path, scale: float | None, integer_scale: float | None, *, inverse: bool, saturates: bool) -> Float64:
    numbers = _read_array(path) if path.suffix.lower() in (".npy", ".npz") else read_image(path)
    if numbers.ndim == 3 and 1 in (numbers.shape[0], numbers.shape[2]):
        numbers = numbers[0] if numbers.shape[0] == 1 else numbers[..., 0]
    if numbers.ndim != 2:
        raise InputError(f"{path}: shape {numbers.shape}; expected a depth map of one channel, not a colour picture")
    if numeric(numbers, f"{path}").dtype.itemsize == 1:
        raise InputError(
            f"{path}: 8 bits per pixel cannot hold depths; export 16-bit PNG, TIFF or NPY (is it a picture of them?)"
        )
    values = numbers.astype(np.float64)
    values[~((values > 0) & (values < np.inf))] = np.nan
    if saturates:
        values[_saturated(numbers)] = np.nan
    if np.isnan(values).all():
        raise InputError(f"{path}: no pixel has a positive depth; export it again")
    if inverse:
        return (scale or 1.0) / values
    return values / (scale or (1.0 if numbers.dtype.kind == "f" else integer_scale or DEPTH_SCALE))


def _saturated(numbers: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the largest numbers of sensors and renderers: of 16 bits, of the type, or a far plane's.

    Of floating-point numbers these are 65535, the largest half-precision number, both in metres, and 1e9 and more.
    """
    if numbers.dtype.kind == "f":
        return (numbers >= 1e9) | np.isin(numbers, np.array([65535, 65504, 65.535, 65.504], numbers.dtype))
    return (numbers == 65535) | (numbers == np.iinfo(numbers.dtype).max)


def read_color(path: str | Path) -> Bytes:
    """A colour picture → ``(H, W, 3)`` uint8 display RGB; grey becomes RGB, and transparency is ignored."""
    path = Path(path)
    if path.suffix.lower() not in COLOR_SUFFIXES:
        raise InputError(
            f"{path}: unknown extension {path.suffix!r}; colour pictures are read from {', '.join(COLOR_SUFFIXES)}"
        )
    with readable(path):
        return to_bytes(read_rgb(path)[0])


def fit_color(color: Bytes, size: tuple[int, int], *, source: str, resize: bool = False) -> Bytes:
    """The picture ``(H, W, 3)``, if it has the ``size`` (width, height) of the depth map; else an InputError.

    With ``resize``, a picture of the same aspect ratio is scaled in linear light.
    """
    height, width = color.shape[:2]
    if (width, height) == size:
        return color
    differs = f"{source}: {width} × {height} pixels, but the depth map has {size[0]} × {size[1]}"
    if abs(width * size[1] / (height * size[0]) - 1) > ASPECT:
        raise InputError(f"{differs}; export the picture as the depth camera sees it (registered)")
    if not resize:
        raise InputError(f"{differs}; if both show the same view, add --resize-color")
    linear = srgb_to_linear((color / np.float32(255)).astype(np.float32))
    method = cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(linear, size, interpolation=method), np.float32).clip(0, 1)
    return to_bytes(linear_to_srgb(resized))


def _read_array(path: Path) -> NDArray[np.generic]:
    def choose(names: list[str]) -> list[str]:
        if "depth" not in names and len(names) != 1:
            raise InputError(f"{path}: arrays {', '.join(names)}; expected one, or one called depth")
        return ["depth"] if "depth" in names else names

    loaded = read_arrays(path, choose)
    return loaded if isinstance(loaded, np.ndarray) else next(iter(loaded.values()))
