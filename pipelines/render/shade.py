"""Colours for what an image sees: shadings, shadows, occlusion and curvature, as functions of `Seen`.

Fields, meshes and clouds, in pictures and films, share these lamps and colour maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...datasets.cameras import Camera
from ...neural_fields import Field
from ...neural_fields.backend.arrays import Float32
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS, ball_crossing
from ..training.settings import SHADINGS, ShadeOptions
from .picture import Color, Image
from .trace import Seen

# u below which a ray is given up as dark: v is 0.001 there, and steps only get smaller.
DARK = 0.02


@torch.no_grad()
def soft_shadow(
    field: Field,
    points: Tensor,
    normals: Tensor,
    towards_light: Tensor,
    *,
    level: int = -1,
    softness: float = 0.15,
    offset: float = 4e-3,
) -> Tensor:
    """How much of a distant lamp each point sees, ``(P,)`` in [0, 1]; edges blur with the distance a shadow falls.

    A ray that meets the surface is dark. Another passes at distance f after t, and its narrowest place counts:

        u = min_t f / (s t),    v = u² (3 − 2 u) for u < 1, else 1,

    with s = ``softness``, or the sine of the lamp's height over the tangent plane if that is less, so that convex
    shapes have no shadows on themselves. Steps are those of a cone of slope s that must not touch the surface,
    (f − s t) / (1 + s); once it does, half of f or a part of the cone's radius. Where a coarse level stands for finer
    ones (f ≥ δ), the surface may be nearer by δ.

    ``points`` and unit ``normals`` are ``(P, 3)``, ``towards_light`` ``(3,)``. Rays start ``offset`` above the surface
    of ``level``.
    """
    level = field.resolve_level(level)
    lamp = towards_light.to(points)
    slack = torch.cat((points.new_zeros(1), field.deltas[:level].to(points)))
    lit = points.new_zeros(len(points))
    height = normals @ lamp
    rows = (height > 0).nonzero()[:, 0]
    slope = height[rows].clamp(max=softness)
    start, above = points[rows], normals[rows]
    start = start + (offset - field.value(start, level=level)).clamp(min=0)[:, None] * above  # if it is not higher
    left = ball_crossing(start, lamp.expand_as(start), BOUNDING_RADIUS)[1]
    t = torch.full_like(left, offset)
    least = torch.ones_like(left)
    for _ in range(160):
        if not len(rows):
            break
        f = field.value(start + t[:, None] * lamp, level=level)
        least = torch.minimum(least, f / (slope * t))
        near = f - torch.where(f[:, None] >= slack, slack, 0).amax(1)
        # Steps inside the penumbra, in radii of the cone: with 0.5 streaks show on curved surfaces.
        step = torch.maximum((near - slope * t) / (1 + slope), 0.2 * softness * t)
        step = torch.minimum(torch.maximum(step, near / 2), near)
        t = t + step.clamp(min=offset / 4)
        going = (least > DARK) & (t < left)
        lit[rows[~going]] = _light_through(least[~going])
        kept = going.nonzero()[:, 0]
        rows, slope, start, left, t, least = (each[kept] for each in (rows, slope, start, left, t, least))
    lit[rows] = _light_through(least)
    return lit


@torch.no_grad()
def ambient_occlusion(
    field: Field, points: Tensor, normals: Tensor, *, level: int = -1, reach: float = 0.15, samples: int = 5
) -> Tensor:
    """How open the surroundings of points ``(P, 3)`` are: 1 on a plane or a convex shape, 0 in the depth of a slit.

    The mean of clamp((f(p + d n) − f(p)) / d, 0, 1) over ``samples`` distances d along the normal, up to ``reach``.
    """
    steps = reach * torch.arange(1, samples + 1, dtype=points.dtype, device=points.device) / samples
    here = field.value(points, level=level)
    above = field.value(points + steps[:, None, None] * normals, level=level)  # (S, P)
    return ((above - here) / steps[:, None]).clamp(0, 1).mean(0)


def _light_through(u: Tensor) -> Tensor:
    u = torch.where(u > DARK, u, 0).clamp(max=1)
    return u * u * (3 - 2 * u)


@torch.no_grad()
def level_set_curvature(field: Field, points: Tensor, *, level: int = -1, step: float = 2e-3) -> Tensor:
    """H = ½ div(∇f / |∇f|) ``(P,)`` of the level set through each point, by central differences: 1/r on a sphere.

    With the unit gradient n, h = ``step`` and the axes eᵢ, 2 H = Σᵢ (nᵢ(p + h eᵢ) − nᵢ(p − h eᵢ)) / 2h. Convex is
    positive. The error grows with h² and with (rounding of n) / h.
    """
    offsets = step * torch.eye(3).to(points)[:, None]  # (3, 1, 3)
    ahead, behind = (normalize(field.jet(points + o, level=level).gradient, dim=-1) for o in (offsets, -offsets))
    return (ahead - behind).diagonal(dim1=0, dim2=2).sum(-1) / (4 * step)


GAMMA = 2.2  # between display values, in which images are stored, and light, which adds up


@dataclass(frozen=True)
class Lamps:
    """The lamps of all pictures: directions in the camera's axes (right, up, towards the eye), and linear light.

    Attributes:
        raking: twelve degrees above a face that looks at the camera; a wave of one degree makes it a twelfth brighter.
        sky_light: from above.
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


