"""Whether posed photographs can be right: figures of cameras, in radii of the region of interest, and warnings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...datasets import read_cameras, srgb_to_linear
from ...datasets.cameras import Camera
from ...datasets.clouds.cleaning.orientation import fibonacci_directions
from ...datasets.views.formats.shots import DepthMap, DepthSource
from ...datasets.views.images import PosedImage, PosedImages, read_posed_images
from ...datasets.views.poses.colmap_process import Report as ColmapReport
from ...neural_fields import InputError, Similarity
from ...neural_fields.backend.arrays import Float64
from ..mesh.files import write_mesh
from ..training.progress import Report, counted, silent
from .frustums import camera_mesh
from .hull import Agreement, named
from .measured import UNITS, said_outside
from .model import meets_sphere


@dataclass(frozen=True)
class DepthCheck:
    """How many depth maps a data set has, and how well they fit."""

    maps: int  # how many views have one
    inside: float | None = None  # share of the readings that end in the region; None where their scale is not known
    # share, in the median view, in whose place another view sees further; None: no two maps can be compared
    seen_through: float | None = None
    warnings: tuple[str, ...] = ()  # one line each


def check_depths(images: PosedImages) -> DepthCheck | None:
    """Compare depth maps with the region and with each other; None if there are none.

    Maps of unknown scale and shift are only counted. A reading counts as seen through if it lies 1 % of its depth (the
    noise of sensors) and 2 % of the region's radius before what another view sees in its place.
    """
    maps = [view.depth for view in images.views if view.depth is not None]
    views = [view for view in images.views if view.depth is not None and view.depth.kind == "metric"]
    metric = [view.depth for view in views if view.depth is not None]
    if not metric:
        return DepthCheck(len(maps)) if maps else None
    places = [_places(depth) for depth in metric]
    if not sum(map(len, places)):
        return DepthCheck(len(maps), warnings=("no depth map has a reading",))
    inside = float((np.linalg.norm(images.similarity.to_unit(np.concatenate(places)), axis=1) < 1).mean())
    smallest = list(map(_smallest, views))
    margin = 0.02 * images.similarity.scale
    shares = [_seen_through(index, places[index], metric, smallest, margin) for index in range(len(metric))]
    known = [share for share in shares if share is not None]
    usual = float(np.median(known)) if known else None
    warnings = []
    if outside := said_outside(inside):
        warnings.append(outside)
    elif usual is not None and usual > 0.08:  # exact maps and those of sensors have hardly any
        warnings.append(
            f"the depth maps contradict each other: of the median one others see through {usual:.0%} of the readings; "
            f"are they of these photographs, and along the axis of view? If in other units, {UNITS}"
        )
    return DepthCheck(len(maps), inside, usual, tuple(warnings))


def _smallest(view: PosedImage) -> NDArray[np.float32]:
    """Smallest depth of each pixel and the eight around it ``(H, W)``: inf in background, -1 where one has none."""
    assert view.depth is not None
    numbers = view.depth.numbers
    if view.mask is not None and view.mask.shape == numbers.shape:
        numbers = np.where(view.mask == 0, np.float32(np.inf), numbers)
    known = np.nan_to_num(numbers, nan=-1.0, posinf=np.inf).astype(np.float32)
    return np.asarray(cv2.erode(known, np.ones((3, 3), np.uint8)), np.float32)


def _places(depth: DepthMap) -> Float64:
    """World coordinates ``(N, 3)`` of up to 2,000 readings of a map, evenly over it."""
    rows = np.flatnonzero(np.isfinite(depth.numbers))
    rows = rows[np.linspace(0, len(rows) - 1, min(2000, len(rows))).astype(np.int64)] if len(rows) else rows
    lines = depth.camera.sight_lines().numpy().reshape(-1, 3)[rows]
    pose = depth.camera.world_from_camera.numpy()
    return (lines * depth.numbers.reshape(-1)[rows, None].astype(np.float64)) @ pose[:3, :3].T + pose[:3, 3]


def _seen_through(
    index: int, places: Float64, maps: Sequence[DepthMap], smallest: Sequence[NDArray[np.float32]], margin: float
) -> float | None:
    """Share of one map's readings in whose place four others see something further away; None of fewer than 50."""
    others = np.delete(np.arange(len(maps)), index)
    told = through = 0
    for partner in others[np.linspace(0, len(others) - 1, min(4, len(others))).astype(np.int64)]:
        pixels, z, framed = maps[partner].camera.in_view(places)
        column, row = np.rint(pixels[framed]).astype(np.int64).T
        there = smallest[partner][row, column]
        known = there > 0
        told += int(known.sum())
        through += int((known & (z[framed] < 0.99 * there - margin)).sum())
    return through / told if told >= 50 else None


