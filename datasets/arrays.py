"""NPY ``(N, 3 | 6 | 9)`` and NPZ with ``points`` and, optionally, ``normals`` and ``colors``."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .cloud_stream import TableStream
from .point_cloud import PointCloud, colors_from, normals_from
from .text import table_to_cloud

__all__ = ["npy_stream", "read_npy", "read_npz"]

_DAMAGE = (ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error)  # what numpy.load raises on bad files


def read_npy(path: Path) -> PointCloud:
    """Read one array with columns xyz, xyz + normal or xyz + normal + rgb.

    Raises:
        InputError: it is not a NumPy array of numbers with 3, 6 or 9 columns.
    """
    with path.open("rb") as file:
        array = _load(file, path)
    if not isinstance(array, np.ndarray):
        raise InputError(f"{path}: an NPZ archive under another name; rename it to .npz")
    return table_to_cloud(_numeric(array, "array", path), path, f"array of shape {array.shape}: ")


def npy_stream(path: Path, *, sample: int = 100_000) -> TableStream | None:
    """The rows of an array, to be read in pieces; None if that cannot be: only `read_npy` reads such a file.

    Args:
        path: an NPY file.
        sample: so many rows, evenly chosen, tell whether six columns are points and normals or points and colours.

    Raises:
        InputError: see `read_npy`.
    """
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except _DAMAGE:
        return None
    if array.ndim != 2 or not array.flags.c_contiguous or len(array) == 0:
        return None
    _numeric(array, "array", path)
    some = table_to_cloud(np.array(array[:: 1 + len(array) // sample]), path, f"array of shape {array.shape}: ")
    first_color = None if some.colors is None else array.shape[1] - 3
    return TableStream(
        path,
        offset=array.offset,
        row=np.dtype((array.dtype, array.shape[1:])),
        count=len(array),
        points=slice(0, 3),
        normals=None if some.normals is None else slice(3, 6),
        colors=None if first_color is None else slice(first_color, first_color + 3),
    )


def read_npz(path: Path) -> PointCloud:
    """Read ``points`` (N, 3), ``normals`` (float, or int8/int16 over their largest value) and ``colors``.

    Raises:
        InputError: it is not such an archive, or an array has the wrong type or shape.
    """
    with path.open("rb") as file:
        archive = _load(file, path)
        if isinstance(archive, np.ndarray):
            raise InputError(f"{path}: a single NumPy array under another name; rename it to .npy")
        names = archive.files
        if "points" not in names:
            raise InputError(f"{path}: points: no such array (there are: {', '.join(names) or 'none'}); add it")
        wanted = [name for name in ("points", "normals", "colors") if name in names]
        arrays = {name: _member(archive, name, path) for name in wanted}
    points = arrays["points"]
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: points: shape {points.shape}; expected (N, 3)")
    for name, array in arrays.items():
        if array.shape != points.shape:
            raise InputError(f"{path}: {name}: shape {array.shape}; expected {points.shape}, one row per point")
    normals, colors = arrays.get("normals"), arrays.get("colors")
    return PointCloud(
        points.astype(np.float64),
        None if normals is None else normals_from(normals),
        None if colors is None else colors_from(colors),
        str(path),
    )


def _load(file: BinaryIO, path: Path) -> Any:
    try:
        return np.load(file, allow_pickle=False)
    except _DAMAGE as error:
        reason = "holds Python objects" if "Object arrays" in str(error) else "damaged or not a NumPy file"
        raise InputError(f"{path}: {reason}; save plain numbers with numpy.save or numpy.savez") from error


def _member(archive: Any, name: str, path: Path) -> NDArray[Any]:
    try:
        array = archive[name]
    except _DAMAGE as error:
        reason = "holds Python objects" if "Object arrays" in str(error) else "damaged"
        raise InputError(f"{path}: {name}: {reason}; save plain numbers with numpy.savez") from error
    return _numeric(array, name, path)


def _numeric(array: NDArray[Any], name: str, path: Path) -> NDArray[Any]:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path}: {name}: type {array.dtype}; expected numbers")
    return array
