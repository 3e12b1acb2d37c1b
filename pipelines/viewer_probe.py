"""What is under the pointer: where it is, and what the field says there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..neural_fields import Field, Similarity
from ..neural_fields.tracing import sphere_trace

__all__ = ["Reading", "describe_reading", "probe"]


@dataclass(frozen=True, eq=False)
class Reading:
    """The field at a point.

    Attributes:
        point: ``(3,)`` in unit-sphere coordinates.
        position: ``(3,)`` in input coordinates.
        normal: ``(3,)`` unit direction of the gradient of the level that is shown.
        level: the level that is shown.
        distances: signed distance of every level, in input units.
        on_plane: whether the point lies on the slice plane rather than on the surface.
    """

    point: NDArray[np.float64]
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    level: int
    distances: tuple[float, ...]
    on_plane: bool


def probe(
    field: Field,
    similarity: Similarity,
    origin: Sequence[float],
    direction: Sequence[float],
    *,
    level: int,
    surface: bool = True,
    plane: tuple[int, float] | None = None,
) -> Reading | None:
    """The first point of the surface or of a slice plane on a ray; None where there is neither.

    Args:
        field: what is shown.
        similarity: from input to unit-sphere coordinates.
        origin: ``(3,)`` where the ray begins.
        direction: ``(3,)`` where it goes, of any length but 0.
        level: the level that is shown.
        surface: whether the surface is there to be hit.
        plane: axis and position of a slice plane; it ends where the cube around the unit sphere does.
    """
    start = torch.tensor(origin, dtype=torch.float64)
    ray = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    start, ray = start.to(field.like), ray.to(field.like)
    depth, on_plane = torch.inf, False
    if surface:
        hits = sphere_trace(field, start, ray, level=level)
        depth = float(hits.depth) if bool(hits.mask) else torch.inf
    if plane is not None:
        crossed = _plane_depth(start, ray, *plane)
        depth, on_plane = min(depth, crossed), crossed < depth
    if depth == torch.inf:
        return None
    point = start + depth * ray
    with torch.no_grad():
        gradient = field.jet(point[None], level=level).gradient[0].cpu().double()
        values = [float(field.value(point[None], level=each)) * similarity.scale for each in range(field.num_levels)]
    normal = torch.nn.functional.normalize(gradient, dim=0).numpy()
    unit = point.cpu().double().numpy()
    return Reading(unit, similarity.to_input(unit), normal, field.resolve_level(level), tuple(values), on_plane)


def _plane_depth(start: torch.Tensor, ray: torch.Tensor, axis: int, position: float) -> float:
    """Where the ray meets the plane inside the cube [−1, 1]³; ∞ where it does not."""
    slope = float(ray[axis])
    depth = (position - float(start[axis])) / slope if slope else -1.0
    inside = bool(((start + depth * ray).abs() <= 1 + 1e-6).all())
    return depth if depth > 0 and inside else torch.inf


def describe_reading(reading: Reading | None, scale: float) -> str:
    """A reading in Markdown, with as many digits as lengths of the input's ``scale`` deserve."""
    if reading is None:
        return "Nothing is under the pointer."
    digits = max(0, 5 - int(np.floor(np.log10(scale))))
    position = ", ".join(f"{number:.{digits}f}" for number in reading.position)
    normal = ", ".join(f"{number:+.3f}" for number in reading.normal)
    distances = [
        f"{'**' * (level == reading.level)}f{level} = {distance:+.3g}{'**' * (level == reading.level)}"
        for level, distance in enumerate(reading.distances)
    ]
    return "  \n".join(
        [
            f"On the {'slice plane' if reading.on_plane else 'surface'}, level {reading.level}",
            f"position {position}",
            f"normal {normal}",
            f"distance {', '.join(distances)}",
        ]
    )
