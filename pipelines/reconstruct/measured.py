"""Measured depths, of depth maps and sparse points: rays that meet the surface, and nothing before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.cameras import Camera
from ...datasets.views.formats.shots import DepthMap
from ...datasets.views.images import OBJECT, PosedImage, PosedImages
from ...neural_fields import Field, InputError, sphere_trace
from ...neural_fields.backend.arrays import Float64, Int64
from ...neural_fields.backend.devices import graph_input, uniform
from ...neural_fields.fields.field import FieldLike
from ...neural_fields.volume.weights import sphere_span

UNITS = "give --depth-scale (numbers per unit of the cameras), or --depth-kind relative"  # if they are others
AS_IT_IS, RELATIVE, DISPARITY = 0, 1, 2  # how a number becomes a depth


@dataclass(frozen=True)
class DepthLimits:
    """How depth maps are fitted and judged. The values are this project's own."""

    readings: int = 1 << 21  # that are kept, of all maps together
    fewest: int = 16  # numbers that say scale and shift of a map
    rounds: int = 10  # of the reweighted least squares
    least_residual: float = 1e-3  # relative error below which all numbers count alike
    all_alike: float = 1e-6  # how far numbers differ at least, as a share of their mean
    rays: int = 256  # of each map that are compared with the surface
    tolerance: float = 1e-3  # of their tracing, in radii of the region
    inside: float = 0.01  # share of the readings of maps in the cameras' units that ends in the region, at least
    alike: float = 1.2  # factor between the depths of such maps and of sparse points, at most


LIMITS = DepthLimits()


class DepthRays(NamedTuple):
    """Measured rays in unit-sphere coordinates: they meet the surface at ``origins + reach · directions``."""

    origins: Tensor  # (B, 3)
    directions: Tensor  # (B, 3) unit vectors
    reach: Tensor  # (B,) in radii of the region; not positive where it is not known yet
    exact: Tensor  # (B,) whether it was measured, by a sensor or by triangulation, not estimated from one picture
    view: Tensor  # (B,) number of the picture


@dataclass(frozen=True)
class _Part:
    """Measurements of one view."""

    lines: Float64  # (N, 3) lines of sight in camera coordinates, z = 1
    numbers: Float64  # (N,) depths in radii of the region, or numbers of a map
    form: int  # how those become depths
    exact: bool  # see `DepthRays`
    view: int  # number of the picture


class MeasuredDepths:
    """The measurements of the ``views`` that are trained on, a part of the ``images``.

    Numbers of a map that is not in the cameras' units become depths by a scale and a shift of its own, `affine` ``(V,
    2)``, 0 until they are known. The sparse points that the view saw say which, if there are sixteen; else `align`
    fits them to the present surface. The ``seed`` chooses where there are more readings than can be kept.

    Attributes:
        is_loose: whether there are maps for `align`.
        is_exact: whether anything was measured in the cameras' units.

    Raises:
        InputError: maps in the cameras' units are not: hardly a reading ends in the region, or sparse points are at
            other depths.
    """

    def __init__(
        self, views: Sequence[PosedImage], images: PosedImages, device: torch.device, *, seed: int = 0
    ) -> None:
        self.device = device
        parts = _gathered(views, images, np.random.default_rng(seed))
        cameras = [view.camera.moved(images.similarity) for view in views]
        axes = [camera.world_from_camera[:3, :3].numpy() for camera in cameras]
        self.eyes = torch.stack([camera.eye for camera in cameras]).float().to(device)
        counts = torch.tensor([len(part.numbers) for part in parts], dtype=torch.int64)
        along = np.concatenate([np.empty((0, 3)), *(part.lines @ axes[part.view].T for part in parts)])
        numbers = np.concatenate([np.empty(0), *(part.numbers for part in parts)])
        self.along, self.numbers = (torch.from_numpy(part).float().to(device) for part in (along, numbers))
        self.forms, self.views, self.exact = (
            torch.tensor([getattr(part, name) for part in parts], dtype=kind).repeat_interleave(counts).to(device)
            for name, kind in (("form", torch.uint8), ("view", torch.int16), ("exact", torch.bool))
        )
        self.affine = torch.zeros(len(views), 2, device=device)
        self.is_loose, self.is_exact = bool((self.forms != AS_IT_IS).any()), bool(self.exact.any())

    def __len__(self) -> int:
        return len(self.numbers)

    def at(self, rows: Tensor) -> DepthRays:
        """The measurements with these numbers ``(B,)``."""
        view, numbers, form = self.views[rows].long(), self.numbers[rows], self.forms[rows]
        scale, shift = self.affine[view].unbind(dim=1)
        mapped = scale * numbers + shift
        depths = torch.where(form == RELATIVE, mapped, torch.where(form == AS_IT_IS, numbers, _inverse(mapped)))
        along = self.along[rows]  # their part along the axis of view is 1
        length = along.norm(dim=1)
        return DepthRays(self.eyes[view], along / length[:, None], depths * length, self.exact[rows], view)

    def draw(self, count: int, generator: torch.Generator) -> DepthRays:
        """``count`` measurements at random, with replacement."""
        return self.at(graph_input(lambda: torch.randint(len(self), (count,), generator=generator), self.device))

    @torch.no_grad()
    def align(self, distance: FieldLike) -> None:
        """Fit scale and shift of the maps that have none yet to a field in unit-sphere coordinates."""
        loose = self.forms != AS_IT_IS
        # Of each view's readings, evenly; they lie one after the other.
        count = torch.bincount(self.views[loose].long(), minlength=len(self.eyes))
        owned = count.nonzero()[:, 0]
        steps = (torch.arange(LIMITS.rays, device=self.device) + 0.5) / LIMITS.rays
        first = count.cumsum(0) - count
        rows = loose.nonzero()[:, 0][(first[owned, None] + steps * count[owned, None]).long().reshape(-1)]
        view, along = self.views[rows].long(), self.along[rows]
        length = along.norm(dim=1)
        directions = along / length[:, None]
        hits = sphere_trace(
            distance, self.eyes[view], directions, tolerance=LIMITS.tolerance, resolution=LIMITS.tolerance, radius=1.0
        )
        hit, depths = hits.mask, hits.depth / length
        wanted = torch.where(self.forms[rows] == RELATIVE, depths, _inverse(depths))
        found = fit_scale_shift(self.numbers[rows][hit], wanted[hit], view[hit], len(self.eyes))
        self.affine[owned] = found[owned].to(self.affine)


