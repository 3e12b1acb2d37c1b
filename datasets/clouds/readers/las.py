"""LAS and LAZ (airborne and terrestrial laser scans), through laspy."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ...files import MODEST
from ..point_cloud import PointCloud, colors_from
from .columns import CloudStream, RawRows, Table, describe_layout, named_layout

# Of the public header (LAS 1.4 R15, 2.4): version, sizes, how many records and points; the last part is of 1.4 alone.
_VERSION = struct.Struct("<BB"), 24
_SIZES = struct.Struct("<HIIBHI"), 94
_SCALES = struct.Struct("<3d"), 131
_SIZES_14 = struct.Struct("<QIQ"), 235
LAS_SUFFIXES = (".las", ".laz")
GEO_KEYS = (3072, 2048)  # of GeoTIFF: the projected, and the geographic coordinate system
USER_DEFINED = 32767  # which is no number of EPSG
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of LASzip's items by their kind; extra bytes (14) have one for each byte


class LasStream(CloudStream):
    """A LAS or LAZ file, read in pieces, without the points that are marked as withheld.

    ``columns`` are refused, since LAS files name them; ``drop_noise`` leaves out the classes for noise (7 and 18).
    ``whole`` reads the file once, and gives one piece.
    """

    def __init__(
        self, path: Path, columns: str | None = None, *, drop_noise: bool = False, whole: bool = False
    ) -> None:
        self.path, self.source, self.laspy, self.drop_noise = path, str(path), _laspy(path, columns), drop_noise
        withheld, noise, colored = 0, 0, False
        with _reading(path), self.laspy.open(path) as reader:
            self.count = int(reader.header.point_count)
            self.names = ["x", "y", "z", *(n for n in reader.header.point_format.dimension_names if n not in "XYZ")]
            self.all: list[Any] = [reader.read()] if whole else []
            for part in self.all or reader.chunk_iterator(1 << 20):
                withheld += int(np.count_nonzero(part.withheld))
                noise += int(np.count_nonzero(_is_noise(part)))
                # Without any colours, writers fill the columns with 0.
                colored = colored or (
                    "red" in self.names and bool(part.red.any() or part.green.any() or part.blue.any())
                )
        layout = named_layout(self.names)
        assert layout is not None, "x, y and z are always there"
        self.layout = layout if colored else layout._replace(colors=None)
        classes = f"{noise:,} of noise classes {'left out' if drop_noise else 'kept (--drop-noise)'}"
        notes = [f"{withheld:,} withheld points left out"] * (withheld > 0) + [classes] * (noise > 0)
        table = Table(path, [np.empty(0)] * len(self.names), self.names, notes=tuple(notes))
        self.reading = describe_layout(table, self.layout, self.count - withheld - (noise if drop_noise else 0))

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        with _reading(self.path), self.laspy.open(self.path) as reader:
            for part in self.all or reader.chunk_iterator(rows):
                yield self._rows(part)

    def _rows(self, part: Any) -> RawRows:
        """The points of one piece that are read."""
        kept = np.asarray(part.withheld) == 0
        if self.drop_noise:
            kept &= ~_is_noise(part)
        used = {k for which in self.layout if which is not None for k in which}
        columns = [np.asarray(part[name])[kept] if k in used else np.empty(0) for k, name in enumerate(self.names)]
        return Table(self.path, columns).rows(self.layout)


def _is_noise(part: Any) -> NDArray[np.bool_]:
    return np.isin(np.asarray(part.classification), (7, 18)) & (np.asarray(part.withheld) == 0)


def read_las(path: Path, columns: str | None = None, *, drop_noise: bool = False) -> PointCloud:
    """The points but for withheld ones, with colours and normals if there are any; noise goes with `--drop-noise`."""
    stream = LasStream(path, columns, drop_noise=drop_noise, whole=True)
    points, normals, colors = next(stream.pieces(stream.count))
    normals = None if normals is None else normals.astype(np.float32)
    colors = None if colors is None else colors_from(colors)
    return PointCloud(points, normals, colors, str(path), reading=stream.reading)


def coordinate_system(path: Path) -> str | None:
    """The coordinate reference system of a LAS or LAZ file, as WKT or as EPSG:NUMBER; None if it names none."""
    if path.suffix.lower() not in LAS_SUFFIXES:
        return None
    laspy = _laspy(path, None)
    with _reading(path), laspy.open(path) as reader:
        texts = [record.string for record in reader.header.vlrs.get("WktCoordinateSystemVlr")]
        keys = [key for record in reader.header.vlrs.get("GeoKeyDirectoryVlr") for key in record.geo_keys]
    codes = {key.id: f"EPSG:{key.value_offset}" for key in keys if 0 < key.value_offset < USER_DEFINED}
    words = [*(text.rstrip("\0") for text in texts), *(codes[name] for name in GEO_KEYS if name in codes)]
    return next(filter(None, words), None)


def _check_sizes(path: Path) -> None:
    """Refuse a header that claims more than the file can hold: laspy would loop or allocate for it."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(375)
    if head[:4] != b"LASF" or len(head) < 227:
        raise InputError(f"{path}: not a readable LAS file (no header); export it again")
    header, start, records, form, length, points = _at(head, _SIZES)
    (late_start, late), scales = (size, 0), _at(head, _SCALES)
    if _at(head, _VERSION) >= (1, 4) and len(head) == 375:
        late_start, late, points = _at(head, _SIZES_14)
    compressed = bool(form & 0x80)
    room = size - start
    wrong = (
        f"byte 94: a header of {header} bytes before points at {start}, in {size} bytes"
        if not 227 <= header <= start <= size
        else f"byte 100: {records} records in {start - header} bytes"
        if records * 54 > start - header  # bytes of a record without its content; of a late one, 60
        else f"byte 105: points of {length} bytes"
        if length < 20
        else f"byte 131: scales {scales}"
        if not all(0 < abs(scale) < math.inf for scale in scales)
        else f"byte 243: {late} records after the points, from byte {late_start} of {size}"
        if late and late_start + late * 60 > size
        else f"{points} points in {room} bytes"
        if points > (room * 256 if compressed else room // length)  # LAZ makes 94 points of a byte at the most
        else ""
    )
    if wrong:
        raise _unreadable(path, wrong)
    if compressed and points:
        _check_laz(path, start, points, length)


def _check_laz(path: Path, start: int, points: int, length: int) -> None:
    """Refuse LAZ on which the decompressor would abort or loop: old compressors, and impossible chunk tables.

    Layout (LASzip, "laszip.hpp"): the LASzip record is one of the variable-length records. At ``start`` is the place of
    the chunk table, whose second number is the count of chunks.
    """
    with path.open("rb") as file:
        head, size = file.read(start), path.stat().st_size
        at = head.find(b"laszip encoded")
        record = head[at + 52 : at + 68] if at >= 0 else b""
        if len(record) < 16:
            raise _unreadable(path, "no LASzip record")
        compressor, chunk = struct.unpack_from("<H10xI", record)
        if compressor not in (2, 3):
            raise _unreadable(path, f"LASzip's compressor {compressor}, without chunks")
        (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\xff"))
        if table == -1 and size >= start + 8:  # a writer that could not go back: it stands at the end
            file.seek(-8, 2)
            (table,) = struct.unpack("<q", file.read(8))
        file.seek(table if 0 <= table < size else size)
        entry = file.read(8)
        chunks = int.from_bytes(entry[4:], "little") if len(entry) == 8 else -1
        fixed = chunk not in (0, 2**32 - 1)
        wrong = fixed and (chunks > points // chunk + 1 or chunk * length > max(MODEST, points * length))
        if not 0 <= chunks <= size or wrong or not chunk:  # memory for whole chunks is allocated
            raise _unreadable(path, f"a chunk table of {chunks} chunks of {chunk} points at byte {table}")
        with _reading(path):
            _check_chunks(path, file, (start, table), head[at + 52 :], length)


def _check_chunks(path: Path, file: BinaryIO, place: tuple[int, int], record: bytes, length: int) -> None:
    """Refuse points, chunks and layers that claim more than what holds them has: the decompressor would allocate it.

    The record lists the items of a point; a layered chunk begins with a point, their count, and the layers' sizes.
    """
    try:
        import lazrs
    except ImportError:  # laspy then uses LASzip itself
        return
    (at, end), compressor = place, record[0]
    (count,) = struct.unpack_from("<H", record, 32)
    items = list(struct.iter_unpack("<HHH", record[34 : 34 + 6 * count]))  # kind, size, version
    layers = sum(_LAYERS.get(kind, size) for kind, size, _ in items) if compressor == 3 else 0
    if (whole := sum(size for _, size, _ in items)) != length:
        raise _unreadable(path, f"a LASzip record of points of {whole} bytes, not {length}")
    file.seek(at)
    layout = lazrs.LazVlr(record[: 34 + 6 * count])  # pyright: ignore[reportAttributeAccessIssue]
    at += 8
    for number, (_, size) in enumerate(lazrs.read_chunk_table(file, layout)):  # pyright: ignore
        file.seek(at + length + 4)
        claimed = sum(struct.unpack(f"<{layers}I", file.read(4 * layers))) if size else 0
        at += size
        if at > end or claimed > size:
            raise _unreadable(path, f"chunk {number} claims {max(size, claimed)} bytes")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """A block that calls laspy: whatever it or its decompressor raises becomes one line."""
    try:
        yield
    except (OSError, InputError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:  # a panic of the decompressor, which is written in Rust, is no Exception
        raise _unreadable(path, (str(error).splitlines() or [type(error).__name__])[0]) from error


def _at(head: bytes, field: tuple[struct.Struct, int]) -> tuple[Any, ...]:
    form, offset = field
    return form.unpack_from(head, offset)


def _laspy(path: Path, columns: str | None) -> Any:
    """The library, after a check that it can read the file without harm."""
    if columns is not None:
        raise InputError(f"{path}: --columns is for tables without names; LAS files name their columns")
    try:
        import laspy
    except ImportError as error:
        raise InputError(f"{path}: LAS and LAZ need laspy; pip install mplicits[las]") from error
    _check_sizes(path)
    return laspy


def _unreadable(path: Path, why: str) -> InputError:
    return InputError(f"{path}: not a readable LAS file ({why}); export it again")