# From the low end of the numbers to the high one: what is near is light, what is far from the reference dark.
SCALES = {
    "depth": COLOR_MAPS["viridis"][::-1].copy(),
    "curvature": COLOR_MAPS["diverging"],
    "error": COLOR_MAPS["magma"][::-1].copy(),
}


def default_shading(*, oriented: bool, colored: bool) -> str:
    """The shading of what has normals, or at least colours, or neither: "lambert", "color" or "depth"."""
    return "lambert" if oriented else "color" if colored else "depth"


def shade(
    seen: Seen,
    shading: str,
    *,
    camera: Camera,
    field: Field | None = None,
    level: int = -1,
    options: ShadeOptions | None = None,
    values: Tensor | None = None,
) -> Tensor:
    """Colours ``(P, 3)``, display RGB in [0, 1], of the pixels that see something.

    ``level`` of ``field`` is what is seen; lamps turn with ``camera``. ``values`` ``(P,)`` are mapped to
    colours if given, and else measured. Raises a ValueError for a shading that is unknown, or needs a field, colours or
    a reference that is not there.
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
    if values is None:
        values = measure(seen, shading, field=field, level=level, detail=options.detail)
    colors = apply_color_map(values, value_limits(values, shading, options), SCALES[shading])
    return colors if shading == "depth" else colors * (1 - options.relief * (1 - _facing(seen)))[:, None]


def measure(seen: Seen, shading: str, *, field: Field | None = None, level: int = -1, detail: float = 4e-3) -> Tensor:
    """The numbers ``(P,)`` that "depth" and "curvature" show, in the units of ``seen``.

    ``detail`` is the step of `level_set_curvature`. Raises a ValueError if a field is missing.
    """
    if shading == "depth":
        return seen.depth
    if shading == "curvature":
        if field is None:
            raise ValueError("shading='curvature': needs a field; a mesh has none")
        return level_set_curvature(field, seen.position, level=level, step=detail)
    raise ValueError(f"shading={shading!r}: expected depth, curvature, or values that were measured before")


def value_limits(values: Tensor, shading: str, options: ShadeOptions) -> tuple[float, float]:
    """The values at the ends of the colour map: ``options.limits``, or those that hold the values.

    "depth" spans all; "error" starts at 0 and holds ``options.quantile`` of them; "curvature" is symmetric as well.
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
    """Colours ``(P, 3)`` of values ``(P,)``, linear between the entries of ``table`` ``(K, 3)``, clamped at its ends.

    ``limits`` may run backwards; where they are equal, all values get the middle.
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
    """Average blocks of ``factor`` × ``factor`` pixels; colours of RGBA are weighted by alpha. Raises ValueError."""
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
    """Albedo times the light of two lamps, sky and ground.

    Shadows dim the key lamp, and occlusion all other light; half of it dims the key lamp too, for visible creases.
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
    ambient = torch.lerp(normal.new_tensor(LAMPS.sky_light), normal.new_tensor(LAMPS.ground_light), lower[:, None])
    rest = torch.addcmul(ambient, fill[:, None], normal.new_tensor(LAMPS.fill_light))
    if open_ is not None:
        rest = rest * open_[:, None]
    light = torch.addcmul(rest, key[:, None], normal.new_tensor(LAMPS.key_light))
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
    albedo = seen.normal.new_tensor(options.clay) if seen.color is None else seen.color
    if options.back_faces:
        behind = _cosine(seen) > LAMPS.behind
        albedo = torch.where(behind[:, None], seen.normal.new_tensor(LAMPS.back), albedo)
    return albedo**GAMMA


def _to_display(light: Tensor) -> Tensor:
    return light.clamp(0, 1) ** (1 / GAMMA)


def _cosine(seen: Seen) -> Tensor:
    """Cosine of the normal with the view: negative where the front is seen."""
    return (seen.normal * seen.direction).sum(-1)


def _facing(seen: Seen) -> Tensor:
    return _cosine(seen).abs()