@dataclass(frozen=True)
class CameraLimits:
    """What is warned of. The values are this project's own, from data sets with and without faults."""

    width: int = 320  # pixels across the images that are checked
    out_of_view: float = 0.25  # share of the views that may miss the middle of the region
    same_place: float = 0.02  # spread of the eyes, as a share of their distance: about one degree of parallax
    # median distance of the axes from where they meet best, as a share of the eyes' distance from there
    apart: float = 0.5
    empty: float = 1e-3  # share of object of a mask below which it is empty
    full: float = 0.999  # share of object of a mask above which it is full
    past_region: float = 0.05  # share of the object's pixels that may see past the region
    exposure: float = 4.0  # times brighter or darker than the median view: two stops


LIMITS = CameraLimits()


@dataclass(frozen=True, eq=False)
class CameraCheck:
    """Figures of cameras around a region of interest; None where there are no points, masks or depth maps."""

    fields_of_view: Float64  # (V, 2) full angles across and down, degrees
    distances: Float64  # (V,) from the eyes to the middle of the region, in its radii
    in_view: Float64  # (V,) share of the region's sphere that falls into the image
    points_inside: float | None  # share of the sparse points that lie in the region
    mask_inside: float | None  # share of the object's pixels whose rays meet the region, in the median view
    depths: DepthCheck | None
    warnings: tuple[str, ...]  # one line each

    def record(self) -> dict[str, Any]:
        """As numbers and lists, for JSON."""
        maps = None
        if (depths := self.depths) is not None:
            maps = {"maps": depths.maps, "share_inside": depths.inside, "share_seen_through": depths.seen_through}
        return {
            "fields_of_view_degrees": self.fields_of_view.tolist(),
            "distances_in_radii": self.distances.tolist(),
            "share_of_sphere_in_view": self.in_view.tolist(),
            "share_of_sparse_points_inside": self.points_inside,
            "share_of_masks_inside": self.mask_inside,
            "depth_maps": maps,
            "warnings": list(self.warnings),
        }


def check_files(
    path: str | Path, out: Path | None = None, depths: DepthSource | None = None, *, allow_missing: bool = False
) -> tuple[PosedImages, CameraCheck, str]:
    """Check a data set → its images (made small), the figures, and both in words.

    A file ``out`` gets `camera_mesh`, in world coordinates. The other arguments are those of `read_posed_images`.

    Raises:
        InputError: the data set cannot be read, or the file not be written.
    """
    cameras = [camera for _, camera in read_cameras(path)]
    read = partial(read_posed_images, path, width=LIMITS.width, depths=depths, allow_missing=allow_missing)
    images, trouble = _read(read, cameras)
    check = check_cameras(images)
    check = replace(check, warnings=(*check.warnings, *trouble))
    sizes = [(camera.width, camera.height) for camera in cameras]
    if out is not None:
        write_mesh(out, camera_mesh(images), images.similarity)
    return images, check, format_check(images, check, sizes)


def _read(read: Callable[..., PosedImages], cameras: Sequence[Camera]) -> tuple[PosedImages, tuple[str, ...]]:
    """The images, around a guessed region where none can be found: that is when cameras most need to be looked at."""
    try:
        return read(), ()
    except InputError as error:
        try:
            images = read(region=_guess(cameras))
        except InputError:
            raise error from None  # it was not the region, then
        return replace(images, region="a guess"), (f"there is no region of interest but a guess: {error}",)


def _guess(cameras: Sequence[Camera]) -> Similarity:
    """A sphere where the axes of view meet, a third as wide as the eyes are far; of radius 1 if they do not differ."""
    eyes, forward = _eyes_and_axes(cameras)
    middle = eyes.mean(axis=0)
    center = middle + _meeting_point(eyes - middle, forward)
    distance = float(np.median(np.linalg.norm(eyes - center, axis=1)))
    spread = float(np.median(np.linalg.norm(eyes - middle, axis=1)))
    # 1e-7 is the rounding of the float32 numbers that files of cameras hold.
    differ = spread > 1e-7 * float(np.linalg.norm(middle))
    return Similarity((float(center[0]), float(center[1]), float(center[2])), distance / 3 if differ else 1.0)


def _eyes_and_axes(cameras: Sequence[Camera]) -> tuple[Float64, Float64]:
    """Where cameras stand ``(V, 3)`` and the unit directions in which they look ``(V, 3)``."""
    eyes, forward = (torch.stack([getattr(camera, name) for camera in cameras]).numpy() for name in ("eye", "forward"))
    return eyes, forward


