"""Files of all readers: JSON, NumPy arrays, images, and one-line messages about what is wrong."""

from __future__ import annotations

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
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from ..neural_fields.backend.files import damage

# An array of an archive may have MODEST bytes, or MOST_UNPACKED times those of the archive.
MOST_UNPACKED, MODEST = 200, 256 << 20

DAMAGED_ARRAYS = (ValueError, EOFError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""Errors of NumPy's loaders on damaged and foreign files."""

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".npz")


@contextmanager
def readable(path: Path, *, missing: str = "check the path") -> Iterator[None]:
    """A block that reads ``path``: any error becomes an `InputError` of one line, and libraries print nothing.

    ``missing`` is the advice if there is no such file.
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
    """A block in which stderr is discarded: OpenCV and libpng print to it on damaged images.

    They write to the file descriptor of the process. The first thread that enters redirects it, the last one restores.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._kept = threading.Lock(), 0, -1

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                with suppress(OSError):  # no stderr
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


def read_json(path: Path, *, missing: str = "check the path") -> Any:
    """The content of a JSON file in UTF-8; see `readable` for ``missing``."""
    with readable(path, missing=missing):
        try:
            return json.loads(path.read_bytes().decode("utf-8-sig"))
        except ValueError as error:  # both of JSON and of UTF-8
            raise InputError(f"{path}: is not JSON ({error}); export it again") from error


def decoded(data: bytes) -> str:
    """The text of a file in UTF-8 or, with a byte-order mark, UTF-16; lines end in LF, whatever they ended in."""
    wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = data.decode("utf-16" if wide else "utf-8-sig", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def finite_number(value: Any, named: str) -> float:
    """A finite number of a JSON file; ``named`` are file and field, for messages."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{named}: {value!r}; expected a finite number")
    return float(value)


def read_arrays(
    path: Path, choose: Callable[[list[str]], Iterable[str]] = lambda names: names
) -> NDArray[Any] | dict[str, NDArray[Any]]:
    """The array of an NPY file, or the arrays of an NPZ archive by name, of those that ``choose`` returns.

    The content decides which of both the file is.
    """
    named = f"{path}"
    with readable(path), path.open("rb") as file:  # np.load alone leaves damaged files open
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
    """Refuse an array whose header claims more than is packed, or far more than the size of the file allows."""
    assert archive is not None, "an archive that is open"
    packed = archive.getinfo(name if name in archive.namelist() else f"{name}.npy")
    if packed.file_size > max(MODEST, MOST_UNPACKED * path.stat().st_size):
        raise InputError(f"{path}: {name}: claims {packed.file_size / 1e9:.3g} GB; export it again, uncompressed")
    with archive.open(packed) as file:
        version = np.lib.format.read_magic(file)
        if version[0] > 2:
            return  # names of columns that are not ASCII, which `numeric` refuses
        head = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
        shape, _, kind = head(file)
        if not kind.hasobject and math.prod(shape) * kind.itemsize > packed.file_size:
            raise InputError(f"{path}: {name}: shape {shape} is more than the archive holds; export it again")


def numeric(array: NDArray[Any], named: str) -> NDArray[Any]:
    """The array, if it holds numbers; else an InputError that begins with ``named``."""
    if array.dtype.kind not in "fiu":
        raise InputError(f"{named}: type {array.dtype}; expected numbers")
    return array


def read_image(path: Path) -> NDArray[Any]:
    """An image file ``(H, W)`` or ``(H, W, C)`` as stored; see `decode_image`."""
    with readable(path):
        data = path.read_bytes()
    try:
        return decode_image(data)
    except ValueError as error:
        extra = "pip install 'mplicits[heic]', or " if path.suffix.lower() in (".heic", ".heif") else ""
        raise InputError(f"{path}: cannot be decoded as an image ({error}); {extra}export it again") from error


def read_rgb(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """A picture of 8 or 16 bits → its colours ``(H, W, 3)`` as stored, and its opacity ``(H, W)`` if it has any."""
    stored = read_image(path)
    if stored.dtype not in (np.uint8, np.uint16) or stored.shape[2:] not in ((), (1,), (3,), (4,)):
        raise InputError(f"{path}: {stored.dtype} of shape {stored.shape}; expected a picture with 8 or 16 bits")
    return rgb_and_alpha(stored)


def decode_image(data: bytes) -> NDArray[Any]:
    """The bytes of an image file → ``(H, W)``, ``(H, W, 3)`` RGB or ``(H, W, 4)`` RGBA, with the bits of the file.

    EXIF orientations are ignored: cameras and texture coordinates belong to the pixels as stored. A ValueError is
    raised for bytes that are no known image.
    """
    _check_pixels(data)
    # imread gives no reason for a failure, and has trouble with names that are not ASCII.
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is not None:
        stored = np.asarray(image)
        if stored.ndim == 3 and stored.shape[2] in (3, 4):  # OpenCV: blue first
            stored[..., :3] = stored[..., 2::-1].copy()
        return stored
    import imageio.v3 as iio  # here: loading it takes a fifth of a second, and formats unknown to OpenCV are rare

    with suppress(ImportError):
        import pillow_heif

        pillow_heif.register_heif_opener()
    try:
        return np.asarray(iio.imread(data, plugin="pillow"))
    except Exception as error:  # Pillow's readers raise anything
        raise ValueError("not an image that can be read") from error


def _check_pixels(data: bytes) -> None:
    """Refuse an image of more than 32 million pixels and more than 50 for each byte, before they are allocated."""
    width = height = 0
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 24:
        width, height = struct.unpack_from(">II", data, 16)
    elif len(data) > 8:
        from PIL import Image

        with suppress(Exception), warnings.catch_warnings():  # Pillow's readers raise anything
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as image:
                width, height = image.size
    if width * height > max(32_000_000, 50 * len(data)):
        raise ValueError(f"{width} × {height} pixels in {len(data)} bytes")


def rgb_and_alpha(stored: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """The colours ``(H, W, 3)`` of an image of `decode_image`, and its opacity ``(H, W)`` if it has any."""
    planes = stored.reshape(*stored.shape[:2], -1)
    colors = 3 if planes.shape[2] > 2 else 1
    rgb = np.ascontiguousarray(np.broadcast_to(planes[..., :colors], (*planes.shape[:2], 3)))
    return rgb, planes[..., colors] if planes.shape[2] > colors else None


def unit_range(stored: NDArray[Any]) -> NDArray[np.float32]:
    """Integers of b bits over the largest, 2^b − 1; floating-point numbers are clipped to [0, 1]."""
    if np.issubdtype(stored.dtype, np.integer):
        return stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    return stored.astype(np.float32).clip(0, 1)


def to_bytes(stored: NDArray[Any]) -> NDArray[np.uint8]:
    """What `unit_range` takes, in 8 bits: rounded, or unchanged if it has no more."""
    return stored if stored.dtype == np.uint8 else np.rint(255 * unit_range(stored)).astype(np.uint8)


def is_depth_file(path: str | Path) -> bool:
    """Whether a file is a depth map by its name, or, of NPY and NPZ, by the shape of its array.

    A two-dimensional array with at most 12 columns is a table of points, and no depth map.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".npy", ".npz") or not path.is_file():
        return suffix in DEPTH_SUFFIXES[:3]
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if suffix == ".npy":
            return array.ndim == 3 or (array.ndim == 2 and array.shape[1] > 12)
        with array:
            return "points" not in array and len(array.files) > 0
    except (OSError, *DAMAGED_ARRAYS):
        return False  # its reader will report the error
