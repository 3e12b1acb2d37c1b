"""Posed photographs: pictures, the pinhole cameras that took them, and where the object is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import Similarity
from .cameras import Camera

__all__ = ["PosedImage", "PosedImages", "read_posed_images"]


@dataclass(frozen=True, eq=False)
class PosedImage:
    """A picture without lens distortion, and its camera.

    Attributes:
        name: of its file, as the data set has it.
        camera: a pinhole of the picture's size.
        color: ``(H, W, 3)`` display RGB in [0, 1]; not multiplied by the mask.
        mask: ``(H, W)`` how much of the pixel is object, in [0, 1]; None where nobody said.
    """

    name: str
    camera: Camera
    color: NDArray[np.float32]
    mask: NDArray[np.float32] | None


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Views of one object, and where it is.

    Attributes:
        views: at least one.
        similarity: from world coordinates to the unit sphere around the region of interest.
        region: where that came from, in words.
        points: ``(P, 3)`` sparse points of the surface in world coordinates, or None.
        source: the file that the cameras were read from.
    """

    views: tuple[PosedImage, ...]
    similarity: Similarity
    region: str
    points: NDArray[np.float64] | None
    source: Path


def read_posed_images(path: str | Path, *, width: int | None = None, region: Similarity | None = None) -> PosedImages:
    """Read photographs with their cameras."""
    raise NotImplementedError
