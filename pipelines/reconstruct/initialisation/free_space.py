"""What measured rays pass through is empty: a start of the geometry where there are no masks, and beside them."""

from __future__ import annotations

import torch
from torch import Tensor

from ....neural_fields.volume.weights import sphere_span
from ..data.measured import MeasuredDepths


def seen_through(measured: MeasuredDepths, resolution: int, *, rays: int = 1 << 18, least: int = 2) -> Tensor:
    """Which vertices of a grid over [−1, 1]³ measured rays pass ``(resolution + 1,) * 3``, on the CPU.

    A vertex is passed where two rays at least go through the cell around it before they end in another one beyond it,
    and no fewer than end there: a measurement that is wrong carves no hole into a surface that many see. Vertices that
    lie deeper inside than half the diagonal of a cell are never passed, if measurements are right.

    Args:
        measured: the rays; those whose depth is not known yet are left out.
        resolution: cells along an edge.
        rays: that carve, at most.
        least: rays that must pass through a place.
    """
    count, edge = resolution + 1, 2 / resolution
    passed, ended = (torch.zeros(count**3, dtype=torch.int64, device=measured.device) for _ in range(2))
    rows = torch.arange(len(measured), device=measured.device)[:: max(1, len(measured) // rays)]
    steps = torch.arange(round(2 / edge) * 2, device=measured.device) * (edge / 2)
    for part in rows.split(1 << 14):
        origins, directions, reach = measured.at(part)[:3]
        near, far = sphere_span(origins, directions)
        depths = near[:, None] + steps
        # Not the last cell and a half: that is where the surface is, as well as it was measured.
        kept = depths < torch.minimum(reach - 1.5 * edge, far)[:, None]
        places = origins[:, None] + depths[..., None] * directions[:, None]
        cells = _cell(places, resolution)
        # Half-cell steps meet a cell more than once; a ray counts once.
        first = torch.ones_like(kept)
        first[:, 1:] = cells[:, 1:] != cells[:, :-1]
        passed += torch.bincount(cells[kept & first], minlength=count**3)
        inside = (reach > near) & (reach < far)
        ends = _cell(origins + reach[:, None] * directions, resolution)
        ended += torch.bincount(ends[inside], minlength=count**3)
    return ((passed >= least) & (passed >= ended)).reshape(count, count, count).cpu()


def _cell(points: Tensor, resolution: int) -> Tensor:
    """Number of the vertex that is next to each point ``(...,)``."""
    x, y, z = ((points.clamp(-1, 1) + 1) * (0.5 * resolution)).round().long().unbind(dim=-1)
    return (x * (resolution + 1) + y) * (resolution + 1) + z