def check_cameras(images: PosedImages) -> CameraCheck:
    """Work out the figures, and what they warn of."""
    cameras = [view.camera.moved(images.similarity) for view in images.views]
    eyes, forward = _eyes_and_axes(cameras)
    sphere = fibonacci_directions(2000)
    in_view = np.array([camera.in_view(sphere)[2].mean() for camera in cameras])
    middle = np.array([camera.in_view(np.zeros((1, 3)))[2][0] for camera in cameras])
    points = None if images.points is None else images.similarity.to_unit(images.points)
    mask_inside = _mask_inside(images.views, cameras)
    warnings = list(_placement(eyes, forward, middle))
    depths = check_depths(images)
    # Where the cameras are wrong, what the masks and depth maps see of the region says nothing.
    warnings += [
        *_masks(images.views, None if warnings else mask_inside),
        *([] if warnings or (mask_inside or 0) < 1 - LIMITS.past_region else _silhouettes(images)),
        *([] if warnings or depths is None else depths.warnings),
        *_exposure(images.views),
    ]
    return CameraCheck(
        np.array([_field_of_view(camera) for camera in cameras]),
        np.linalg.norm(eyes, axis=1),
        in_view,
        None if points is None or not len(points) else float((np.linalg.norm(points, axis=1) <= 1).mean()),
        mask_inside,
        depths,
        tuple(warnings),
    )


def format_check(images: PosedImages, check: CameraCheck, sizes: Sequence[tuple[int, int]]) -> str:
    """The figures in words, a line for each; ``sizes`` are widths and heights of the images as they are on disk."""
    distinct = list(dict.fromkeys(sizes))
    size = f"{distinct[0][0]} × {distinct[0][1]}" if len(distinct) == 1 else f"{len(distinct)} sizes"
    scale = images.similarity.scale
    digits = max(0, 3 - math.floor(math.log10(scale)))  # to a thousandth of the radius, or finer
    center = ", ".join(f"{round(number, digits) + 0.0:.{digits}f}" for number in images.similarity.center)
    across, down = check.fields_of_view.T
    lines = [
        f"{len(images.views)} views of {size} pixels, from {images.source}",
        *[images.reading] * bool(images.reading),
        f"region of interest: centre ({center}), radius {scale:.{digits}f}; from {images.region}",
        f"field of view: {_range(across, '.1f', '°')} across, {_range(down, '.1f', '°')} down",
        f"camera distances: {_range(check.distances, '.2f')} radii from the centre",
        f"share of the region's sphere in view: {_range(100 * check.in_view, '.0f', ' %')}",
    ]
    if images.points is not None and check.points_inside is not None:
        lines.append(f"sparse points: {len(images.points):,}, {100 * check.points_inside:.0f} % of them in the region")
    if check.mask_inside is not None:
        lines.append(f"masks: {100 * check.mask_inside:.1f} % of the object's pixels see into the region")
    if (depths := check.depths) is not None:
        words = [f"depth maps: {depths.maps} of {len(images.views)} photographs have one"]
        if depths.inside is not None:
            words.append(f"{depths.inside:.1%} of the readings end in the region")
        if depths.seen_through is not None:
            words.append(f"other views see through {depths.seen_through:.1%} of them")
        lines.append("; ".join(words))
    return "\n".join(lines)


def _range(values: Float64, form: str, unit: str = "") -> str:
    low, high = f"{values.min():{form}}", f"{values.max():{form}}"
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit} (median {np.median(values):{form}}{unit})"


def _field_of_view(camera: Camera) -> tuple[float, float]:
    lens = camera.intrinsics.numpy()
    sides = [
        (lens[k, 2] + 0.5, size - 0.5 - lens[k, 2], lens[k, k]) for k, size in enumerate((camera.width, camera.height))
    ]
    across, down = (float(np.degrees(np.arctan(low / focal) + np.arctan(high / focal))) for low, high, focal in sides)
    return across, down


def _placement(eyes: Float64, forward: Float64, middle: NDArray[np.bool_]) -> Iterator[str]:
    """Warnings about where cameras stand and look."""
    count, distance = len(eyes), np.linalg.norm(eyes, axis=1)
    if count == 1:
        yield "there is a single view; a shape needs several, from all sides"
        return
    spread = np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max()
    if spread < LIMITS.same_place * max(1.0, float(np.median(distance))):
        yield "all cameras stand at one place, so nothing tells depth; are the poses really camera-to-world?"
        return
    offset = _meeting_point(eyes, forward) - eyes
    apart = np.linalg.norm(np.cross(offset, forward), axis=1)
    if np.median(apart) > LIMITS.apart * np.median(np.linalg.norm(offset, axis=1)):
        yield "the cameras look at no common place; are the poses really camera-to-world?"
        return
    away = ((offset * forward).sum(axis=1) < 0) | ((eyes * forward).sum(axis=1) > 0)
    if 2 * away.sum() > count:
        yield (
            f"the cameras look away: {int(away.sum())} of {count} have their backs to the region of interest, or to "
            "where their axes meet; is the file in OpenGL or OpenCV convention?"
        )
        return
    if inside := int((distance < 1).sum()):
        yield f"{inside} of {count} cameras stand inside the region of interest; is the region right?"
    if (missing := int((~middle).sum())) > LIMITS.out_of_view * count:
        yield f"the middle of the region of interest is out of view in {missing} of {count}; is the region right?"


