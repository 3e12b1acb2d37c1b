"""Colours for numbers."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["COLOR_MAPS", "map_colors"]

Float32 = NDArray[np.float32]

# Blue – pale – red, in display RGB: the ends equally dark, the middle almost the white of the page.
_DIVERGING = ((0.09, 0.25, 0.55), (0.36, 0.60, 0.83), (0.94, 0.94, 0.92), (0.90, 0.52, 0.34), (0.60, 0.10, 0.14))


def _from_opencv(name: int) -> Float32:
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(ramp, name)[:, 0, ::-1]) / np.float32(255)


def _between(anchors: tuple[tuple[float, float, float], ...]) -> Float32:
    at = np.linspace(0, 1, len(anchors))
    ramp = np.linspace(0, 1, 257)
    return np.stack([np.interp(ramp, at, channel) for channel in zip(*anchors, strict=True)], 1).astype(np.float32)


# (K, 3) tables in display RGB, from the low end to the high one.
COLOR_MAPS: dict[str, Float32] = {
    "viridis": _from_opencv(cv2.COLORMAP_VIRIDIS),
    "magma": _from_opencv(cv2.COLORMAP_MAGMA),
    "diverging": _between(_DIVERGING),
}


def map_colors(values: Tensor, limits: tuple[float, float], table: Float32) -> Tensor:
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
