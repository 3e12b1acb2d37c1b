"""Points of two shapes that are known to be the same, and what they say to a motion that is learnt.

A few landmarks settle what geometry leaves open, as which leg is which or how far a round thing has turned. All
vertices of two meshes with the same faces are landmarks too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.landmarks import read_landmarks
from ...neural_fields import InputError
from .shapes import StaticShape

Float64 = NDArray[np.float64]
FAR_OUT = 0.1  # how far from its surface a landmark may lie, in units of the field: fits and picks are not exact


class Landmarks(NamedTuple):
    """Pairs of points.

    Attributes:
        before: ``(P, 3)`` of a shape.
        after: ``(P, 3)``, the same points of the next shape.
    """

    before: Tensor
    after: Tensor


def placed_landmarks(paths: Sequence[str], shapes: Sequence[StaticShape]) -> list[Landmarks]:
    """The landmarks of each two shapes, in the frame that the shapes were put in; none where there are no files.

    Raises:
        InputError: a file cannot be read, or a landmark is not on its shape.
    """
    if not paths:
        none = torch.empty(0, 3)
        return [Landmarks(none, none)] * (len(shapes) - 1)
    found = []
    for index, path in enumerate(paths):
        both = zip(read_landmarks(path), shapes[index : index + 2], strict=True)
        found.append(Landmarks(*(_placed(path, points, shape) for points, shape in both)))
    return found


def nearness(points: Tensor, landmarks: Tensor) -> Tensor:
    """exp(−|x − a|² / 2σ²) of points ``(N, 3)`` and landmarks ``(P, 3)``, ``(N, P)``: alike for points that match."""
    # 0.3: the distance within which a landmark says something about its neighbours.
    return torch.exp(-torch.cdist(points, landmarks).square() / (2 * 0.3**2))


@torch.no_grad()
def _placed(path: str, points: Float64, shape: StaticShape) -> Tensor:
    placed = torch.from_numpy(shape.placement.apply(shape.similarity.to_unit(points))).float()
    value = shape.field.value(placed).abs()
    worst = int(value.argmax())
    if not float(value[worst]) <= FAR_OUT:
        where = " ".join(f"{number:g}" for number in points[worst])
        raise InputError(f"{path}: landmark {where} is not on {shape.name}; give coordinates of that shape's own input")
    return placed
