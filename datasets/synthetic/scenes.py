"""Synthetic scenes with shapes and colours in closed form, and posed images of them by sphere tracing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Box, Capsule, Field, FunctionField, Similarity, Sphere, Torus, Union, sphere_trace
from ...neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from ...neural_fields.meshing.extract import Mesh, extract_mesh
from ...neural_fields.tracing.sphere import Hits
from ..cameras import UP_AXES, Camera, Float64, look_at
from ..clouds.cleaning.orientation import fibonacci_directions
from ..views.formats.shots import DepthMap
from ..views.images import Float32, PosedImage, PosedImages
from .corner import corner, corner_colors
from .samples import sample_surface
from .statue import Statue

Rgb = tuple[float, float, float]
Size = int | tuple[int, int]  # width and height of images in pixels, or one number for both

RAYS_AT_ONCE = 1 << 17
LAMP = (0.4, 0.7, 0.6)  # towards the lamp, for shaded scenes
AMBIENT = 0.35  # share of ambient light
GLOSS, SHARPNESS = 0.6, 40  # strength and exponent of the highlight (Blinn 1977)


@dataclass(frozen=True)
class Scene:
    """A shape and its paint, both in closed form.

    Attributes:
        name: used in files and messages.
        field: its zero set is the surface, inside the unit sphere.
        color: display RGB ``(N, 3)`` in [0, 1] of points ``(N, 3)``, the same from all directions.
        radius: of a ball around the origin that holds the surface.
        up: "y" or "z", the axis that points up.
        lipschitz: bound on the slope of the field.
        frontal: whether it is photographed from the front alone, as in DTU, and not from all sides.
    """

    name: str
    field: Field
    color: Callable[[Float64], Float64]
    radius: float
    up: str = "y"
    lipschitz: float = 1.0
    frontal: bool = False


def render_scene(
    scene: Scene,
    views: int = 24,
    size: Size = 64,
    *,
    seed: int = 0,
    samples: int = 3,
    shaded: bool = False,
    glossy: bool = False,
    depths: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> PosedImages:
    """Posed images of a scene, with exact poses, colours and masks, and 1000 points of its surface with observations.

    Args:
        scene: from `SCENES`, or another.
        views: number of images.
        size: width and height of the images in pixels, or one number for both.
        seed: of the cameras and the points.
        samples: rays per pixel and direction.
        shaded: whether a fixed lamp lights the shape; without it, the images show the paint itself.
        glossy: whether the lamp has a highlight that moves with the eye.
        depths: whether each image has the depths of its pixels' centres.
        progress: called with ``(done, total)`` after every image, or several small ones.

    Raises:
        ValueError: ``views``, ``size`` or ``samples`` is not positive.
    """
    cameras = cameras_around(scene.radius, up=scene.up, views=views, size=size, seed=seed, frontal=scene.frontal)
    together = max(1, RAYS_AT_ONCE // max(1, cameras[0].width * cameras[0].height * samples**2))
    images: list[PosedImage] = []
    for first in range(0, views, together):
        some = cameras[first : first + together]
        maps = scene_depths(scene, some) if depths else [None] * len(some)
        for camera, seen, depth in zip(some, pictures(scene, some, samples, shaded, glossy), maps, strict=True):
            images.append(PosedImage(f"{len(images):03d}.png", camera, *seen, depth))
        if progress is not None:
            progress(len(images), views)
    points = sample_surface(scene.field, 1000, seed=seed).points
    seen = _observations(scene, points, [view.camera for view in images])
    return PosedImages(tuple(images), Similarity.identity(), "the unit sphere", points, Path(scene.name), seen)


def scene_depths(scene: Scene, cameras: Sequence[Camera]) -> list[DepthMap]:
    """Depths ``(H, W)`` along the axes of view at the centres of the pixels of cameras of one size; NaN for a miss."""
    hits, _ = _traced(scene, cameras)
    maps = []
    for camera, position, mask in zip(cameras, hits.position, hits.mask, strict=True):
        numbers = torch.where(mask, (position - camera.eye) @ camera.forward, torch.nan).float().numpy()
        maps.append(DepthMap(numbers, camera, "metric", Path(scene.name)))
    return maps


def _traced(scene: Scene, cameras: Sequence[Camera]) -> tuple[Hits, Tensor]:
    """Hits of the rays ``(V, H, W)`` of V cameras of one size, and their directions ``(V, H, W, 3)``.

    They are traced together: a few rays take as long as thousands.
    """
    rays = [camera.rays(dtype=torch.float64) for camera in cameras]
    along = torch.stack([directions for _, directions in rays])
    eyes = torch.stack([eye.expand_as(directions) for eye, directions in rays])
    return sphere_trace(scene.field, eyes, along, tolerance=1e-9, lipschitz=scene.lipschitz), along


def _observations(scene: Scene, points: Float64, cameras: Sequence[Camera]) -> NDArray[np.int64]:
    """``(K, 2)`` pairs of a camera and a point ``(P, 3)`` that it sees: in its picture, with nothing before it."""
    eyes = torch.stack([camera.eye for camera in cameras])
    away = torch.from_numpy(points) - eyes[:, None]  # (V, P, 3)
    length = away.norm(dim=-1)
    directions = away / length[..., None]
    hits = sphere_trace(scene.field, eyes[:, None].expand_as(directions), directions, lipschitz=scene.lipschitz)
    free = (hits.mask & (hits.depth > length - 1e-3)).numpy()
    return np.argwhere(free & np.stack([camera.in_view(points)[2] for camera in cameras]))


def pictures(
    scene: Scene, cameras: Sequence[Camera], samples: int = 3, shaded: bool = False, glossy: bool = False
) -> list[tuple[Float32, Float32]]:
    """Pictures by cameras of one size (see `developed`): display RGB ``(H, W, 3)`` and mask ``(H, W)``, in [0, 1].

    Some rows of all of them are traced at a time.
    """
    if samples < 1:
        raise ValueError(f"samples={samples}: expected at least one")
    width, height = cameras[0].width, cameras[0].height
    rows = max(1, RAYS_AT_ONCE // (len(cameras) * width * samples**2))
    strips = []
    for first in range(0, height, rows):
        some = [camera.strip(first, min(rows, height - first)) for camera in cameras]
        hits, along = _traced(scene, [each.resized(samples * width, samples * each.height) for each in some])
        mask = hits.mask.numpy()
        light = np.zeros((*mask.shape, 3))
        light[mask] = _light(scene, hits.position.numpy()[mask], along.numpy()[mask], shaded, glossy)
        strips.append([developed(light[view], mask[view], samples) for view in range(len(cameras))])
    views = ((np.concatenate(part) for part in zip(*own, strict=True)) for own in zip(*strips, strict=True))
    return [(color, mask) for color, mask in views]


def _light(scene: Scene, points: Float64, directions: Float64, shaded: bool, glossy: bool) -> Float64:
    """Linear light ``(N, 3)`` of points ``(N, 3)`` of the surface, seen along ``directions`` ``(N, 3)``."""
    light = srgb_to_linear(scene.color(points))
    if not (shaded or glossy):
        return light
    with torch.inference_mode():
        gradient = scene.field.jet(torch.from_numpy(points)).gradient.numpy()
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    return lit(light, normals, directions, shaded=shaded, glossy=glossy)


def scene_mesh(scene: Scene, *, resolution: int = 256) -> Mesh:
    """The true surface with its colours, as a mesh; ``resolution`` is in cells along the side of the cube around it."""
    side = 1.02 * scene.radius
    bounds = ((-side, -side, -side), (side, side, side))
    mesh = extract_mesh(scene.field, resolution=resolution, bounds=bounds, lipschitz=max(1.25, scene.lipschitz))
    return replace(mesh, colors=scene.color(mesh.vertices).astype(np.float32))


def _figure() -> Scene:
    corners = [(x, -0.2, z) for x in (-0.24, 0.24) for z in (-0.24, 0.24)]
    field = Union(
        Box(half_size=(0.36, 0.1, 0.36), center=(0.0, -0.36, 0.0)),
        Sphere(radius=0.29, center=(0.0, 0.0, 0.0)),
        Sphere(radius=0.16, center=(0.0, 0.38, 0.0)),
        Capsule(start=(-0.15, 0.05, 0.0), end=(-0.5, 0.28, 0.12), radius=0.065),
        Capsule(start=(0.15, 0.05, 0.0), end=(0.42, -0.05, 0.3), radius=0.065),
        *(Sphere(radius=0.09, center=corner) for corner in corners),
    )
    return Scene("figure", field, _checks, radius=0.7)


def _statue() -> Scene:
    statue = Statue()
    return Scene("statue", statue, lambda points: statue.colors(points).astype(np.float64), 1.0, up="z", lipschitz=1.5)


def _mix(first: Rgb, second: Rgb, share: Float64) -> Float64:
    return np.array(first) + share[:, None] * (np.array(second) - np.array(first))


def _spots(points: Float64) -> Float64:
    """Soft patches of many hues: sines of the coordinates with a phase for each channel."""
    x, y, z = points.T
    waves = [9 * x + 4 * np.sin(5 * y), 9 * y + 4 * np.sin(5 * z) + 1, 9 * z + 4 * np.sin(5 * x) + 2]
    return 0.5 + 0.4 * np.sin(np.stack(waves, axis=1))


def _stripes(points: Float64) -> Float64:
    """Ten stripes that wind three times around the tube of the torus, with soft edges."""
    x, y, z = points.T
    around, tube = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) - 0.45)
    share = 0.5 + 0.5 * np.tanh(2.5 * np.sin(10 * around + 3 * tube))
    return _mix((0.93, 0.76, 0.25), (0.12, 0.28, 0.52), share) * (0.9 + 0.1 * np.cos(tube))[:, None]


def _checks(points: Float64) -> Float64:
    """A board of cubes a tenth wide with soft edges; its two colours change slowly with the place."""
    board = np.prod(np.tanh(4 * np.sin(10 * np.pi * (points + 0.013))), axis=1)
    hue = 0.5 + 0.5 * np.sin(4 * points[:, 1] + 3 * points[:, 0])
    light = _mix((0.95, 0.90, 0.78), (0.70, 0.88, 0.80), hue)
    dark = _mix((0.62, 0.18, 0.14), (0.20, 0.22, 0.50), hue)
    return dark + (0.5 + 0.5 * board)[:, None] * (light - dark)


def cameras_around(
    radius: float,
    *,
    up: str = "y",
    views: int = 24,
    size: Size = 64,
    seed: int = 0,
    middle: Sequence[float] = (0, 0, 0),
    frontal: bool = False,
) -> list[Camera]:
    """Upright cameras on a sphere around a ball of ``radius``, with all of it in their images.

    They stand on a Fibonacci lattice that is turned at random, or moved where they are `frontal_directions`: another
    seed gives other views.
    """
    width, height = (size, size) if isinstance(size, int) else size
    for name, number in (("views", views), ("size", min(width, height))):
        if number < 1:
            raise ValueError(f"{name}={number}: expected at least one")
    random, distance = np.random.default_rng(seed), 4.0  # of the eyes from the middle, in radii
    if frontal:
        away = distance * radius * frontal_directions(views, float(random.uniform()), up=up)
    else:
        # The orthogonal factor of a Gaussian matrix is a uniform rotation or reflection.
        away = distance * radius * fibonacci_directions(views) @ np.linalg.qr(random.normal(size=(3, 3)))[0].T
    eyes = np.array(middle) + away
    # A ball of radius r at distance d fills the angle 2 asin(r / d); one of 1.1 radii fills the shorter side.
    half = np.arcsin(1.1 / distance)
    half = half if height <= width else np.arctan(np.tan(half) * height / width)
    fov = 2 * float(np.degrees(half))
    return [look_at(torch.from_numpy(eye), middle, up=UP_AXES[up], fov=fov, width=width, height=height) for eye in eyes]


def frontal_directions(count: int, shift: float = 0.0, *, up: str = "y") -> Float64:
    """Unit vectors ``(count, 3)`` on the part of a sphere where DTU's cameras stand: 49 are about 9° apart.

    A Fibonacci lattice from 45° left to 45° right of the front (+z for ``up="y"``, −y for ``up="z"``) and 5° to 50°
    above the horizon. ``shift`` in [0, 1] moves it sideways.
    """
    place = np.arange(count)
    azimuth = np.radians(45.0) * (2 * ((place * (5**0.5 - 1) / 2 + shift) % 1) - 1)
    low, high = np.sin(np.radians((5.0, 50.0)))
    rise = low + (high - low) * (place + 0.5) / count
    side, front = np.sqrt(1 - rise**2) * np.sin(azimuth), np.sqrt(1 - rise**2) * np.cos(azimuth)
    return np.stack((side, rise, front) if up == "y" else (side, -front, rise), axis=1)


def developed(light: NDArray[np.floating], mask: NDArray[np.bool_], samples: int) -> tuple[Float32, Float32]:
    """The mean light of the rays of each pixel that hit, as display RGB ``(H, W, 3)``, and their share ``(H, W)``.

    ``light`` ``(H · samples, W · samples, 3)`` is linear, and 0 where ``mask`` is false: the ray misses.
    """
    height, width = (side // samples for side in mask.shape)
    tiles = (height, samples, width, samples)
    hits = mask.reshape(tiles).sum(axis=(1, 3))
    mean = light.reshape(*tiles, 3).sum(axis=(1, 3)) / np.maximum(hits, 1)[..., None]
    color = np.asarray(linear_to_srgb(mean)).clip(0, 1).astype(np.float32)
    return color, (hits / samples**2).astype(np.float32)


def lit(light: NDArray[np.floating], normals: Float64, directions: Float64, *, shaded: bool, glossy: bool) -> Float64:
    """Shade a surface under a fixed lamp → linear light ``(N, 3)``.

    ``light`` ``(N, 3)`` is the linear colour of the surface; ``directions`` ``(N, 3)`` are those of the views, from the
    eye. ``shaded`` is Lambert's cosine with ambient light, ``glossy`` adds a highlight (Blinn 1977).
    """
    towards = np.array(LAMP) / np.linalg.norm(LAMP)
    cosine, sent = normals @ towards, np.asarray(light, np.float64)
    if shaded:
        sent = sent * (AMBIENT + (1 - AMBIENT) * np.maximum(cosine, 0))[:, None]
    if glossy:
        halfway = towards - directions
        halfway /= np.maximum(np.linalg.norm(halfway, axis=1, keepdims=True), 1e-12)
        aligned = np.maximum((normals * halfway).sum(axis=1), 0)
        sent = sent + (GLOSS * np.where(cosine > 0, aligned**SHARPNESS, 0.0))[:, None]
    return sent


SCENES: Mapping[str, Callable[[], Scene]] = MappingProxyType(
    {
        "painted-sphere": lambda: Scene("painted-sphere", Sphere(radius=0.6), _spots, radius=0.6),
        "striped-torus": lambda: Scene("striped-torus", Torus(major=0.45, minor=0.2), _stripes, radius=0.65, up="z"),
        "figure": _figure,
        "statue": _statue,
        "corner": lambda: Scene("corner", FunctionField(corner), corner_colors, radius=0.88, frontal=True),
    }
)
"""Makers of scenes by name."""
