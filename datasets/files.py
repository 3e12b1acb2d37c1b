"""Files as the readers of all rooms open them: JSON, NumPy arrays and images, and one line about what is wrong."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError

__all__ = [
    "DAMAGED_ARRAYS",
    "decode_image",
    "finite_number",
    "numeric",
    "read_arrays",
    "read_image",
    "read_json",
    "read_rgb",
    "readable",
    "rgb_and_alpha",
    "unit_range",
]

DAMAGED_ARRAYS = (ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error)
"""What NumPy's loaders raise on files that are not whole, or not theirs."""


@contextmanager
def readable(path: Path, *, missing: str = "check the path") -> Iterator[None]:
    """A block that reads ``path``: what the disc refuses becomes one line.

    Args:
        path: the file, which the message names.
        missing: what to do if there is no such file.

    Raises:
        InputError: the block raised an OSError.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{error.filename or path}: no such file; {missing}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check its permissions") from error


def read_json(path: Path, *, missing: str = "check the path") -> Any:
    """What a JSON file in UTF-8 holds.

    Args:
        path: the file.
        missing: see `readable`.

    Raises:
        InputError: the file cannot be read, or is no JSON.
    """
    with readable(path, missing=missing):
        data = path.read_bytes()
    try:
        return json.loads(data.decode("utf-8"))
    except ValueError as error:  # both of JSON and of UTF-8
        raise InputError(f"{path}: is not JSON ({error}); export it again") from error


def finite_number(value: Any, named: str) -> float:
    """A number of a JSON file.

    Args:
        value: what stands there.
        named: file and field, as the beginning of the message.

    Raises:
        InputError: it is no finite number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{named}: {value!r}; expected a finite number")
    return float(value)


def read_arrays(
    path: Path, choose: Callable[[list[str]], Iterable[str]] = lambda names: names
) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """The array of an NPY file, or the arrays of an NPZ archive by their names.

    Args:
        path: the file; its content says which of both it is.
        choose: of the names in an archive, those that are to be read; may raise its own InputError.

    Raises:
        InputError: the file cannot be read, is damaged, or holds Python objects.
    """
    named = f"{path}"
    try:
        with readable(path), path.open("rb") as file:  # by itself np.load leaves damaged files open
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return loaded
            arrays = {}
            for name in choose(loaded.files):
                named = f"{path}: {name}"
                arrays[name] = loaded[name]
            return arrays
    except InputError:
        raise
    except DAMAGED_ARRAYS as error:
        reason = "holds Python objects" if "Object arrays" in str(error) else "damaged or not a NumPy file"
        raise InputError(f"{named}: {reason}; export it again as plain numbers") from error


def numeric(array: NDArray[Any], named: str) -> NDArray[Any]:
    """The array, if it holds numbers.

    Raises:
        InputError: it holds anything else; ``named`` is the beginning of the message.
    """
    if array.dtype.kind not in "fiu":
        raise InputError(f"{named}: type {array.dtype}; expected numbers")
    return array


def read_image(path: Path) -> NDArray[Any]:
    """An image file ``(H, W)`` or ``(H, W, C)`` as it is stored; see `decode_image`.

    Raises:
        InputError: the file is missing, damaged or no image.
    """
    with readable(path):
        data = path.read_bytes()
    try:
        return decode_image(data)
    except ValueError as error:
        raise InputError(f"{path}: cannot be decoded as an image; export it again") from error


def read_rgb(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """A picture of 8 or 16 bits → its colours ``(H, W, 3)`` as stored, and its opacity ``(H, W)`` if it has any.

    Raises:
        InputError: the file is missing, damaged or no such picture.
    """
    stored = read_image(path)
    if stored.dtype not in (np.uint8, np.uint16) or stored.shape[2:] not in ((), (1,), (3,), (4,)):
        raise InputError(f"{path}: {stored.dtype} of shape {stored.shape}; expected a picture with 8 or 16 bits")
    return rgb_and_alpha(stored)


def decode_image(data: bytes) -> NDArray[Any]:
    """The bytes of an image file → ``(H, W)``, ``(H, W, 3)`` RGB or ``(H, W, 4)`` RGBA, with the bits of the file.

    How the camera was held (EXIF) is not asked: cameras and texture coordinates belong to the pixels as stored.

    Raises:
        ValueError: it is no image, or of a kind that is not read.
    """
    # imread would not say why it fails, and has trouble with names that are not ASCII.
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is not None:
        stored = np.asarray(image)
        if stored.ndim == 3 and stored.shape[2] in (3, 4):  # OpenCV: blue first
            stored[..., :3] = stored[..., 2::-1].copy()
        return stored
    import imageio.v3 as iio  # here: loading it takes a fifth of a second, and what OpenCV does not know (TGA) is rare

    try:
        return np.asarray(iio.imread(data, plugin="pillow"))
    except Exception as error:  # Pillow's readers raise whatever they trip over
        raise ValueError("not an image that can be read") from error


def rgb_and_alpha(stored: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """The colours ``(H, W, 3)`` of what `decode_image` gives, grey as RGB, and its opacity ``(H, W)`` if it has any."""
    planes = stored.reshape(*stored.shape[:2], -1)
    colors = 3 if planes.shape[2] > 2 else 1
    rgb = np.ascontiguousarray(np.broadcast_to(planes[..., :colors], (*planes.shape[:2], 3)))
    return rgb, planes[..., colors] if planes.shape[2] > colors else None


def unit_range(stored: NDArray[Any]) -> NDArray[np.float32]:
    """Whole numbers of b bits as shares of the largest, 2^b − 1; floating-point numbers are cut to [0, 1]."""
    if np.issubdtype(stored.dtype, np.integer):
        return stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    return stored.astype(np.float32).clip(0, 1)
