"""Colours for what an image sees: pure functions of `Seen`, on its device, for the pixels that see something.

Fields, meshes and clouds, in pictures, films and the viewer, all stand under these lamps and have these colour maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...datasets.cameras import Camera
from ...neural_fields import Field
from ..training.settings import SHADINGS, ShadeOptions
from .light import ambient_occlusion, level_set_curvature, load_matcap, sample_matcap, soft_shadow
from .picture import Image
from .trace import Seen

__all__ = [
    "COLOR_MAPS",
    "SHADINGS",
    "ShadeOptions",
    "apply_color_map",
    "compose",
    "default_shading",
    "downsample",
    "measure",
    "shade",
    "value_limits",
]

Float32 = NDArray[np.float32]
Color = tuple[float, float, float]

GAMMA = 2.2  # between display values, in which images are stored, and light, which adds up


@dataclass(frozen=True)
class Lamps:
    """The studio of all pictures: directions in the camera's axes (right, up, towards the eye), and linear light.

    Attributes:
        key: direction to the key lamp.
        fill: direction to the fill lamp.
        raking: direction to a lamp twelve degrees above a face that looks at the camera, which a wave of one degree
            makes a twelfth brighter.
        key_light: on a surface that faces the lamp.
        fill_light: likewise.
        sky_light: from above; a little cool.
        ground_light: from below; a little warm.
        back: display colour of back faces.
        behind: cosine of the view with a normal beyond which the back is seen, not a rim with a finer level's normal.
    """

    key: Color = (-0.55, 0.70, 0.60)
    fill: Color = (0.75, 0.05, 0.65)
    raking: Color = (-math.cos(math.radians(12)), 0.0, math.sin(math.radians(12)))
    key_light: Color = (0.96, 0.93, 0.88)
    fill_light: Color = (0.17, 0.18, 0.20)
    sky_light: Color = (0.34, 0.36, 0.39)
    ground_light: Color = (0.15, 0.14, 0.13)
    back: Color = (0.62, 0.36, 0.33)
    behind: float = 0.2


LAMPS = Lamps()
_MAPS = {"depth": "viridis", "curvature": "diverging", "error": "magma"}


def _from_opencv(name: int) -> Float32:
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, name)[:, 0, ::-1]) / np.float32(255)


def _between(anchors: tuple[Color, ...]) -> Float32:
    at = np.linspace(0, 1, len(anchors))
    ramp = np.linspace(0, 1, 257)
    return np.stack([np.interp(ramp, at, channel) for channel in zip(*anchors, strict=True)], 1).astype(np.float32)


# (K, 3) tables in display RGB, from the low end to the high one.
COLOR_MAPS: dict[str, Float32] = {
    "viridis": _from_opencv(cv2.COLORMAP_VIRIDIS),
    "magma": _from_opencv(cv2.COLORMAP_MAGMA),
    # Blue – pale – red: the ends equally dark, the middle almost the white of the page.
    "diverging": _between(
        ((0.09, 0.25, 0.55), (0.36, 0.60, 0.83), (0.94, 0.94, 0.92), (0.90, 0.52, 0.34), (0.60, 0.10, 0.14))
    ),
}


def default_shading(*, oriented: bool, colored: bool) -> str:
    """The shading of what has normals, or at least colours, or neither: "lambert", "color" or "depth"."""
    if oriented:
        return "lambert"
    return "color" if colored else "depth"


def shade(
    seen: Seen,
    shading: str,
    *,
    camera: Camera,
    field: Field | None = None,
    level: int = -1,
    options: ShadeOptions | None = None,
    matcap: Tensor | None = None,
    reference: KDTree | None = None,
    values: Tensor | None = None,
) -> Tensor:
    """Colour the pixels that see something.

    Args:
        seen: what they see.
        shading: one of `SHADINGS`.
        camera: in the coordinates of ``seen``; lamps and matcaps turn with it.
        field: for shadows, occlusion and curvature.
        level: the level that is seen.
        options: settings.
        matcap: ``(H, W, 3)`` from `load_matcap`; by default ``options.matcap`` is loaded.
        reference: the cloud from which the error is measured.
        values: ``(P,)`` numbers to map to colours, where they are known and need not be measured.

    Returns:
        ``(P, 3)`` display RGB in [0, 1].

    Raises:
        ValueError: no such shading, or it needs a field, colours or a reference that is not there.
        InputError: the matcap of the options cannot be read.
    """
    options = options or ShadeOptions()
    if shading not in SHADINGS:
        raise ValueError(f"shading={shading!r}: expected one of {', '.join(SHADINGS)}")
    if shading == "lambert":
        return _lambert(seen, camera, field, level, options)
    if shading == "headlight":
        light = 0.05 + 0.95 * _facing(seen) ** 2  # the square, because cosines alone leave shapes flat
        return _to_display(_albedo(seen, options) * light[:, None])
    if shading == "raking":
        return _raking(seen, camera, options)
    if shading == "normals":
        return (seen.normal + 1) / 2
    if shading == "color":
        if seen.color is None:
            raise ValueError("shading='color': the surface has no colours; shade it 'lambert'")
        return seen.color
    if shading == "matcap":
        return sample_matcap(load_matcap(options.matcap) if matcap is None else matcap, _view_normals(seen, camera))
    if values is None:
        values = measure(seen, shading, field=field, level=level, reference=reference, detail=options.detail)
    low, high = value_limits(values, shading, options)
    # What is near is light, what is far from the reference dark: of those two maps the light end is the high one.
    colors = apply_color_map(values, (low, high) if shading == "curvature" else (high, low), COLOR_MAPS[_MAPS[shading]])
    if shading == "depth":
        return colors
    return colors * (1 - options.relief * (1 - _facing(seen)))[:, None]


def measure(
    seen: Seen,
    shading: str,
    *,
    field: Field | None = None,
    level: int = -1,
    reference: KDTree | None = None,
    detail: float = 4e-3,
) -> Tensor:
    """The numbers ``(P,)`` that "depth", "curvature" and "error" show, in the units of ``seen``.

    Args:
        seen: what the pixels see.
        shading: one of the three.
        field: whose curvature.
        level: of the field.
        reference: the cloud from which the error is measured.
        detail: step of the differences of which the curvature is made, see `level_set_curvature`.

    Raises:
        ValueError: another shading, or it needs a field or a reference that is not there.
    """
    if shading == "depth":
        return seen.depth
    if shading == "curvature":
        if field is None:
            raise ValueError("shading='curvature': needs a field; a mesh has none")
        return level_set_curvature(field, seen.position, level=level, step=detail)
    if shading == "error":
        if reference is None:
            raise ValueError("shading='error': needs a reference cloud to measure from")
        distances = reference.query(seen.position.detach().cpu().double().numpy())[0]
        return torch.as_tensor(np.asarray(distances)).to(seen.position)
    raise ValueError(f"shading={shading!r}: expected one of {', '.join(_MAPS)}")


def value_limits(values: Tensor, shading: str, options: ShadeOptions) -> tuple[float, float]:
    """The values at the two ends of the colour map, for a legend, or for all frames of a turntable.

    They are ``options.limits`` if given. Otherwise "depth" spans all ``values``; "error" starts at 0 and holds
    ``options.quantile`` of them; "curvature" does so too, and is symmetric.
    """
    if options.limits is not None:
        return options.limits
    if not len(values):
        return (0.0, 1.0)
    if shading == "depth":
        return float(values.min()), float(values.max())
    magnitude = values.abs()
    # kthvalue, not quantile: that refuses more than 16 million values.
    rank = max(1, round(options.quantile * len(magnitude)))
    high = float(magnitude.kthvalue(rank).values)
    return (-high if shading == "curvature" else 0.0), high


def apply_color_map(values: Tensor, limits: tuple[float, float], table: Float32) -> Tensor:
    """Colours of ``values`` ``(P,)`` → ``(P, 3)``, linear between the entries of ``table`` and clamped at its ends.

    Args:
        values: numbers.
        limits: the values at the first and at the last entry; they may run backwards. Where they are equal, all
            values get the middle.
        table: ``(K, 3)`` display RGB.
    """
    low, high = limits
    share = (values - low) / (high - low) if high != low else torch.full_like(values, 0.5)
    colors = torch.as_tensor(table, dtype=values.dtype, device=values.device)
    place = share.clamp(0, 1) * (len(table) - 1)
    lower = place.floor().clamp(max=len(table) - 2)
    index = lower.long()
    return torch.lerp(colors[index], colors[index + 1], (place - lower)[:, None])


def compose(seen: Seen, rgb: Tensor, *, background: Sequence[float] | None = (1.0, 1.0, 1.0)) -> Image:
    """Put colours ``(P, 3)`` into an image: ``(H, W, 3)`` on a background; without one ``(H, W, 4)``, transparent."""
    width, height = seen.size
    bytes_seen = (rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    if background is None:
        canvas = rgb.new_zeros((height * width, 4), dtype=torch.uint8)
        bytes_seen = torch.cat((bytes_seen, torch.full_like(bytes_seen[:, :1], 255)), 1)
    else:
        paper = (torch.tensor(background, device=rgb.device).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
        canvas = paper.repeat(height * width, 1)
    canvas[seen.pixel] = bytes_seen
    return canvas.reshape(height, width, -1).cpu().numpy()


def downsample(image: Image, factor: int) -> Image:
    """Average blocks of ``factor`` × ``factor`` pixels; of RGBA the colours by their alpha, so that rims keep theirs.

    Raises:
        ValueError: the factor is below 1, or does not divide the sides of the image.
    """
    height, width, channels = image.shape
    if factor < 1 or height % factor or width % factor:
        raise ValueError(f"factor={factor}: expected a divisor of both sides of a {width} × {height} image")
    if factor == 1:
        return image
    size = (width // factor, height // factor)
    if channels == 3:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    weighted = image.astype(np.float32)
    weighted[..., :3] *= weighted[..., 3:] / 255
    mean = cv2.resize(weighted, size, interpolation=cv2.INTER_AREA)
    mean[..., :3] *= 255 / np.maximum(mean[..., 3:], 1e-3)
    return (mean + 0.5).astype(np.uint8)


def _lambert(seen: Seen, camera: Camera, field: Field | None, level: int, options: ShadeOptions) -> Tensor:
    """Albedo times the light of two lamps and of sky and ground, the lamps a little off the camera's axis.

    The key lamp is cut off by shadows, and everything else by occlusion; half of it dims the key lamp as well, which
    keeps narrow creases readable in full light.
    """
    if field is None and (options.shadows or options.occlusion):
        raise ValueError("shading='lambert': shadows and occlusion are traced in a field, and there is none")
    normal = _towards_viewer(seen)
    axes = torch.stack((camera.right, -camera.down, -camera.forward)).to(normal)
    lamps = torch.nn.functional.normalize(normal.new_tensor((LAMPS.key, LAMPS.fill)), dim=1) @ axes
    key, fill = (normal @ lamps.T).clamp(min=0).unbind(1)
    lower = 0.5 - 0.5 * (normal @ axes[1])  # 0 for what faces the sky, 1 for what faces the ground
    open_ = None
    if field is not None:
        where = options.light_level if options.light_level is not None else level
        if options.shadows:
            key = key * soft_shadow(field, seen.position, normal, lamps[0], level=where, softness=options.softness)
        if options.occlusion:
            open_ = ambient_occlusion(field, seen.position, normal, level=where, reach=options.reach)
            key = key * (0.5 + 0.5 * open_)
    ambient = torch.lerp(_light(LAMPS.sky_light, normal), _light(LAMPS.ground_light, normal), lower[:, None])
    rest = torch.addcmul(ambient, fill[:, None], _light(LAMPS.fill_light, normal))
    if open_ is not None:
        rest = rest * open_[:, None]
    light = torch.addcmul(rest, key[:, None], _light(LAMPS.key_light, normal))
    return _to_display(_albedo(seen, options) * light)


def _raking(seen: Seen, camera: Camera, options: ShadeOptions) -> Tensor:
    """Albedo times the light of a lamp at the left: half of it on what faces the camera, all at twice its cosine."""
    normal = _towards_viewer(seen)
    axes = torch.stack((camera.right, -camera.down, -camera.forward)).to(normal)
    light = normal @ (normal.new_tensor(LAMPS.raking) @ axes) / (2 * LAMPS.raking[2])
    return _to_display(_albedo(seen, options) * light.clamp(0.02, 1)[:, None])


def _towards_viewer(seen: Seen) -> Tensor:
    """Normals ``(P, 3)`` that face the viewer: a back's is turned round, that of a rim (a finer level's) mirrored."""
    cosine = _cosine(seen)[:, None]
    mirrored = seen.normal - 2 * cosine * seen.direction
    return torch.where(cosine > LAMPS.behind, -seen.normal, torch.where(cosine > 0, mirrored, seen.normal))


def _albedo(seen: Seen, options: ShadeOptions) -> Tensor:
    """What the surface reflects, in linear light: ``(P, 3)``, or ``(3,)`` where it is the same everywhere."""
    albedo = _light(options.clay, seen.normal) if seen.color is None else seen.color
    if options.back_faces:
        behind = _cosine(seen) > LAMPS.behind
        albedo = torch.where(behind[:, None], _light(LAMPS.back, seen.normal), albedo)
    return albedo**GAMMA


def _to_display(light: Tensor) -> Tensor:
    return light.clamp(0, 1) ** (1 / GAMMA)


def _light(color: Color, like: Tensor) -> Tensor:
    return torch.tensor(color, dtype=like.dtype, device=like.device)


def _cosine(seen: Seen) -> Tensor:
    """Cosine of the normal with the view: negative where the front is seen."""
    return (seen.normal * seen.direction).sum(-1)


def _facing(seen: Seen) -> Tensor:
    return _cosine(seen).abs()


def _view_normals(seen: Seen, camera: Camera) -> Tensor:
    """Normals ``(P, 3)`` with z towards the eye and x right: of each pixel's own view, so that rims are rims."""
    towards = -seen.direction
    right = torch.linalg.cross((-camera.down).to(towards).expand_as(towards), towards)
    right = torch.nn.functional.normalize(right, dim=-1)
    up = torch.linalg.cross(towards, right)
    return torch.stack([(seen.normal * axis).sum(-1) for axis in (right, up, towards)], -1)