def _inverse(numbers: Tensor) -> Tensor:
    """1 / x of what is positive, else 0."""
    return torch.where(numbers > 0, 1 / numbers.clamp_min(1e-12), 0.0)


def fit_scale_shift(numbers: Tensor, wanted: Tensor, group: Tensor, groups: int) -> Tensor:
    """Scale a and shift b of each group that minimise Σ |a m + b − z| of ``numbers`` m and ``wanted`` z ``(N,)``.

    Returns ``(groups, 2)`` float64, by least squares that are weighted again with 1 / |residual|. 0 for groups with
    fewer than sixteen numbers, with numbers that are all alike, or whose scale would not be positive.
    """
    m, z = numbers.double(), wanted.double()
    count = torch.bincount(group, minlength=groups)

    def summed(what: Tensor) -> Tensor:
        return torch.zeros(groups, dtype=torch.float64, device=m.device).index_add(0, group, what)

    def line(weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scale, shift, and whether the numbers differ."""
        total = summed(weight).clamp_min(1e-300)
        middle_m, middle_z = summed(weight * m) / total, summed(weight * z) / total
        off_m, off_z = m - middle_m[group], z - middle_z[group]
        spread = summed(weight * off_m.square()) / total
        scale = summed(weight * off_m * off_z) / total / spread.clamp_min(1e-300)
        return scale, middle_z - scale * middle_m, spread > (LIMITS.all_alike * middle_m).square()

    scale, shift, differ = line(torch.ones_like(m))
    for _ in range(LIMITS.rounds):
        away = (scale[group] * m + shift[group] - z).abs() + LIMITS.least_residual * z.abs()
        scale, shift, differ = line(1 / away.clamp_min(1e-300))
    usable = (count >= LIMITS.fewest) & (scale > 0) & differ
    return torch.where(usable[:, None], torch.stack((scale, shift), dim=1), 0.0)


def depth_loss(field: Field, rays: DepthRays, *, level: int = -1, generator: torch.Generator | None = None) -> Tensor:
    """How far a field is from what was measured ``(B,)``: |f(p)|, and Σ max(−f(x), 0) + max(f(x) − |p − x|, 0).

    p is where the ray meets the surface. Two places x are on the way there: one at random (without a ``generator`` in
    the middle), nearer to p more often, and where the ray enters the unit sphere. What lies outside the unit sphere,
    and measurements that are not known yet, count 0.

    The entry has to be named: volume rendering divides by the light that is left there (NeuS, Eq. 13), and the pictures
    alone leave slabs before the cameras.
    """
    origins, directions, reach = rays[:3]
    near, far = sphere_span(origins, directions)
    on_surface = (reach > near) & (reach < far)
    end = torch.minimum(reach, far)
    passed = end > near
    part = uniform(reach.shape, generator, end.device) if generator else torch.full_like(reach, 0.5)
    on_the_way = torch.stack((end - (end - near) * part.square(), near))
    places = origins + torch.cat((reach[None], on_the_way))[..., None] * directions  # (3, B, 3)
    # Those that do not count are evaluated too: a GPU would be waited for until it says which they are.
    values = field.value(places, level=level)
    on, before = values[0], values[1:]
    free = ((-before).clamp_min(0) + (before - (reach - on_the_way)).clamp_min(0)).sum(dim=0)
    return torch.where(on_surface, on.abs(), 0.0) + torch.where(passed, free, 0.0)


def _gathered(views: Sequence[PosedImage], images: PosedImages, random: np.random.Generator) -> list[_Part]:
    """All measurements, view by view."""
    parts, in_region, ratios, source = [], [], [], images.source
    place = {id(view): number for number, view in enumerate(images.views)}
    for index, view in enumerate(views):
        camera = view.camera.moved(images.similarity)
        eye, axes = camera.eye.numpy(), camera.world_from_camera[:3, :3].numpy()
        seen = np.empty((0, 3))  # sparse points that the view saw, in its camera's axes
        if images.points is not None and images.observations is not None:
            rows = images.observations[images.observations[:, 0] == place[id(view)], 1]
            seen = (images.similarity.to_unit(images.points[rows]) - eye) @ axes
            seen = seen[seen[:, 2] > 0]
        points = _Part(seen / seen[:, 2:], seen[:, 2], AS_IT_IS, exact=True, view=index)
        parts.append(_on_object(view, points))
        if view.depth is None:
            continue
        part = _of_map(view.depth, points, images, random, LIMITS.readings // len(views))
        parts.append(_on_object(view, part))
        if view.depth.kind == "metric":
            ends = eye + part.numbers[:, None] * (part.lines @ axes.T)
            in_region.append(float((np.linalg.norm(ends, axis=1) < 1).mean()) if len(ends) else 0.0)
            here, there = _numbers_at(view.depth, points)
            ratios.append(here / images.similarity.scale / there)
            source = view.depth.source
    if in_region:
        _check_units(source, in_region, ratios)
    return [part for part in parts if len(part.numbers)]


def _of_map(depth: DepthMap, points: _Part, images: PosedImages, random: np.random.Generator, most: int) -> _Part:
    """The readings of a depth map; as depths, if the view's sparse points say which they are."""
    lines, numbers = depth.camera.sight_lines().numpy().reshape(-1, 3), depth.numbers.reshape(-1).astype(np.float64)
    rows = np.flatnonzero(np.isfinite(numbers))
    if len(rows) > most:
        rows = np.sort(random.choice(rows, most, replace=False))
    lines, numbers = lines[rows], numbers[rows]
    if depth.kind == "metric":
        return _Part(lines, numbers / images.similarity.scale, AS_IT_IS, exact=True, view=points.view)
    form = RELATIVE if depth.kind == "relative" else DISPARITY
    here, at_points = _numbers_at(depth, points)
    wanted = torch.from_numpy(at_points if form == RELATIVE else 1 / at_points)
    group = torch.zeros(len(wanted), dtype=torch.int64)
    scale, shift = fit_scale_shift(torch.from_numpy(here), wanted, group, 1)[0].tolist()
    if not scale:
        return _Part(lines, numbers, form, exact=False, view=points.view)
    mapped = scale * numbers + shift
    ahead = mapped > 0
    mapped = mapped[ahead] if form == RELATIVE else 1 / mapped[ahead]
    return _Part(lines[ahead], mapped, AS_IT_IS, exact=False, view=points.view)


def _numbers_at(depth: DepthMap, points: _Part) -> tuple[Float64, Float64]:
    """A map's numbers where its view saw sparse points ``(N,)``, and the depths of these ``(N,)`` in radii."""
    row, column, inside = _pixels(depth.camera, points.lines)
    numbers = depth.numbers[row, column].astype(np.float64)
    known = inside & np.isfinite(numbers)
    return numbers[known], points.numbers[known]


def _on_object(view: PosedImage, part: _Part) -> _Part:
    """Those that the view's mask, if it has one, takes for object: what is behind is not there for the training."""
    if view.mask is None or not len(part.numbers):
        return part
    row, column, inside = _pixels(view.camera, part.lines)
    kept = inside & (view.mask[row, column] > OBJECT)
    return replace(part, lines=part.lines[kept], numbers=part.numbers[kept])


def _pixels(camera: Camera, lines: Float64) -> tuple[Int64, Int64, NDArray[np.bool_]]:
    """Rows and columns of the pixels that lines of sight ``(N, 3)`` pass, the nearest ones of those that pass none."""
    pixels = np.rint(camera.pixels_at(lines[:, :2])).astype(np.int64)
    nearest = pixels.clip(0, (camera.width - 1, camera.height - 1))
    return nearest[:, 1], nearest[:, 0], (nearest == pixels).all(axis=1)


def said_outside(share: float) -> str | None:
    """A warning if too small a share of the depths of maps in the cameras' units ends in the region; else None."""
    if share >= LIMITS.inside:
        return None
    return f"{share:.1%} of the depths in all maps end in the region of interest; {UNITS}"


def _check_units(source: Path, in_region: Sequence[float], ratios: Sequence[Float64]) -> None:
    """Refuse maps that cannot be in the cameras' units.

    By the share of each map's readings that end in the region, and the ratios of its depths to those of sparse points.
    """
    if outside := said_outside(float(np.mean(in_region))):
        raise InputError(f"{source}: {outside}")
    together = np.concatenate(ratios)
    if len(together) >= LIMITS.fewest and not 1 / LIMITS.alike < np.median(together) < LIMITS.alike:
        times = f"depths in all maps are {np.median(together):.3g} times those of the sparse points"
        raise InputError(f"{source}: {times}; {UNITS}")
