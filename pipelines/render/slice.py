"""A plane through a field: its values there, and the picture of them (paper Fig. 4), in the field's coordinates.

Unit vectors ``u`` (right) and ``v`` (up) span the plane, seen from the side to which ``u × v`` points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.files import to_bytes
from ...neural_fields import Field
from .picture import Color, Image

Array = NDArray[np.floating]
Floats = NDArray[np.float32]
Vector = Sequence[float] | NDArray[np.float64]

# Near the surface and far from it; blue outside, orange inside.
OUTSIDE: tuple[Color, Color] = ((0.91, 0.95, 0.98), (0.42, 0.60, 0.79))
INSIDE: tuple[Color, Color] = ((1.00, 0.93, 0.84), (0.87, 0.53, 0.27))
FINEST: Color = (0.11, 0.13, 0.19)
COARSER: tuple[Color, ...] = ((0.05, 0.53, 0.42), (0.63, 0.20, 0.58), (0.78, 0.14, 0.20), (0.35, 0.35, 0.70))


@dataclass(frozen=True)
class Style:
    """How slices are drawn; widths are in pixels of a picture 640 pixels high.

    Attributes:
        tint: share of its colour that a band lays over what is below.
        fade: share of the half height at which 1 − 1/e of the far colour is reached.
    """

    tint: float = 0.34
    fade: float = 0.35
    line: float = 0.9
    zero_line: float = 2.2
    outline: float = 1.0


STYLE = Style()


def plane_axes(normal: Vector, *, up: str = "y") -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The axes (u, v) of a plane seen from the side to which ``normal`` points, with ``up`` ("y" or "z") upwards.

    On a plane across the up axis, −z (for "y") or y (for "z") is up, as on a map. Raises ValueError.
    """
    n = np.asarray(normal, np.float64)
    length = float(np.linalg.norm(n))
    if n.shape != (3,) or not 0 < length < np.inf:
        raise ValueError(f"normal={normal}: expected three numbers, not all zero")
    if up not in ("y", "z"):
        raise ValueError(f"up={up!r}: expected 'y' or 'z'")
    n = n / length
    upwards = np.array([0.0, 1, 0] if up == "y" else [0.0, 0, 1])
    if abs(n @ upwards) > 0.999:
        upwards = np.array([0.0, 0, -1] if up == "y" else [0.0, 1, 0])
    v = upwards - (n @ upwards) * n
    v /= np.linalg.norm(v)
    return np.cross(v, n), v


def slice_points(*, origin: Vector, u: Vector, v: Vector, half_size: float, size: tuple[int, int]) -> Tensor:
    """The points ``(H, W, 3)`` in float64 at the centres of a picture's pixels, around ``origin``.

    ``half_size`` is half the height of the picture, ``size`` its width and height in pixels. Raises ValueError.
    """
    width, height = size
    if not (0 < half_size < math.inf and width > 0 and height > 0):
        raise ValueError(f"half_size={half_size}, size={size}: expected numbers > 0")
    step = 2 * half_size / height
    right = (np.arange(width) - (width - 1) / 2) * step
    upward = ((height - 1) / 2 - np.arange(height)) * step
    points = np.asarray(origin, np.float64) + right[:, None] * np.asarray(u) + upward[:, None, None] * np.asarray(v)
    return torch.from_numpy(points)


@dataclass(frozen=True)
class Slice:
    """The values of all levels on a plane.

    Attributes:
        levels: ``(H, W)`` float32 each; outside the band of a level, the next is equal.
        bands: ``(H, W)`` bool for each level with a band: where it and every coarser level are in theirs.
        deltas: half-width of each band, in the field's units.
        pixel: side of a pixel, likewise.
        finest: whether the last of ``levels`` is the field's finest.
    """

    levels: tuple[Floats, ...]
    bands: tuple[NDArray[np.bool_], ...]
    deltas: tuple[float, ...]
    pixel: float
    finest: bool


def take_slice(
    field: Field, *, origin: Vector, u: Vector, v: Vector, half_size: float, size: tuple[int, int], level: int = -1
) -> Slice:
    """Evaluate every level up to ``level``, each one only in the band of the one before; see `slice_points`."""
    level = field.resolve_level(level)
    points = slice_points(origin=origin, u=u, v=v, half_size=half_size, size=size).to(field.like)
    deltas = tuple(float(delta) for delta in field.deltas[: level + 1])
    with torch.inference_mode():
        levels = field.level_values(points, level=level)
        inside, bands = torch.ones_like(levels[0], dtype=torch.bool), []
        for value, delta in zip(levels, deltas, strict=False):
            inside = inside & (value.abs() < delta)
            bands.append(inside)
    return Slice(
        tuple(values.float().cpu().numpy() for values in levels),
        tuple(band.cpu().numpy() for band in bands),
        deltas,
        2 * half_size / size[1],
        level == field.num_levels - 1,
    )


