"""``PointCloud``: points as a file holds them; the meaning of stored numbers; thinning, welding, points on faces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...neural_fields.backend.arrays import Float64, Int64


@dataclass(frozen=True)
class PointCloud:
    """Points in input coordinates, with normals and colours if there are any.

    Attributes:
        points: ``(N, 3)`` float64, in input units; may hold NaN and duplicates.
        normals: ``(N, 3)`` float32, not necessarily of unit length, or None.
        colors: ``(N, 3)`` float32 in [0, 1], or None.
        source: name in messages, such as the file's path.
        normals_source: whether the normals are from the file, or were computed from its faces.
        reading: one line about the columns of the file that were read or ignored.

    Raises:
        ValueError: an array has the wrong shape or a colour lies outside [0, 1].
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.float32] | None = None
    source: str = "point cloud"
    normals_source: Literal["file", "mesh"] = "file"
    reading: str = ""

    def __post_init__(self) -> None:
        points = np.asarray(self.points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points has shape {points.shape}; expected (N, 3)")
        object.__setattr__(self, "points", points)
        for name in ("normals", "colors"):
            if (value := getattr(self, name)) is None:
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


def color_scale(values: NDArray[Any]) -> float:
    """The number of full brightness of stored colours ``(N, 3)``: 1 for fractions up to 2, or else 255 or 65535.

    Bytes have 255. Other numbers are judged by a sample without its largest thousandth, which may be strays.
    """
    if values.dtype == np.uint8:
        return 255.0
    some = values[:: 1 + len(values) // 100_000].astype(np.float64)
    some = np.sort(some[np.isfinite(some)])
    most = some[(len(some) - 1) * 999 // 1000] if len(some) else 0.0
    if values.dtype.kind == "f" and most <= 2 and (some.max(initial=0) <= 1 or bool((some % 1 != 0).any())):
        return 1.0
    return 255.0 if most <= 255 else 65535.0


def colors_from(values: NDArray[Any], *, scale: float | None = None) -> NDArray[np.float32]:
    """Colours as files store them, over ``scale`` (`color_scale`) → float32 in [0, 1]; black where not finite."""
    scale = color_scale(values) if scale is None else scale
    if values.dtype == np.uint8:
        return (values / np.float32(scale)).astype(np.float32)
    finite = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return (finite / scale).clip(0, 1).astype(np.float32)


def unit_rows(vectors: NDArray[np.floating] | NDArray[np.integer]) -> NDArray[np.float64]:
    """Rows ``(..., 3)`` over their lengths; rows of no length, or with NaN, become zero."""
    rows = vectors.astype(np.float64)
    rows[~np.isfinite(rows).all(axis=-1)] = 0
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0)


def sums_by(owner: NDArray[np.integer], vectors: Float64, count: int = 0) -> Float64:
    """Sums ``(count, 3)`` of the vectors ``(N, 3)`` of each owner, numbered from 0."""
    sums = [np.bincount(owner, weights=vectors[:, axis], minlength=count) for axis in range(3)]
    return np.stack(sums, axis=1).astype(np.float64)


def select(cloud: PointCloud, index: NDArray[np.integer] | NDArray[np.bool_]) -> PointCloud:
    """The cloud with only these points: indices ``(M,)`` or a mask ``(N,)``."""
    normals, colors = (None if rows is None else rows[index] for rows in (cloud.normals, cloud.colors))
    return replace(cloud, points=cloud.points[index], normals=normals, colors=colors)


def thin(cloud: PointCloud, max_points: int) -> PointCloud:
    """At most ``max_points`` points of a cloud, evenly spread; see `spread`."""
    return cloud if len(cloud) <= max_points else select(cloud, spread(cloud.points, max_points))


def spread(points: Float64, max_points: int, *, steps: int = 12) -> Int64:
    """Ascending indices of at most ``max_points`` finite points ``(N, 3)``: one for each voxel.

    The voxel is the smallest that leaves few enough, by bisection; 12 ``steps`` leave it a few percent too large.
    """
    if max_points < 1:
        raise ValueError(f"max_points={max_points}: expected at least one")
    if len(points) <= max_points:
        return np.arange(len(points))
    cells = _Cells(points)
    # From a million voxels along a side to one for all points.
    low, high = -20.0, 1.0
    for _ in range(steps):
        middle = (low + high) / 2
        many = cells.count(cells.extent.max() * 2**middle) > max_points
        low, high = (middle, high) if many else (low, middle)
    return voxel_representatives(points, float(cells.extent.max()) * 2**high)


def voxel_representatives(points: Float64, size: float) -> Int64:
    """Ascending indices of one point ``(N, 3)`` per voxel: the one nearest the mean of the voxel's points."""
    keys = _Cells(points).keys(size)
    order = np.argsort(keys, kind="stable")
    firsts = begins(keys[order])
    voxel = np.empty(len(points), np.int64)
    voxel[order] = np.cumsum(firsts) - 1
    count = np.bincount(voxel)
    off = np.zeros(len(points))
    for axis in points.T:  # x, y and z
        off += (axis - (np.bincount(voxel, weights=axis) / count)[voxel]) ** 2
    nearest = np.lexsort((off, voxel))
    return np.sort(nearest[np.flatnonzero(firsts)])


def usable_rows(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """A mask ``(N,)`` of the points ``(N, 3)`` that are finite, and so are the squares of their distances."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(points) < 1e150).all(axis=1))


def centred(points: Float64) -> Float64:
    """Points ``(N, 3)`` around the origin: trees over map coordinates would lose digits."""
    return points - middle_of(points)


def middle_of(points: Float64) -> Float64:
    """The median ``(3,)`` by each coordinate of at most 10,000 points; unlike the mean, strays do not move it far."""
    return np.median(points[:: 1 + len(points) // 10_000], axis=0)


def spacing_of(points: Float64, *, share: float = 0.95, sample: int = 20_000) -> float:
    """The ``share`` quantile of the distances of ``sample`` points to their nearest of all points ``(N, 3)``.

    0 for a single point.
    """
    if len(points) < 2:
        return 0.0
    shifted = centred(points)
    asked = shifted[:: 1 + len(points) // sample]
    return float(np.quantile(KDTree(shifted).query(asked, k=2)[0][:, 1], share))


def spread_on_faces(areas: Float64, count: int, rng: np.random.Generator) -> tuple[Int64, Float64]:
    """Places uniform by area: their faces ``(count,)``, ascending, and weights ``(count, 3)`` of the faces' corners.

    ``areas`` are ``(F,)`` of the faces, or numbers in proportion to them.
    """
    total = np.cumsum(areas)
    if not total[-1] > 0:
        raise ValueError("surface: all of its faces have zero area")
    face = np.searchsorted(total, rng.uniform(0, total[-1], count), side="right").clip(max=len(total) - 1)
    face = np.sort(face)  # neighbours in memory are then neighbours in space, which k-d trees like
    root, second = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    return face, np.stack((1 - root, root * (1 - second), root * second), axis=1)


class _Cells:
    """Points ``(N, 3)`` in grids of any cell size, which begin at the points' lowest corner."""

    def __init__(self, points: Float64) -> None:
        self._offsets = (points - points.min(axis=0)).T.copy()  # (3, N)
        self.extent: Float64 = self._offsets.max(axis=1)

    def keys(self, size: float) -> Int64:
        """One integer per point, ``(N,)``, the same within a voxel with sides of ``size``."""
        sides = np.floor(self.extent / size).astype(np.int64) + 1
        x, y, z = (np.floor(axis / size).astype(np.int64) for axis in self._offsets)
        return (x * sides[1] + y) * sides[2] + z

    def count(self, size: float) -> int:
        """How many voxels of ``size`` hold points."""
        return int(begins(np.sort(self.keys(size))).sum())


def begins(ordered: Int64, step: int = 0) -> NDArray[np.bool_]:
    """A mask of the numbers that are not the one before plus ``step``; true at the first."""
    return np.concatenate(([True], ordered[1:] != ordered[:-1] + step))[: len(ordered)]
