"""How many cells a mesh needs: thin parts fall between the corners of cells that are wider than they are.

Marching cubes sees signs at corners only. A plate thinner than a cell is met by few of them, and comes out with holes,
or not at all, however well the field knows it. So the field is asked at the points that the run rests on: is it
positive again a little below the surface, on the other side?
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...neural_fields import Field
from ...neural_fields.backend.devices import upload

__all__ = ["RESOLUTIONS", "THIN_SHARE", "Fineness", "fineness", "thin_depth", "thin_share"]

# Cells per side that are tried, coarse to fine. The work grows with the square: the last is 16 times the first.
RESOLUTIONS = (256, 512, 1024)
# Less of the points than this is an edge or a tip, not a part.
THIN_SHARE = 0.02


class Fineness(NamedTuple):
    """What thin parts ask of a mesh.

    Attributes:
        resolution: the fewest cells per side, of those tried, that show them.
        missed: the share of the points that lie on parts too thin for `RESOLUTIONS`[0].
    """

    resolution: int
    missed: float


def thin_depth(resolution: int) -> float:
    """The thickness √3 h up to which a part is thin for cells of side h, in unit-sphere lengths.

    On each line of corners along the axis nearest to its normal, a plate as thick as one cell has a corner inside; the
    diagonal leaves room for bars, and for a field's errors. The mesher's box has a side of 2.04.
    """
    return 3**0.5 * 2.04 / resolution


@torch.no_grad()
def thin_share(field: Field, points: NDArray[np.floating], resolution: int, *, level: int = -1) -> float:
    """The share of points on parts that are too thin for so many cells: thinner than √3 of them.

    Each point is first moved onto the surface by a Newton step, x = p - f n / |∇f| with n = ∇f / |∇f|. It lies on a
    part of thickness t if x - s n is inside for s < t, and outside beyond. Asked are s = d / 4 and s = d, for d of √3
    cells; what is outside at both was no point of the surface.

    Args:
        field: in unit-sphere coordinates, negative inside.
        points: ``(N, 3)`` near its surface.
        resolution: cells along each side of the mesher's box.
        level: whose surface.
    """
    depth = thin_depth(resolution)
    asked = torch.from_numpy(np.asarray(points[:: 1 + len(points) // 20_000], np.float32))
    places = upload(asked, field.like.device)
    jet = field.jet(places, level=level)
    slope = jet.gradient.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    normal = jet.gradient / slope
    x = places - (jet.value[..., None] / slope).clamp(-depth, depth) * normal
    inside, beyond = (field.value(x - s * normal, level=level) for s in (depth / 4, depth))
    return float(((inside < 0) & (beyond >= 0)).float().mean())


def fineness(field: Field, points: NDArray[np.floating], *, level: int = -1) -> Fineness:
    """The resolution at which hardly any points lie on parts too thin for it; the last of `RESOLUTIONS` if none does.

    Args:
        field: in unit-sphere coordinates, negative inside.
        points: ``(N, 3)`` near its surface.
        level: whose surface.
    """
    missed = thin_share(field, points, RESOLUTIONS[0], level=level)
    if missed <= THIN_SHARE:
        return Fineness(RESOLUTIONS[0], missed)
    for resolution in RESOLUTIONS[1:-1]:
        if thin_share(field, points, resolution, level=level) <= THIN_SHARE:
            return Fineness(resolution, missed)
    return Fineness(RESOLUTIONS[-1], missed)
