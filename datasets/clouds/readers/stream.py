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
from .columns import Layout, Triple

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
        count: how many points the file has; pieces may leave some of them out.
        reading: one line about what is read; see `PointCloud`.
    """

    source: str
    count: int
    reading: str = ""

    @abstractmethod
    def pieces(self, rows: int) -> Iterator[RawRows]:
        """All points in their order, up to ``rows`` at a time."""


class MemoryStream(CloudStream):
    """A cloud that is in memory already."""

    def __init__(self, cloud: PointCloud) -> None:
        self.cloud, self.source, self.count, self.reading = cloud, cloud.source, len(cloud), cloud.reading

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
        layout: the columns of the points, the normals and the colours.
        reading: see `CloudStream`.

    Raises:
        InputError: the file ends too early.
    """

    def __init__(
        self, path: Path, *, offset: int, row: np.dtype[Any], count: int, layout: Layout, reading: str
    ) -> None:
        if path.stat().st_size < offset + count * row.itemsize:
            raise InputError(
                f"{path}: vertex: the file ends before its {count} rows do (truncated?); copy or export it again"
            )
        self.path, self.source, self.count, self.reading = path, str(path), count, reading
        self.offset, self.row, self.layout = offset, row, layout

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Rows from ``start`` to ``stop``; their pages are given back when the array goes."""
        at = self.offset + start * self.row.itemsize
        return np.memmap(self.path, self.row, "r", at, (min(stop, self.count) - start,))

    def pieces(self, rows: int) -> Iterator[RawRows]:
        """See `CloudStream.pieces`."""
        points, normals, colors = self.layout[:3]
        for start in range(0, self.count, rows):
            table = self.rows(start, start + rows)
            yield RawRows(
                _columns(table, points),
                None if normals is None else _columns(table, normals),
                None if colors is None else _columns(table, colors),
            )


def _columns(table: NDArray[Any], which: Triple) -> NDArray[Any]:
    names = table.dtype.names
    return np.array(table[:, list(which)]) if names is None else np.stack([table[names[k]] for k in which], axis=1)
