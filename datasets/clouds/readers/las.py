"""LAS and LAZ (airborne and terrestrial laser scans), through laspy."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ....neural_fields import InputError
from ..point_cloud import PointCloud, colors_from, columns_of
from .stream import CloudStream, RawRows

__all__ = ["LasStream", "read_las"]

# Of the public header (LAS 1.4 R15, 2.4): version, sizes, how many records and points; the last part is of 1.4 alone.
_VERSION = struct.Struct("<BB"), 24
_SIZES = struct.Struct("<HIIBHI"), 94
_SIZES_14 = struct.Struct("<QIQ"), 235
_RECORD, _LATE_RECORD = 54, 60  # bytes of a variable-length record, and of one after the points, without their content
_COMPRESSED = 0x80  # in the point format
_DENSEST = 256  # points in a byte of LAZ, which makes 94 of a point repeated and 67 of a plane's grid


def read_las(path: Path) -> PointCloud:
    """Read points, and colours and normals where the file has them.

    Raises:
        InputError: laspy is not installed, or it cannot read the file.
    """
    laspy = _laspy(path)
    _check_sizes(path)
    try:
        las: Any = laspy.read(path)
        points = np.stack((las.x, las.y, las.z), axis=1).astype(np.float64)
    except OSError:
        raise
    except Exception as error:  # laspy lets through its own errors and those of its decompressors
        raise _unreadable(path, error) from error
    names = set(las.point_format.dimension_names)
    colors = np.stack((las.red, las.green, las.blue), axis=1) if "red" in names else None
    # without colours, writers fill the columns with zeros
    colors = None if colors is None or not colors.any() else colors_from(colors)
    triple = columns_of(names, "normals")
    normals = None if triple is None else np.stack([las[name] for name in triple], axis=1).astype(np.float32)
    return PointCloud(points, normals, colors, str(path))


class LasStream(CloudStream):
    """A LAS or LAZ file, read in pieces.

    Args:
        path: the file.

    Raises:
        InputError: laspy is not installed, or it cannot read the file; also while pieces are read.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.source, self.laspy = path, str(path), _laspy(path)
        _check_sizes(path)
        try:
            with self.laspy.open(path) as reader:
                self.count = int(reader.header.point_count)
                names = set(reader.header.point_format.dimension_names)
        except OSError:
            raise
        except Exception as error:  # see `read_las`
            raise _unreadable(path, error) from error
        self.normals = columns_of(names, "normals")
        self.colored = "red" in names
        # without colours, writers fill the columns with zeros
        self.colored = self.colored and any(
            piece.colors.any() for piece in self.pieces(1 << 20) if piece.colors is not None
        )

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        try:
            with self.laspy.open(self.path) as reader:
                for part in reader.chunk_iterator(rows):
                    yield RawRows(
                        np.stack((part.x, part.y, part.z), axis=1).astype(np.float64),
                        None if self.normals is None else np.stack([part[name] for name in self.normals], axis=1),
                        np.stack((part.red, part.green, part.blue), axis=1) if self.colored else None,
                    )
        except OSError:
            raise
        except Exception as error:  # see `read_las`
            raise _unreadable(self.path, error) from error


def _check_sizes(path: Path) -> None:
    """Refuse a header that claims more than the file can hold; laspy believes it, and loops or allocates for it."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if head[:4] != b"LASF" or len(head) < 227:
        raise InputError(f"{path}: not a readable LAS file (no header); export it again")
    header, start, records, form, length, points = _at(head, _SIZES)
    late_start, late = size, 0
    if _at(head, _VERSION) >= (1, 4) and len(head) == 375:
        late_start, late, points = _at(head, _SIZES_14)
    compressed = bool(form & _COMPRESSED)
    room = size - start
    wrong = (
        f"byte 94: a header of {header} bytes before points at {start}, in {size} bytes"
        if not 227 <= header <= start <= size
        else f"byte 100: {records} records in {start - header} bytes"
        if records * _RECORD > start - header
        else f"byte 105: points of {length} bytes"
        if length < 20
        else f"byte 243: {late} records after the points, from byte {late_start} of {size}"
        if late and late_start + late * _LATE_RECORD > size
        else f"{points} points in {room} bytes"
        if points > (room * _DENSEST if compressed else room // length)
        else ""
    )
    if wrong:
        raise InputError(f"{path}: not a readable LAS file ({wrong}); export it again")


def _at(head: bytes, field: tuple[struct.Struct, int]) -> tuple[int, ...]:
    form, offset = field
    return form.unpack_from(head, offset)


def _laspy(path: Path) -> Any:
    try:
        import laspy
    except ImportError as error:
        raise InputError(f"{path}: LAS and LAZ need laspy; pip install mplicits[las]") from error
    return laspy


def _unreadable(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: not a readable LAS file ({_first_line(error)}); export it again")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
