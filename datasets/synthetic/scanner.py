"""Simulated scans: virtual range scanners around a field, with noise and other faults.

The faults are applied in this order: smear of mixed pixels, range noise, quantisation, isotropic noise, uneven density,
misalignment of the scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...neural_fields import Field, Similarity
from ..clouds.point_cloud import Float64, PointCloud, unit_rows
from ..depth.cleaning import Mask, both_sides
from .samples import jet_at
from .statue import Statue

STATUE_PLACEMENT = Similarity((1250.0, -840.0, 930.0), 480.0)
"""From the statue's unit sphere to the millimetres of the bundled scan."""

STATUE_NOISE = 2e-4
"""Standard deviation of the bundled scan's ranges in units of the statue: about a tenth of a millimetre."""

_RELAX = 0.75  # step over field value, because a field may be steeper than a distance
_STEPS = 96  # largest number of steps of a ray


@dataclass(frozen=True)
class ScanFaults:
    """Strengths of the faults of a simulated scan; lengths in the units of the scanned field.

    Attributes:
        isotropic: standard deviation of each coordinate of each point.
        quantise: ranges are rounded to multiples of this; 0 leaves them.
        misalign: registration error: standard deviation of each coordinate of the shift of each scan, and of its
            rotation vector in radians.
        smear: share of the readings beside a jump in depth that lie between its two sides, from 0 to 1.
        uneven: density of the points on one side over that on the other, 1 or more.

    Raises:
        ValueError: one of them is out of its bounds.
    """

    isotropic: float = 0.0
    quantise: float = 0.0
    misalign: float = 0.0
    smear: float = 0.0
    uneven: float = 1.0

    def __post_init__(self) -> None:
        for name in ("isotropic", "quantise", "misalign"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ValueError(f"{name}={value}: expected a length, 0 or more")
        if not 0 <= self.smear <= 1:
            raise ValueError(f"smear={self.smear}: expected a share from 0 to 1")
        if not 1 <= self.uneven < math.inf:
            raise ValueError(f"uneven={self.uneven}: expected a factor of 1 or more")


def statue_scan(
    *,
    noise: float = STATUE_NOISE,
    faults: ScanFaults | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> PointCloud:
    """Scan the :class:`Statue` from twelve places: the bundled sample, some 100,000 points in millimetres.

    Points are 1.6 mm apart, with a tenth of a millimetre of range noise, as of hand-held structured-light scanners. The
    bottom of the statue is not scanned. ``STATUE_PLACEMENT.to_unit(points)`` has the coordinates of the field
    ``Statue()``. The arguments are those of `scan_with_truth`.
    """
    statue = Statue()
    about = {"scanners": 12, "colors": statue.colors, "placement": STATUE_PLACEMENT}
    return simulate_scan(statue, noise=noise, faults=faults, seed=seed, progress=progress, **about)


def simulate_scan(field: Field, **options: Any) -> PointCloud:
    """The cloud of `scan_with_truth`, which has the same arguments."""
    return scan_with_truth(field, **options).cloud


@dataclass(frozen=True)
class SimulatedScan:
    """A scan and its truth, in the coordinates of the cloud.

    The point ``x`` of scanner ``s`` was measured at ``motions[s]⁻¹ x``. But for isotropic noise, this lies on the ray
    from ``positions[s]`` through ``exact``.

    Attributes:
        cloud: the points of all scanners.
        exact: ``(N, 3)`` hits of the rays: to rounding, and to 4e-5 of the unit sphere at grazing incidence.
        exact_normals: ``(N, 3)`` unit normals of the surface there.
        scanner: ``(N,)`` number of the scanner.
        smeared: ``(N,)`` whether the reading is a mixture with that of a neighbour.
        positions: ``(S, 3)`` of the scanners.
        motions: ``(S, 4, 4)`` rigid registration errors, from measured points to those of the cloud.
    """

    cloud: PointCloud
    exact: Float64
    exact_normals: Float64
    scanner: NDArray[np.int64]
    smeared: NDArray[np.bool_]
    positions: Float64
    motions: Float64


def scan_with_truth(
    field: Field,
    *,
    scanners: int = 8,
    resolution: int = 216,
    noise: float = 0.0008,
    colors: Callable[[Float64], NDArray[np.float32]] | None = None,
    placement: Similarity | None = None,
    faults: ScanFaults | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> SimulatedScan:
    """Scan the zero set of ``field``, which lies in the unit sphere, with a ring of range scanners.

    Every scanner measures ranges on a perspective grid of rays, with Gaussian noise along the rays. Distances and
    resolutions differ between scanners. Rays that graze the surface are mostly lost. Normals are those of the noisy
    range grid, facing the scanner; they are zero where a pixel has no neighbour on the same surface.

    Args:
        field: in the unit sphere, 1-Lipschitz or nearly so, positive outside.
        scanners: number of scanners, evenly around the z axis, at changing heights.
        resolution: rays along each side of a grid, on average.
        noise: standard deviation of the ranges, in the field's units.
        colors: the colour at points ``(N, 3)``, in the field's units.
        placement: from the field's coordinates to those of the scan; by default the identity.
        faults: none by default. The same seed gives the same rays, losses and noise with any faults.
        seed: of the random numbers.
        progress: called with the number of steps done and of all steps: those of the rays, and one for each scanner.

    Raises:
        ValueError: ``scanners`` or ``resolution`` is too small, ``noise`` is negative, or no ray hits anything.

    Example:
        >>> from mplicits.neural_fields import Sphere
        >>> scan = scan_with_truth(Sphere(radius=0.7), scanners=2, resolution=16, faults=ScanFaults(misalign=0.01))
        >>> bool(abs((scan.exact**2).sum(axis=1) - 0.49).max() < 1e-6)
        True
    """
    if scanners < 1 or resolution < 8:
        raise ValueError(f"scanners={scanners}, resolution={resolution}: expected at least 1 and 8")
    if not noise >= 0:
        raise ValueError(f"noise={noise}: expected a length, 0 or more")
    faults, place = faults or ScanFaults(), placement or Similarity.identity()
    random = np.random.default_rng(seed)
    views = [_view(index, scanners, resolution, random) for index in range(scanners)]
    # All rays at once: late steps, with few rays left, cost as much as early ones.
    origins = np.concatenate([np.broadcast_to(view.position, view.rays.shape).reshape(-1, 3) for view in views])
    total, tell = _STEPS + scanners, progress or (lambda _done, _total: None)
    tell(0, total)
    rays = np.concatenate([view.rays.reshape(-1, 3) for view in views])
    ranges = _trace(field, origins, rays, tell=lambda step: tell(step, total))
    split = np.split(ranges, np.cumsum([view.rays[..., 0].size for view in views])[:-1])
    thin_side = np.random.default_rng((seed, scanners + 1)).normal(size=3)
    parts: list[_Readings] = []
    for index, (view, each) in enumerate(zip(views, split, strict=True)):
        extra = np.random.default_rng((seed, index + 1))  # faults leave the other numbers as they are
        parts.append(_measure(field, view, each, noise, faults, thin_side / np.linalg.norm(thin_side), random, extra))
        tell(_STEPS + len(parts), total)
    counts = [len(part.points) for part in parts]
    if not sum(counts):
        raise ValueError("field: no ray of any scanner hits its surface; expected one in the unit sphere")
    exact = np.concatenate([part.exact for part in parts])
    shades = None
    if colors is not None:
        exposure = np.concatenate([np.full(count, random.normal(1, 0.03)) for count in counts])
        measured = colors(exact) * exposure[:, None] + random.normal(0, 0.01, (len(exact), 3))
        shades = measured.clip(0, 1).astype(np.float32)
    placed = place.to_input(np.concatenate([part.points for part in parts]))
    normals = np.concatenate([part.normals for part in parts])
    return SimulatedScan(
        PointCloud(placed, normals.astype(np.float32), shades, f"simulated scan of {type(field).__name__}"),
        place.to_input(exact),
        np.concatenate([part.exact_normals for part in parts]),
        np.repeat(np.arange(scanners), counts),
        np.concatenate([part.smeared for part in parts]),
        place.to_input(np.stack([view.position for view in views])),
        np.stack([_in_place(part.motion, place) for part in parts]),
    )


def _in_place(motion: Float64, place: Similarity) -> Float64:
    """A rigid motion of the field's coordinates as one of the scan's."""
    moved = motion.copy()
    moved[:3, 3] = place.to_input(motion[:3, 3]) - motion[:3, :3] @ place.center
    return moved


class _Readings(NamedTuple):
    """The points of one scanner, in the field's units; see `SimulatedScan`."""

    points: Float64
    normals: Float64
    exact: Float64
    exact_normals: Float64
    smeared: NDArray[np.bool_]
    motion: Float64


class _View(NamedTuple):
    position: Float64  # (3,)
    rays: Float64  # (side, side, 3), unit


def _view(index: int, scanners: int, resolution: int, random: np.random.Generator) -> _View:
    azimuth = 2 * np.pi * (index + random.uniform(-0.2, 0.2)) / scanners
    elevation = np.radians((12.0, 38.0, -30.0, 22.0)[index % 4] + random.uniform(-4, 4))
    position = random.uniform(2.2, 3.0) * np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    return _View(position, _grid_of_rays(position, int(resolution * random.uniform(0.75, 1.25))))


def _measure(
    field: Field,
    view: _View,
    ranges: Float64,
    noise: float,
    faults: ScanFaults,
    thin_side: Float64,
    random: np.random.Generator,
    extra: np.random.Generator,
) -> _Readings:
    """The points of one scanner; ``extra`` draws the random numbers of the faults, ``random`` the others."""
    position, rays = view
    ranges = ranges.reshape(rays.shape[:2])  # NaN: nothing hit
    exact = position + ranges[..., None] * rays
    hit = np.isfinite(ranges)
    upright, facing = np.zeros_like(rays), np.zeros_like(ranges)
    upright[hit] = unit_rows(jet_at(field, exact[hit])[1])
    facing[hit] = -(upright[hit] * rays[hit]).sum(axis=1)
    # All rays return at incidences up to 66°, none from 84° on.
    hit &= random.uniform(0, 1, hit.shape) < (facing - 0.1) / 0.3
    mixed, smears = smeared(ranges, rays, faults.smear, extra)
    ranges = np.where(hit, mixed + random.normal(0, noise, ranges.shape), np.nan)
    points = position + quantised(ranges, faults.quantise)[..., None] * rays
    points += extra.normal(0, 1, points.shape) * faults.isotropic
    normals = _range_normals(points, rays)
    hit &= kept_unevenly(exact, thin_side, faults.uneven, extra)
    motion = rigid_motion(faults.misalign, extra)
    turn, shift = motion[:3, :3], motion[:3, 3]
    if faults.misalign:
        points, normals = points @ turn.T + shift, normals @ turn.T
    return _Readings(points[hit], normals[hit], exact[hit], upright[hit], smears[hit], motion)


def _grid_of_rays(position: Float64, side: int) -> Float64:
    """Unit directions ``(side, side, 3)`` from ``position`` that just cover the unit sphere."""
    distance = np.linalg.norm(position)
    forward = -position / distance
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    reach = 1 / np.sqrt(distance**2 - 1)  # tangent of the half opening angle
    steps = np.linspace(-reach, reach, side)
    rays = forward + steps[None, :, None] * right + steps[:, None, None] * np.cross(forward, right)
    return rays / np.linalg.norm(rays, axis=2, keepdims=True)


def _clearances(field: Field, *, cells: int = 64) -> Callable[[Float64], Float64]:
    """Lower bounds ``(N,)``, where above 0, of the distances of points ``(N, 3)`` in [-1, 1]³, by a grid of values."""
    centers = (np.arange(cells) + 0.5) * 2 / cells - 1
    grid = np.stack(np.meshgrid(centers, centers, centers, indexing="ij"), axis=-1)
    bound = (_RELAX * _value(field, grid.reshape(-1, 3)) - np.sqrt(3) / cells).reshape(cells, cells, cells)
    return lambda points: bound[tuple(((points + 1) * (cells / 2)).astype(np.int64).clip(0, cells - 1).T)]


def _trace(
    field: Field, origins: Float64, rays: Float64, *, tell: Callable[[int], None], tolerance: float = 2e-4
) -> Float64:
    """Sphere tracing inside the unit sphere: range ``(R,)`` along each unit ray ``(R, 3)``, NaN for a miss.

    The field is evaluated only where `_clearances` has no bound; two Newton steps along the ray then take the
    hit from ``tolerance`` down to rounding.
    """
    # `sphere_trace` takes twice as long for the statue, without `_clearances`, and finds more rays that graze the
    # surface: the bundled scan, on which published figures rest, would be another cloud.
    clearance = _clearances(field)
    middle = -(rays * origins).sum(axis=1)
    half_chord = np.sqrt((middle**2 - (origins**2).sum(axis=1) + 1).clip(min=0))
    ranges, last = middle - half_chord, middle + half_chord
    active = np.flatnonzero(half_chord > 0)
    hits: list[NDArray[np.int64]] = []
    for step_number in range(_STEPS):
        tell(step_number)
        points = origins[active] + ranges[active, None] * rays[active]
        step = clearance(points)
        near = step <= 0
        value = _value(field, points[near])
        step[near] = _RELAX * value
        close = near.copy()
        close[near] = value < tolerance
        hits.append(active[close])
        active, step = active[~close], step[~close]
        ranges[active] += step
        active = active[ranges[active] < last[active]]
    found = np.concatenate(hits)
    for _ in range(2):
        value, gradient = jet_at(field, origins[found] + ranges[found, None] * rays[found])
        slope = np.minimum((gradient * rays[found]).sum(axis=1), -0.1)
        ranges[found] -= (value / slope).clip(-4 * tolerance, 4 * tolerance)
    result = np.full(len(rays), np.nan)
    result[found] = ranges[found]
    return result


def _range_normals(points: Float64, rays: Float64, *, jump: float = 3.0) -> Float64:
    """Normals ``(H, W, 3)`` of a grid of points by differences between neighbours; zero where there are none.

    A difference longer than ``jump`` times the median one crosses an edge of the object and is not used.
    """
    tangents = []
    for axis in (0, 1):
        step = np.diff(points, axis=axis)
        length = np.linalg.norm(step, axis=2)
        usable = length < jump * np.nanmedian(length)
        step = np.where(usable[..., None], step, 0.0)
        tangents.append(np.add(*both_sides(step, axis)))  # central, or one-sided at an edge
    normals = np.cross(tangents[0], tangents[1])
    normals *= -np.sign((normals * rays).sum(axis=2, keepdims=True))
    return unit_rows(normals)


def _value(field: Field, points: Float64) -> Float64:
    with torch.no_grad():
        return field.value(torch.from_numpy(points).float()).double().numpy()


def quantised(ranges: Float64, step: float) -> Float64:
    """Ranges rounded to multiples of ``step``, ``⌊r / step + ½⌋ · step``."""
    return np.floor(ranges / step + 0.5) * step if step else ranges


def depth_jumps(ranges: Float64, rays: Float64, axis: int) -> Mask:
    """Jumps of depth between neighbours along ``axis`` of a grid of ranges ``(H, W)``; one shorter along it.

    Readings r and r' on rays an angle α apart are on different surfaces if ``|r − r'| > tan(84°) α min(r, r')``: one
    surface between them would be seen at 84° or flatter. Without one of the readings (NaN) there is no jump.
    """
    r, direction = np.moveaxis(ranges, axis, 0), np.moveaxis(rays, axis, 0)
    sine = np.linalg.norm(direction[1:] - direction[:-1], axis=-1) / 2  # of half the angle
    nearer = np.minimum(r[1:], r[:-1])
    jump = np.abs(r[1:] - r[:-1]) > math.tan(math.radians(84.0)) * 2 * np.arcsin(sine) * nearer
    return np.moveaxis(jump, 0, axis)


def smeared(ranges: Float64, rays: Float64, share: float, random: np.random.Generator) -> tuple[Float64, Mask]:
    """Ranges with mixed pixels, and the mask of these, each ``(H, W)``.

    With the probability ``share``, a reading r beside a jump (see `depth_jumps`) becomes ``r + t (r' − r)``: r' is the
    most different reading across a jump, t uniform in (0, 1). Two random numbers per pixel are drawn for any share.
    """
    step, size = np.zeros_like(ranges), np.zeros_like(ranges)
    for axis in (0, 1):
        change = np.where(depth_jumps(ranges, rays, axis), np.diff(ranges, axis=axis), 0.0)
        after, before = both_sides(change, axis)
        for towards in (after, -before):
            larger = np.abs(towards) > size
            step, size = np.where(larger, towards, step), np.where(larger, np.abs(towards), size)
    chosen, way = random.uniform(size=(2, *ranges.shape))
    mixed = (size > 0) & (chosen < share)
    return np.where(mixed, ranges + way * step, ranges), mixed


def kept_unevenly(points: Float64, direction: Float64, factor: float, random: np.random.Generator) -> Mask:
    """A mask of the points ``(..., 3)`` of the unit sphere, each kept with probability ``factor^−(1 + ⟨x, d⟩)/2``."""
    height = (1 + points @ direction) / 2
    return random.uniform(size=height.shape) < factor ** -height.clip(0, 1)


def rigid_motion(size: float, random: np.random.Generator) -> Float64:
    """A random motion ``(4, 4)``, x → R x + t; t and the rotation vector of R (radians) are ``size`` · N(0, 1)."""
    motion = np.eye(4)
    shift, turn = random.normal(0, 1, (2, 3)) * size
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return motion
