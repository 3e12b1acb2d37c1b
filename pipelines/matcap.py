"""Material captures: the picture of a lit sphere, from which every normal takes its colour."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..neural_fields import InputError

__all__ = ["MATCAPS", "load_matcap", "sample_matcap"]

Float32 = NDArray[np.float32]

MATCAPS = ("clay", "chrome")
SIZE = 256


def load_matcap(name: str | Path) -> Tensor:
    """One of `MATCAPS`, or a PNG or JPEG of a sphere that fills it → ``(H, W, 3)`` display RGB in [0, 1].

    Raises:
        InputError: no such file, or it is not an image.
    """
    if str(name) in MATCAPS:
        normals = _sphere(SIZE)
        return torch.from_numpy(_clay(normals) if str(name) == "clay" else _chrome(normals))
    path = Path(name)
    if not path.is_file():
        raise InputError(f"matcap {path}: no such file; name a PNG or JPEG of a sphere, or one of {', '.join(MATCAPS)}")
    data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if len(data) else None
    if image is None:
        raise InputError(f"matcap {path}: cannot be read as an image; expected a PNG or JPEG of a sphere")
    return torch.from_numpy(image.astype(np.float32) / 255)


def sample_matcap(matcap: Tensor, normals: Tensor) -> Tensor:
    """Colours of camera-space normals ``(P, 3)`` (x right, y up, z towards the eye) → ``(P, 3)``, bilinear.

    The sphere touches the four edges of the image. Normals that face away take the colour of its rim.
    """
    across = normals[:, :2]
    length = across.norm(dim=1, keepdim=True)
    # So far inside the rim that no texel of the background is mixed in: √2 texels, and a little.
    rim = 1 - 3 / min(matcap.shape[:2])
    kept = torch.where(normals[:, 2:] > 0, length.clamp(max=rim), rim)
    across = across * (kept / length.clamp(min=1e-6))
    grid = torch.stack((across[:, 0], -across[:, 1]), -1)[None, :, None]  # (1, P, 1, 2)
    texture = matcap.to(normals).movedim(-1, 0)[None]  # (1, 3, H, W)
    found = torch.nn.functional.grid_sample(texture, grid, padding_mode="border", align_corners=False)
    return found[0, :, :, 0].T


def _sphere(size: int) -> Float32:
    """Normals ``(size, size, 3)`` of a sphere that fills an image; outside it, those of the rim."""
    at = (np.arange(size, dtype=np.float32) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(at, -at)
    radius = np.hypot(x, y)
    shrink = np.minimum(1, 1 / np.maximum(radius, 1e-6))
    x, y = x * shrink, y * shrink
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return np.stack((x, y, z), -1).astype(np.float32)


def _toward(normals: Float32, direction: tuple[float, float, float]) -> Float32:
    """Cosine with a direction, not below 0."""
    unit = np.asarray(direction, np.float32) / np.linalg.norm(direction).astype(np.float32)
    return np.maximum(normals @ unit, 0)[..., None]


def _clay(normals: Float32) -> Float32:
    """Terracotta: a broad warm lamp from the upper left, a cool one from the right, and a dull shine."""
    base = np.array([0.50, 0.21, 0.13], np.float32)  # linear light
    key = _toward(normals, (-0.5, 0.7, 0.6))
    light = (
        np.array([0.16, 0.15, 0.16]) * (0.7 + 0.3 * normals[..., 1:2])
        + np.array([1.05, 1.0, 0.92]) * key
        + np.array([0.16, 0.20, 0.26]) * _toward(normals, (0.9, 0.0, 0.35))
    )
    shine = 0.07 * _toward(normals, (-0.28, 0.40, 0.9)) ** 24  # half-way between the lamp and the eye
    edge = 0.06 * (1 - normals[..., 2:]) ** 3
    return _display(base * light + shine + edge)


def _chrome(normals: Float32) -> Float32:
    """A mirror in a studio: a sky that pales towards the horizon, a dark floor and one soft window."""
    mirrored = 2 * normals[..., 2:] * normals - np.array([0, 0, 1], np.float32)
    height = mirrored[..., 1:2]
    sky = 0.22 + 0.60 * (1 - np.clip(height, 0, 1)) ** 1.5
    floor = 0.04 + 0.40 * np.clip(-height, 0, 1) ** 1.2
    above = 1 / (1 + np.exp(-height * 14))
    window = 1 / (1 + np.exp((0.90 - _toward(mirrored, (-0.5, 0.6, 0.62))) * 60))
    tint = np.array([0.95, 0.98, 1.04]) * above + np.array([1.02, 1.0, 0.96]) * (1 - above)
    return _display((sky * above + floor * (1 - above)) * tint + 0.7 * window)


def _display(linear: NDArray[np.floating]) -> Float32:
    return (linear.clip(0, 1) ** (1 / 2.2)).astype(np.float32)
