"""A studio: cameras all around something, a lamp that stands still, and pictures of the light that comes back.

Exact scenes and meshes are photographed in it, so that a picture of one can be held against a picture of the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from ..cameras import UP_AXES, Camera, look_at
from ..clouds.cleaning.orientation import fibonacci_directions
from ..color_space import linear_to_srgb

__all__ = ["cameras_around", "developed", "lit"]

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

LAMP = (0.4, 0.7, 0.6)  # towards the lamp, for shaded scenes
AMBIENT = 0.35  # share of the light that comes from everywhere
GLOSS, SHARPNESS = 0.6, 40  # light in the middle of a lamp's reflection, and how narrow it is (Blinn 1977)


def cameras_around(
    radius: float, *, up: str = "y", views: int = 24, size: int = 64, seed: int = 0, middle: Sequence[float] = (0, 0, 0)
) -> list[Camera]:
    """Cameras spread evenly over a sphere around a ball, upright, with all of the ball in view.

    They stand on a Fibonacci lattice that is turned at random, so that another seed gives views to hold out.

    Args:
        radius: of the ball.
        up: "y" or "z", the axis that points up.
        views: how many.
        size: width and height of the images, in pixels.
        seed: of the turn.
        middle: of the ball.

    Raises:
        ValueError: ``views`` or ``size`` is not positive.
    """
    for name, number in (("views", views), ("size", size)):
        if number < 1:
            raise ValueError(f"{name}={number}: expected at least one")
    # The orthogonal factor of a Gaussian matrix is an evenly distributed rotation (or reflection, which is as good).
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    distance = 4.0  # of the eyes from the middle, in radii
    eyes = np.array(middle) + distance * radius * fibonacci_directions(views) @ turn.T
    # A ball of radius r at distance d is seen within asin(r / d) of its middle; one of 1.1 radii fills the images.
    fov = 2 * float(np.degrees(np.arcsin(1.1 / distance)))
    return [look_at(torch.from_numpy(eye), middle, up=UP_AXES[up], fov=fov, width=size, height=size) for eye in eyes]


def developed(light: NDArray[np.floating], mask: NDArray[np.bool_], samples: int) -> tuple[Float32, Float32]:
    """What pixels show of rays: the mean light of those that hit as display RGB ``(H, W, 3)``, and their share.

    Args:
        light: ``(H · samples, W · samples, 3)`` linear light along each ray; 0 where it misses.
        mask: ``(H · samples, W · samples)`` whether it hits.
        samples: rays per pixel and direction.
    """
    height, width = (side // samples for side in mask.shape)
    tiles = (height, samples, width, samples)
    hits = mask.reshape(tiles).sum(axis=(1, 3))
    mean = light.reshape(*tiles, 3).sum(axis=(1, 3)) / np.maximum(hits, 1)[..., None]
    color = np.asarray(linear_to_srgb(mean)).clip(0, 1).astype(np.float32)
    return color, (hits / samples**2).astype(np.float32)


def lit(light: NDArray[np.floating], normals: Float64, directions: Float64, *, shaded: bool, glossy: bool) -> Float64:
    """What eyes see of a surface under a fixed lamp: linear light ``(N, 3)``.

    Args:
        light: ``(N, 3)`` the surface's own colour, as linear light.
        normals: ``(N, 3)`` unit outward normals.
        directions: ``(N, 3)`` unit directions of the views, away from the eyes.
        shaded: whether the lamp lights the paint (Lambert's cosine, and light from everywhere); else it is as it is.
        glossy: whether the lamp is reflected (Blinn 1977).
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
