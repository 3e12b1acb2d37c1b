"""The unit sphere in which fields live: the similarity from the user's coordinates, and chords of balls around 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """``x_unit = (x_input - center) / scale``, kept in float64.

    Map coordinates (UTM metres, say) have seven digits before the point, float32 seven in all: the shift is made in
    float64.

    Attributes:
        center: three numbers, in input units.
        scale: input units per unit of the field.
    """

    center: tuple[float, float, float]
    scale: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.center).all() and np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"center={self.center}, scale={self.scale}: expected finite numbers and scale > 0")

    @classmethod
    def identity(cls) -> Similarity:
        """The similarity that changes nothing."""
        return cls((0.0, 0.0, 0.0), 1.0)

    @classmethod
    def to_unit_sphere(cls, points: Float64) -> Similarity:
        """Centre ``points`` ``(N, 3)`` on their bounding box and scale them into the unit sphere.

        Raises:
            ValueError: all points coincide.
        """
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = float(np.sqrt(((points - center) ** 2).sum(axis=1).max()))
        if radius == 0:
            raise ValueError("points: all of them coincide, so there is no scale")
        return cls((float(center[0]), float(center[1]), float(center[2])), radius)

    def to_unit(self, points: ArrayLike) -> Float64:
        """Map ``(..., 3)`` input coordinates into the unit sphere, in float64."""
        return (np.asarray(points, np.float64) - np.asarray(self.center)) / self.scale

    def to_input(self, points: NDArray[np.floating]) -> Float64:
        """Map ``(..., 3)`` unit-sphere coordinates back to input coordinates, in float64."""
        return np.asarray(points, np.float64) * self.scale + np.asarray(self.center)


def ball_chord(origins: Tensor, directions: Tensor, radius: Tensor | float) -> tuple[Tensor, Tensor]:
    """Depth at which lines ``(R, 3)`` are nearest to 0, and half the length of their chord of a ball, 0 if they miss.

    Directions are of unit length; ``radius`` of the ball around 0 is a number or ``(R,)``.
    """
    middle = -(origins * directions).sum(dim=-1)
    # From the nearest point, and not from |o|² − middle², which cancels for far cameras.
    squared = radius**2 - (origins + middle[:, None] * directions).square().sum(dim=-1)
    return middle, squared.clamp(min=0).sqrt()
