"""Closest points on the zero set of any smooth field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import Field
from .synthetic import project_to_surface

__all__ = ["distinct_starts", "refine_closest"]

Float64 = NDArray[np.float64]


def refine_closest(
    field: Field, targets: Float64, starts: Float64, *, steps: int = 60, tolerance: float = 1e-10
) -> Float64:
    """Distance ``(M,)`` from each target to the surface point closest to it near its start.

    Minimises |x - q|²/2 over the surface by projected gradient descent: q moves by ``rate`` times the tangential
    part of x - q and back onto the surface. The rate is that of Barzilai and Borwein (IMA J. Numer. Anal., 1988),
    ⟨s, s⟩/⟨s, y⟩ with s the last move and y the change of the gradient over it, so that no curvature need be
    known. A move that does not shorten |x - q| is undone, and its rate cut to a quarter.

    Args:
        field: the surface is its zero set.
        targets: ``(M, 3)`` points x.
        starts: ``(M, 3)`` points near the surface, closer to the foot sought than to any other.
        steps: at most.
        tolerance: stop where a move gains less than about this, in the field's units.
    """
    foot, normal, _ = project_to_surface(field, starts)
    best = np.linalg.norm(targets - foot, axis=1)
    tangential = _tangential(targets - foot, normal)
    rate = np.ones(len(targets))
    active = np.arange(len(targets))
    for _ in range(steps):
        gain = rate[active] * (tangential[active] ** 2).sum(axis=1) / np.maximum(best[active], 1e-9)
        active = active[gain > tolerance]
        if len(active) == 0:
            break
        moved, turned, landed = project_to_surface(field, foot[active] + rate[active, None] * tangential[active])
        length = np.linalg.norm(targets[active] - moved, axis=1)
        better = landed & (length < best[active])
        rate[active[~better]] *= 0.25
        chosen, moved, turned = active[better], moved[better], turned[better]
        along = _tangential(targets[chosen] - moved, turned)
        move = moved - foot[chosen]
        change = (move * (tangential[chosen] - along)).sum(axis=1)
        curved = change > 0
        rate[chosen] = np.where(curved, (move**2).sum(axis=1) / np.where(curved, change, 1.0), 1.0).clip(1e-3, 100.0)
        foot[chosen], tangential[chosen], best[chosen] = moved, along, length[better]
    return best


def distinct_starts(
    points: Float64, normals: NDArray[np.floating], *, radius: float, cosine: float = 0.9
) -> NDArray[np.bool_]:
    """Which of each target's candidate starts ``(M, c, 3)`` are worth a descent of their own ``(M, c)``.

    One within ``radius`` of an earlier one that is kept, with its normal to within ``cosine``, leads to the same foot.
    """
    kept = np.ones(points.shape[:2], bool)
    for later in range(1, points.shape[1]):
        near = ((points[:, :later] - points[:, later, None]) ** 2).sum(axis=2) < radius**2
        alike = (normals[:, :later] * normals[:, later, None]).sum(axis=2) > cosine
        kept[:, later] = ~(near & alike & kept[:, :later]).any(axis=1)
    return kept


def _tangential(offset: Float64, normal: Float64) -> Float64:
    return offset - (offset * normal).sum(axis=1, keepdims=True) * normal