def draw_slice(taken: Slice, *, iso_step: float, bands: bool = True) -> Image:
    """The picture ``(H, W, 3)`` of a slice; ``iso_step`` > 0 is in the field's units.

    Sign and distance of the finest level as colour, iso-lines (every fifth stronger), bands ``|f_i| < δ_i``, and the
    zero set of each level. Lines are equally wide at any gradient: a pixel is ``|f − c| / |∇f|`` away from one.
    """
    if not 0 < iso_step < math.inf:
        raise ValueError(f"iso_step={iso_step}: expected a number > 0")
    values = taken.levels[-1]
    height = values.shape[0]
    stroke = max(height / 640, 0.75)
    slope = _slope(values, taken.pixel)
    image = distance_color(values, reach=STYLE.fade * taken.pixel * height / 2, slope=slope)

    nearest = np.rint(values / iso_step)
    far = np.abs(values - nearest * iso_step) / slope
    strong = nearest % 5 == 0
    lines = _stroke(far, STYLE.line * stroke * np.where(strong, 1.25, 1.0)) * np.where(strong, 0.50, 0.26)
    lines[nearest == 0] = 0
    ink = np.where((values < 0)[..., None], np.multiply(INSIDE[1], 0.45), np.multiply(OUTSIDE[1], 0.45))
    image += lines[..., None] * (ink - image)

    if bands:
        for index, (band, delta) in enumerate(zip(taken.bands, taken.deltas, strict=True)):
            _lay(image, level_color(index), STYLE.tint * band)
            level = taken.levels[index]
            edge = np.abs(np.abs(level) - delta) / _slope(level, taken.pixel)
            # A band ends where its own level leaves it; where a coarser band ends first, so does the line.
            allowed = taken.bands[index - 1] if index else np.ones_like(band)
            _lay(image, level_color(index), 0.8 * _stroke(edge, STYLE.outline * stroke) * allowed)
    for index, level in enumerate(taken.levels):
        last = index == len(taken.levels) - 1
        color = FINEST if last and taken.finest else level_color(index)
        width = STYLE.zero_line * stroke * (1.0 if last else 0.75)
        _lay(image, color, _stroke(np.abs(level) / _slope(level, taken.pixel), width))
    return to_bytes(image)


def distance_color(values: Floats, *, reach: float, slope: Floats | float) -> Floats:
    """Blue outside and orange inside, deeper with distance, ``(..., 3)``; ``slope`` per pixel smooths the edge."""
    share = (1 - np.exp(-np.abs(values) / reach))[..., None]
    outside = np.multiply(1 - share, OUTSIDE[0]) + np.multiply(share, OUTSIDE[1])
    inside = np.multiply(1 - share, INSIDE[0]) + np.multiply(share, INSIDE[1])
    return inside + (outside - inside) * (0.5 + values / slope).clip(0, 1)[..., None]


def level_color(index: int) -> Color:
    """The colour of a level that is not the finest: of its zero set and its band."""
    return COARSER[index % len(COARSER)]


def round_step(length: float) -> float:
    """The number 1, 2 or 5 times a power of ten that is nearest to ``length`` > 0 in ratio."""
    power = 10.0 ** math.floor(math.log10(length))
    return min((1 * power, 2 * power, 5 * power, 10 * power), key=lambda step: abs(math.log(step / length)))


def _slope(values: Floats, pixel: float) -> Floats:
    """|∇f| per pixel ``(H, W)``; on ridges, where it vanishes, a tenth of a distance's, so that lines end there."""
    padded = np.pad(values, 1, mode="reflect", reflect_type="odd")  # central differences up to the border
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    down = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    return np.maximum(np.hypot(across, down), 0.1 * pixel).astype(np.float32)


def _stroke(distance: Array, width: float | Array) -> Floats:
    """The share of each pixel that a line ``width`` pixels wide covers, ``distance`` pixels from its middle."""
    return np.clip(np.asarray(width) / 2 + 0.5 - distance, 0, np.minimum(width, 1)).astype(np.float32)


def _lay(image: Floats, color: Color, cover: Floats) -> None:
    """Paint ``color`` over the image, in place."""
    image += cover[..., None] * (np.asarray(color, np.float32) - image)
