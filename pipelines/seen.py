"""What the pixels of an image see of a surface, whether it was traced in a field or rasterised from a mesh."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

__all__ = ["Seen"]


@dataclass(frozen=True)
class Seen:
    """One row for each pixel that sees the surface; nothing is kept, or shaded, for the others.

    Attributes:
        size: width and height of the image.
        pixel: ``(P,)`` int64, row-major: ``y * width + x``.
        depth: ``(P,)`` distance from the eye along the pixel's ray.
        position: ``(P, 3)`` the point seen.
        normal: ``(P, 3)`` unit outward normal there.
        direction: ``(P, 3)`` unit direction of the ray, away from the eye.
        color: ``(P, 3)`` the surface's own colour in [0, 1], where it has one.
    """

    size: tuple[int, int]
    pixel: Tensor
    depth: Tensor
    position: Tensor
    normal: Tensor
    direction: Tensor
    color: Tensor | None = None
