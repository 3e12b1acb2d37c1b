"""Files as the readers of all rooms open them: JSON, NumPy arrays and images, and one line about what is wrong."""

from __future__ import annotations

import functools
import io
import json
import math
import os
import stat
import struct
import threading
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from ..neural_fields.backend.files import damage

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
    "reader",
    "rgb_and_alpha",
    "unit_range",
]

P = TypeVar("P", bound="str | Path")
A = ParamSpec("A")
R = TypeVar("R")

# An archive may hold this many times its own bytes and more than MODEST, and no more: points do not shrink so much.
MOST_UNPACKED, MODEST = 200, 256 << 20

DAMAGED_ARRAYS = (ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What NumPy's loaders raise on files that are not whole, or not theirs."""


@contextmanager
def readable(path: Path, *, missing: str = "check the path") -> Iterator[None]:
    """A block that reads ``path``: what the disc refuses, or the reader trips over, becomes one line.

    Nothing is said but that: no warnings, and nothing that a library prints.

    Args:
        path: the file, which the message names.
        missing: what to do if there is no such file.

    Raises:
        InputError: the block raised anything that is no `InputError`.
    """
    with damage(path, "export it again"), _silence:
        try:
            with suppress(FileNotFoundError, NotADirectoryError):
                mode = path.stat().st_mode
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    raise InputError(f"{path}: is a pipe or a device, and no file; copy what it gives to a file")
            yield
        except FileNotFoundError as error:
            raise InputError(f"{error.filename or path}: no such file; {missing}") from None


class _Silence:
    """A block in which what libraries print to stderr is lost: OpenCV and libpng do on damaged images.

    They write to the file descriptor, so that of the process is turned away; by the first thread that comes in, until
    the last one leaves.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._kept = threading.Lock(), 0, -1

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                with suppress(OSError):  # there is none
                    self._kept = os.dup(2)
                    sink = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(sink, 2)
                    os.close(sink)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside and self._kept >= 0:
                os.dup2(self._kept, 2)
                os.close(self._kept)
                self._kept = -1


_silence = _Silence()


def reader(read: Callable[Concatenate[P, A], R]) -> Callable[Concatenate[P, A], R]:
    """Make a function that reads the file of its first argument refuse it in one line; see `readable`."""

    @functools.wraps(read)
    def reading(path: P, *args: A.args, **kwargs: A.kwargs) -> R:
        with readable(Path(path)):
            return read(path, *args, **kwargs)

    return reading


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
        return json.loads(data.decode("utf-8-sig"))
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
    with readable(path), path.open("rb") as file:  # by itself np.load leaves damaged files open
        try:
            if file.read(6) == b"\x93NUMPY":
                # Mapped first: that fails where the file is shorter than its head says, before anything is allocated.
                return np.array(np.lib.format.open_memmap(path, mode="r"))
            file.seek(0)
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return loaded
            arrays = {}
            for name in choose(loaded.files):
                named = f"{path}: {name}"
                _check_member(loaded.zip, name, path)
                arrays[name] = loaded[name]
            return arrays
        except InputError:
            raise
        except DAMAGED_ARRAYS as error:
            objects = "ython objects" in str(error) or "Object arrays" in str(error)
            reason = "holds Python objects" if objects else "damaged or not a NumPy file"
            raise InputError(f"{named}: {reason}; export it again as plain numbers") from error


def _check_member(archive: zipfile.ZipFile | None, name: str, path: Path) -> None:
    """Refuse an array that says it is larger than what is packed, or what can be believed of so small a file."""
    assert archive is not None, "an archive that is open"
    packed = archive.getinfo(name if name in archive.namelist() else f"{name}.npy")
    if packed.file_size > max(MODEST, MOST_UNPACKED * path.stat().st_size):
        raise InputError(f"{path}: {name}: claims {packed.file_size / 1e9:.3g} GB; export it again, uncompressed")
    with archive.open(packed) as file:
        version = np.lib.format.read_magic(file)
        if version[0] > 2:
            return  # names of columns that are not ASCII: no array of ours, and `numeric` will say so
        head = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
        shape, _, kind = head(file)
        if not kind.hasobject and math.prod(shape) * kind.itemsize > packed.file_size:
            raise InputError(f"{path}: {name}: shape {shape} is more than the archive holds; export it again")


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
        extra = "pip install 'mplicits[heic]', or " if path.suffix.lower() in (".heic", ".heif") else ""
        raise InputError(f"{path}: cannot be decoded as an image ({error}); {extra}export it again") from error


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
    _check_pixels(data)
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

    with suppress(ImportError):
        import pillow_heif

        pillow_heif.register_heif_opener()
    try:
        return np.asarray(iio.imread(data, plugin="pillow"))
    except Exception as error:  # Pillow's readers raise whatever they trip over
        raise ValueError("not an image that can be read") from error


def _check_pixels(data: bytes) -> None:
    """Refuse an image whose header claims far more pixels than its bytes can hold, before they are allocated.

    Raises:
        ValueError: it has more than 32 million pixels, and more than 50 for each byte.
    """
    width = height = 0
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 24:
        width, height = struct.unpack_from(">II", data, 16)
    elif len(data) > 8:
        from PIL import Image

        with suppress(Exception), warnings.catch_warnings():  # Pillow's readers raise whatever they trip over
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as image:
                width, height = image.size
    if width * height > max(32_000_000, 50 * len(data)):
        raise ValueError(f"{width} × {height} pixels in {len(data)} bytes")


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
