"""``PointCloud``: what a file holds, before anything is cleaned or scaled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["PointCloud", "colors_from", "normals_from", "unit_rows"]


@dataclass(frozen=True)
class PointCloud:
    """Points in input coordinates, with whatever normals and colours came with them.

    Attributes:
        points: ``(N, 3)`` float64, in input units; may still hold NaN and duplicates.
        normals: ``(N, 3)`` float32, not necessarily of unit length, or None.
        colors: ``(N, 3)`` float32 in [0, 1], or None.
        source: what messages call this cloud; the file's path, say.
        normals_source: whether the normals stood in the file or were computed from its faces.

    Raises:
        ValueError: an array has the wrong shape or a colour lies outside [0, 1].
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.float32] | None = None
    source: str = "point cloud"
    normals_source: Literal["file", "mesh"] = "file"

    def __post_init__(self) -> None:
        points = np.asarray(self.points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points has shape {points.shape}; expected (N, 3)")
        object.__setattr__(self, "points", points)
        for name in ("normals", "colors"):
            value = getattr(self, name)
            if value is None:
                continue
            value = np.asarray(value, np.float32)
            if value.shape != points.shape:
                raise ValueError(f"{name} has shape {value.shape}; expected {points.shape}, one row per point")
            object.__setattr__(self, name, value)
        if self.colors is not None and not bool(((self.colors >= 0) & (self.colors <= 1)).all()):
            raise ValueError("colors: expected numbers from 0 to 1")

    def __len__(self) -> int:
        return len(self.points)


def normals_from(values: NDArray[Any]) -> NDArray[np.float32]:
    """Normals as files store them → float32; signed integers of b bits are fractions of 2^(b-1) - 1."""
    scale = np.iinfo(values.dtype).max if np.issubdtype(values.dtype, np.signedinteger) else 1
    return (values / np.float64(scale)).astype(np.float32)


def colors_from(values: NDArray[Any], *, brightest: float | None = None) -> NDArray[np.float32]:
    """Colours as files store them → float32 in [0, 1].

    Numbers up to 1 in a floating-point type are taken as they are, up to 255 as bytes, beyond that as
    16-bit numbers; an 8-bit type is always over 255. A colour that is not a number becomes black.

    Args:
        values: the numbers.
        brightest: the largest of all, if these are only some.
    """
    if values.dtype == np.uint8:
        return (values / np.float32(255)).astype(np.float32)
    finite = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    largest = finite.max(initial=0.0) if brightest is None else brightest
    integral = np.issubdtype(values.dtype, np.integer)
    scale = 1.0 if largest <= 1 and not integral else 255.0 if largest <= 255 else 65535.0
    return (finite / scale).clip(0, 1).astype(np.float32)


def unit_rows(vectors: NDArray[np.floating] | NDArray[np.integer]) -> NDArray[np.float64]:
    """Rows ``(..., 3)`` over their lengths; rows of no length, or with NaN, become zero."""
    rows = vectors.astype(np.float64)
    rows[~np.isfinite(rows).all(axis=-1)] = 0
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0)
