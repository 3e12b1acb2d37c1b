"""``prepare_cloud``: a file's points → clean, oriented points in the unit sphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ....neural_fields import InputError, Similarity
from ....neural_fields.meshing.mesh import weld
from ..point_cloud import Float64, Int64, PointCloud, centred, middle_of, unit_rows, usable_rows
from ..readers.reading import MIN_POINTS
from .noise import (
    denoise,
    noise_deviation,
    noise_level,
    replace_bad_normals,
    smooth_along_normals,
    smoothed_level,
)
from .orientation import estimate_normals, nearest, openness, orient_normals, outwardness, query
from .outliers import agreement, inspect_points
from .winding import orient_by_winding

# Least fraction of neighbours that support a point after smoothing along estimated normals (see `agreement`): fewer
# support a point that was moved along the normal of another layer.
SUPPORTED = 0.3


@dataclass(frozen=True)
class CleaningReport:
    """What was done to a cloud.

    Attributes:
        read: points in the file.
        kept: points left.
        dropped_nan: points with a coordinate that is not finite.
        dropped_duplicates: points at exactly the place of an earlier one.
        dropped_isolated: points far from all others.
        dropped_outliers: other points that belong to no surface.
        repaired_normals: zero or NaN normals replaced by their neighbours' mean.
        dropped_normals: points whose normal could not be repaired.
        turned_normals: normals reversed because those of their neighbours are opposite.
        normals_source: "file", "mesh" (from the file's faces) or "estimated".
        flipped: whether all normals pointed inward and were reversed.
        pieces: connected pieces of the cloud; 0 if normals were not estimated, or a sensor oriented them.
        smoothed_noise: thickness of the noise that was smoothed off, in input units (see `noise_level`); 0 for none.
        oriented_by: source of the signs of estimated normals: "winding" numbers, "propagation" from point to point in
            each piece, the "sensor", or the first "level" of a fit; None for normals of a file.
        noise_deviation: standard deviation of that noise, in input units.
        reestimated_normals: normals of the file that fitted the points less well than planes, and were replaced.
    """

    read: int
    kept: int
    dropped_nan: int = 0
    dropped_duplicates: int = 0
    dropped_isolated: int = 0
    dropped_outliers: int = 0
    repaired_normals: int = 0
    dropped_normals: int = 0
    turned_normals: int = 0
    normals_source: Literal["file", "mesh", "estimated"] = "file"
    flipped: bool = False
    pieces: int = 0
    smoothed_noise: float = 0.0
    oriented_by: Literal["winding", "propagation", "sensor", "level"] | None = None
    noise_deviation: float = 0.0
    reestimated_normals: int = 0

    def summary(self) -> str:
        """One line for people."""
        source = {"file": "from the file", "mesh": "of the mesh", "estimated": "estimated"}[self.normals_source]
        parts = [f"{self.kept:,} of {self.read:,} points", f"normals {source}"]
        ways = {
            "winding": "by winding numbers",
            "propagation": "from point to point" + f" in {self.pieces:,} separate pieces" * (self.pieces > 1),
            "sensor": "towards the sensor",
            "level": "by level 0, trained without orientation",
        }
        if self.oriented_by:
            parts.append(f"oriented {ways[self.oriented_by]}")
        if self.flipped:
            parts.append("all normals pointed inward and were flipped (--normals file keeps them)")
        counts = {
            "not finite": self.dropped_nan,
            "duplicate": self.dropped_duplicates,
            "isolated": self.dropped_isolated,
            "outliers": self.dropped_outliers,
            "without a usable normal": self.dropped_normals,
        }
        dropped = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)
        if self.repaired_normals:
            parts.append(f"{self.repaired_normals:,} normals repaired")
        if self.reestimated_normals:
            parts.append(
                f"{self.reestimated_normals:,} normals disagreed with the points and were estimated again "
                "(--normals file keeps them)"
            )
        if self.turned_normals:
            parts.append(f"{self.turned_normals:,} normals turned round (--no-turn-normals keeps them)")
        if self.smoothed_noise:
            parts.append(
                f"noise of about {self.noise_deviation or self.smoothed_noise:.2g} along the normals smoothed "
                "(--no-smooth-noise keeps it)"
            )
        return "; ".join([*parts, *([f"dropped {dropped}"] if dropped else [])])


@dataclass(frozen=True)
class OrientedCloud:
    """A clean cloud in the unit sphere.

    Attributes:
        points: ``(N, 3)`` float32, in the unit sphere.
        normals: ``(N, 3)`` float32, of unit length, outward.
        colors: ``(N, 3)`` float32 in [0, 1], or None.
        similarity: the way back to input coordinates.
        report: what was dropped, repaired and estimated.
        noisy: ``(M, 3)`` float32, in the unit sphere: points with their noise, of which `points` and `normals` know
            nothing; None without noise.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    colors: NDArray[np.float32] | None
    similarity: Similarity
    report: CleaningReport
    noisy: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def noise(self) -> float:
        """Standard deviation, in the unit sphere, of the noise that was smoothed off the points; 0 for none."""
        return self.report.smoothed_noise / self.similarity.scale

    @property
    def estimated(self) -> bool:
        """Whether normals, all or some, were estimated from the points: at sharp edges the side is then arbitrary."""
        return self.report.normals_source == "estimated" or self.report.reestimated_normals > 0


def prepare_cloud(
    cloud: PointCloud,
    *,
    normals: Literal["auto", "file", "estimate"] = "auto",
    sensor_origin: tuple[float, float, float] | None = None,
    neighbors: int = 16,
    isolation: float | None = 30.0,
    drop_outliers: bool = False,
    turn_normals: bool = False,
    smooth_noise: bool = False,
    noisy: int = 0,
) -> OrientedCloud:
    """Clean a cloud, give it oriented unit normals and move it into the unit sphere.

    Points that are not finite and exact duplicates (all but the first) are dropped, then the cloud is centred and
    scaled in float64, and only then rounded to float32.

    Args:
        cloud: as read.
        normals: "file" keeps the file's normals and their sign; "estimate" ignores them; "auto" takes the
            file's if at least half are usable, and reverses them all if they clearly point inward.
        sensor_origin: position of the scanner, in input coordinates; estimated normals are turned towards it.
        neighbors: size of the neighbourhoods normals are estimated and repaired from; doubled for estimation,
            at most twice, while noise makes them look thick.
        isolation: points whose eighth neighbour is this many times further away than the median point's are dropped,
            except sparser parts (see `inspect_points`). None keeps all.
        drop_outliers: whether to drop other points that belong to no surface (see `inspect_points`), and after
            smoothing along estimated normals those that few of their neighbours support.
        turn_normals: whether to reverse single normals of the file that are opposite to their neighbours'; not with
            ``normals="file"``.
        smooth_noise: whether to smooth noise off along the normals, if it is wider than the spacing (see
            :mod:`.noise`). Estimated normals are then fitted again, and with ``normals="auto"`` those of a file that
            fit the points less well than planes are replaced first.
        noisy: how many random points are set apart before noise is smoothed off along estimated normals.

    Raises:
        InputError: too few points are left, or ``normals="file"`` and there are none.
        ValueError: ``normals``, ``neighbors`` or ``isolation`` is out of range.
    """
    if normals not in ("auto", "file", "estimate"):
        raise ValueError(f"normals={normals!r}: expected 'auto', 'file' or 'estimate'")
    if neighbors < 3:
        raise ValueError(f"neighbors={neighbors}: expected at least 3, to span a plane")
    if isolation is not None and not isolation > 1:
        raise ValueError(f"isolation={isolation}: expected a factor > 1, or None")
    if sensor_origin is not None and not np.isfinite(np.asarray(sensor_origin, np.float64)).all():
        raise InputError(f"sensor_origin={sensor_origin}: expected three finite numbers")

    finite = np.flatnonzero(usable_rows(cloud.points))
    distinct = finite[np.sort(weld(cloud.points[finite])[0])]
    _check_enough(len(distinct), cloud, "are left after dropping NaN and duplicates")

    given = unit_rows(cloud.normals[distinct]) if cloud.normals is not None and normals != "estimate" else None
    usable = np.zeros(len(distinct), bool) if given is None else (given != 0).any(axis=1)
    if normals == "file" and not usable.any():
        raise InputError(f"{cloud.source}: normals: the file has none; use --normals estimate")
    kept, unit, repaired = distinct, None, 0
    if given is not None and (normals == "file" or 2 * usable.sum() >= len(distinct)):
        unit, decided = _repair(cloud.points[distinct], given, usable, neighbors)
        repaired = int(decided.sum() - usable.sum())
        unit, kept = unit[decided], distinct[decided]
        _check_enough(len(kept), cloud, "have a usable normal; use --normals estimate")
    dropped_normals = len(distinct) - len(kept)
    places, noise, deviation, reestimated = cloud.points[kept], 0.0, 0.0, 0
    if unit is not None and normals == "auto" and smooth_noise and cloud.normals_source == "file":
        unit, reestimated = replace_bad_normals(places, unit)
    if unit is not None and smooth_noise:  # before outliers are found: noise mixes up the sides of thin parts
        places, noise, deviation = _smoothed(places, unit, flips=turn_normals and normals == "auto")
    flips = turn_normals and normals == "auto"
    found = inspect_points(places, unit, isolation=isolation, outliers=drop_outliers, flips=flips)
    sound = ~(found.isolated | found.outliers)
    kept = kept[sound]
    _check_enough(len(kept), cloud, "are left after dropping outliers; keep them with --no-drop-outliers")
    similarity = Similarity.to_unit_sphere(places[sound])
    points = similarity.to_unit(places[sound])

    source: Literal["file", "mesh", "estimated"] = cloud.normals_source
    flipped, pieces, oriented_by, strays, apart = False, 0, None, int(found.outliers.sum()), None
    if unit is not None:
        unit = np.where(found.flipped[:, None], -unit, unit)[sound]
        flipped = normals == "auto" and _plainly_inward(points, unit)
        unit = -unit if flipped else unit
    else:
        source = "estimated"
        unit, pieces, oriented_by = _estimate(points, neighbors, similarity, sensor_origin)
        if smooth_noise:
            if noisy and smoothed_level(points, unit):
                chosen = np.random.default_rng(0).permutation(len(points)) < noisy
                apart = points[chosen].astype(np.float32)
                points, unit, kept = points[~chosen], unit[~chosen], kept[~chosen]
            before = points
            points, unit, noise = denoise(before, unit)
            deviation = noise_deviation(before, unit, thick=0.0) * similarity.scale if noise else 0.0
            noise *= similarity.scale
            if noise and drop_outliers:
                supported = agreement(points, unit, np.arange(len(points)))[0] >= SUPPORTED
                points, unit, kept = points[supported], unit[supported], kept[supported]
                _check_enough(len(kept), cloud, "are left after dropping outliers; keep them with --no-drop-outliers")
                strays += int((~supported).sum())
    report = CleaningReport(
        read=len(cloud),
        kept=len(kept) + (0 if apart is None else len(apart)),
        dropped_nan=len(cloud) - len(finite),
        dropped_duplicates=len(finite) - len(distinct),
        dropped_isolated=int(found.isolated.sum()),
        dropped_outliers=strays,
        repaired_normals=repaired,
        dropped_normals=dropped_normals,
        turned_normals=int(found.flipped.sum()),
        normals_source=source,
        flipped=flipped,
        pieces=pieces,
        smoothed_noise=noise,
        oriented_by=oriented_by,
        noise_deviation=deviation,
        reestimated_normals=reestimated,
    )
    colors = None if cloud.colors is None else cloud.colors[kept]
    return OrientedCloud(points.astype(np.float32), unit.astype(np.float32), colors, similarity, report, apart)


def _check_enough(count: int, cloud: PointCloud, why: str) -> None:
    if count < MIN_POINTS:
        raise InputError(
            f"{cloud.source}: points: only {count} of {len(cloud)} {why}; at least {MIN_POINTS} are needed"
        )


def _smoothed(points: Float64, normals: Float64, *, flips: bool = False) -> tuple[Float64, float, float]:
    """Points smoothed along their normals, the thickness of their layer, and the standard deviation of the noise.

    With ``flips``, single normals of a thin part may be reversed, and its far side then looks like noise.
    """
    middle = middle_of(points)
    level, sound = noise_level(points - middle, normals), normals
    if level and flips:
        sound = np.where(inspect_points(points, normals, outliers=False).flipped[:, None], -normals, normals)
        level = noise_level(points - middle, sound)
    if not level:
        return points, 0.0, 0.0
    deviation = noise_deviation(points - middle, sound)
    return smooth_along_normals(points - middle, normals, level) + middle, level, deviation


def _repair(
    points: Float64, normals: Float64, usable: NDArray[np.bool_], neighbors: int, *, agreement: float = 0.5
) -> tuple[Float64, NDArray[np.bool_]]:
    """Normals ``(N, 3)``, unusable ones replaced by the mean of the nearest usable ones, and a mask of the usable.

    A normal stays unusable where that mean is shorter than ``agreement`` (1: all equal, 0: they cancel).
    """
    missing = np.flatnonzero(~usable)
    if len(missing) == 0:
        return normals, usable
    shifted = centred(points)
    near = query(KDTree(shifted[usable]), shifted[missing], neighbors)[1]
    mean = normals[usable][near].mean(axis=1)
    length = np.linalg.norm(mean, axis=1)
    clear = length > agreement
    repaired, decided = normals.copy(), usable.copy()
    repaired[missing[clear]] = mean[clear] / length[clear, None]
    decided[missing[clear]] = True
    return repaired, decided


def _plainly_inward(
    points: Float64, normals: Float64, *, score: float = -0.3, share: float = 0.9, opening: float = 0.15
) -> bool:
    """Whether normals clearly point inward, and not because the cloud is an open scan of a hollow (see `openness`)."""
    mean, negative = outwardness(points, normals)
    return mean < score and negative >= share and openness(points, normals) < opening


def _estimate(
    points: Float64, neighbors: int, similarity: Similarity, sensor_origin: tuple[float, float, float] | None
) -> tuple[Float64, int, Literal["winding", "propagation", "sensor"]]:
    """Oriented normals, the number of pieces (0: not counted), and what oriented them."""
    near, normals, spread = _planes(points, neighbors)
    if sensor_origin is not None:
        towards = similarity.to_unit(np.asarray(sensor_origin, np.float64)) - points
        return np.where((normals * towards).sum(axis=1, keepdims=True) < 0, -normals, normals), 0, "sensor"
    propagated, pieces = orient_normals(points, normals, spread, near)
    oriented = orient_by_winding(points, propagated)
    return (propagated, pieces, "propagation") if oriented is None else (oriented, pieces, "winding")


def _planes(
    points: Float64, neighbors: int, *, flat: float = 0.25, doublings: int = 2
) -> tuple[Int64, Float64, Float64]:
    """Neighbourhoods with a median thickness below ``flat`` times their radius, and the planes through them."""
    near = nearest(points, neighbors)
    normals, spread = estimate_normals(points, near)
    radius = np.linalg.norm(points[near[:, -1]] - points, axis=1)
    if doublings == 0 or np.median(spread / radius) < flat:
        return near, normals, spread
    return _planes(points, 2 * neighbors, flat=flat, doublings=doublings - 1)