def _meeting_point(eyes: Float64, forward: Float64) -> Float64:
    """The point ``(3,)`` nearest to all optical axes, by least squares: Σ (I − dᵢ dᵢᵀ)(p − eᵢ) = 0.

    Of parallel axes, the one of least length: a point opposite the middle of the region.
    """
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (V, 3, 3)
    return np.linalg.lstsq(across.sum(axis=0), (across @ eyes[:, :, None]).sum(axis=0)[:, 0], rcond=1e-9)[0]


def _masks(views: Sequence[PosedImage], inside: float | None) -> Iterator[str]:
    """Warnings about masks."""
    shares = {view.name: float(view.mask.mean()) for view in views if view.mask is not None}
    empty = [name for name, share in shares.items() if share < LIMITS.empty]
    full = [name for name, share in shares.items() if share > LIMITS.full]
    if empty:
        yield f"{len(empty)} of {len(shares)} masks are empty: {named(empty)}"
    if full:
        yield f"{len(full)} of {len(shares)} masks are full: {named(full)}; they tell nothing from its background"
    if inside is not None and inside < 1 - LIMITS.past_region and len(full) < len(shares):
        past = 100 * (1 - inside)
        yield f"{past:.0f} % of the object's pixels see past the region of interest, which cuts it; enlarge it"


def _silhouettes(images: PosedImages) -> Iterator[str]:
    """Warnings about masks that contradict each other."""
    views = [view for view in images.views if view.mask is not None and LIMITS.empty <= view.mask.mean() <= LIMITS.full]
    if not views:
        return
    agreement = Agreement.of(views, images.similarity)
    if agreement.is_inverted:
        yield "the masks cover the borders of the pictures: they look inverted; white is object"
    elif agreement.misfit() > agreement.limits.bare:
        yield "the silhouettes fit no shape: are pictures mirrored or upside down, or camera axes reversed?"
    else:
        if odd := agreement.contradictions():
            names = named([view.name for view in odd])
            yield (
                f"{len(odd)} of {len(views)} silhouettes contradict the others: {names}; is that the right picture, "
                "the right way round, and its pose and mask right?"
            )
            agreement = agreement.without(odd)
        if torn := agreement.holes():
            names = named([agreement.views[index].name for index in torn])
            yield f"{len(torn)} of {len(views)} masks have a hole where all others see object: {names}; fill it"


def _mask_inside(views: Sequence[PosedImage], cameras: Sequence[Camera]) -> float | None:
    """Share of the masked pixels whose rays meet the unit sphere, in the median of the views that have any."""
    shares = []
    for view, camera in zip(views, cameras, strict=True):
        if view.mask is None or not view.mask.any():
            continue
        step = max(1, max(view.mask.shape) // 64)
        size = (max(1, camera.width // step), max(1, camera.height // step))
        weight = cv2.resize(view.mask, size, interpolation=cv2.INTER_AREA).reshape(size[::-1])
        shares.append(float(weight[meets_sphere(camera.resized(*size))].sum() / weight.sum()))
    return float(np.median(shares)) if shares else None


def _exposure(views: Sequence[PosedImage]) -> Iterator[str]:
    """A warning about images that are far brighter or darker than the others."""
    light = np.array([_brightness(view) for view in views])
    usual = np.median(light)
    far = (light > LIMITS.exposure * usual) | (LIMITS.exposure * light < usual)
    if odd := [view.name for view, is_odd in zip(views, far, strict=True) if is_odd]:
        yield f"{len(odd)} of {len(views)} images are two stops or more off the others' brightness: {named(odd)}"


def _brightness(view: PosedImage) -> float:
    """Mean linear light of the object, or of the image where nothing says which that is."""
    light = srgb_to_linear(view.color).mean(axis=-1)
    weight = np.ones_like(light) if view.mask is None or not view.mask.any() else view.mask
    return float((light * weight).sum() / weight.sum())


def colmap_report(report: Report | None) -> ColmapReport:
    """A receiver of COLMAP's progress that passes it on to ``report``."""
    return lambda stage, done, total: counted(report or silent, stage)(done, total)
