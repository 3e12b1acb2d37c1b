"""Point clouds in pieces: what files hold, without ever holding all of it.

Binary PLY, NPY and LAS files say in their first bytes how many points they hold and how each one is written. Their
rows are mapped into memory one piece at a time, so that what is held does not depend on how long the file is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....neural_fields import InputError
from ..point_cloud import PointCloud

__all__ = ["CloudStream", "MemoryStream", "RawRows", "TableStream"]


class RawRows(NamedTuple):
    """Some points as a file holds them.

    Attributes:
        points: ``(n, 3)``, of any type of number; may hold NaN.
        normals: ``(n, 3)``, not necessarily of unit length, or None.
        colors: ``(n, 3)`` as they are stored, or None; see `colors_from`.
    """

    points: NDArray[Any]
    normals: NDArray[Any] | None
    colors: NDArray[Any] | None


class CloudStream(ABC):
    """A cloud that is read in pieces, as often as needed.

    Attributes:
        source: what messages call it.
        count: how many points.
    """

    source: str
    count: int

    @abstractmethod
    def pieces(self, rows: int) -> Iterator[RawRows]:
        """All points in their order, up to ``rows`` at a time."""


class MemoryStream(CloudStream):
    """A cloud that is in memory already."""

    def __init__(self, cloud: PointCloud) -> None:
        self.cloud, self.source, self.count = cloud, cloud.source, len(cloud)

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        cloud = self.cloud
        for start in range(0, self.count, rows):
            part = slice(start, start + rows)
            yield RawRows(
                cloud.points[part],
                None if cloud.normals is None else cloud.normals[part],
                None if cloud.colors is None else cloud.colors[part],
            )


class TableStream(CloudStream):
    """Rows of one size in a file, mapped into memory piece by piece.

    Args:
        path: the file.
        offset: where its rows begin, in bytes.
        row: type of one row: a structure, or numbers (``(">f4", (6,))``).
        count: how many rows.
        points: the three columns, by name or by number, that hold the points.
        normals: those of the normals, or None.
        colors: those of the colours, or None.

    Raises:
        InputError: the file ends too early.
    """

    def __init__(
        self,
        path: Path,
        *,
        offset: int,
        row: np.dtype[Any],
        count: int,
        points: tuple[str, str, str] | slice,
        normals: tuple[str, str, str] | slice | None,
        colors: tuple[str, str, str] | slice | None,
    ) -> None:
        if path.stat().st_size < offset + count * row.itemsize:
            raise InputError(
                f"{path}: vertex: the file ends before its {count} rows do (truncated?); copy or export it again"
            )
        self.path, self.source, self.count = path, str(path), count
        self.offset, self.row = offset, row
        self.points, self.normals, self.colors = points, normals, colors

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Rows from ``start`` to ``stop``; their pages are given back when the array goes."""
        at = self.offset + start * self.row.itemsize
        return np.memmap(self.path, self.row, "r", at, (min(stop, self.count) - start,))

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        for start in range(0, self.count, rows):
            table = self.rows(start, start + rows)
            yield RawRows(
                _columns(table, self.points),
                None if self.normals is None else _columns(table, self.normals),
                None if self.colors is None else _columns(table, self.colors),
            )


def _columns(table: NDArray[Any], which: tuple[str, str, str] | slice) -> NDArray[Any]:
    if isinstance(which, slice):
        return np.array(table[:, which])
    return np.stack([table[name] for name in which], axis=1)
