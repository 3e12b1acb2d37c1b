"""A coarse mesh around level 0's band: where the rays of a page begin and end.

All of the surface, and all of the band around it, lies inside. Outside there is nothing to be found, so a pixel
whose ray misses the mesh costs no evaluation, and others begin a few steps from the surface.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...neural_fields import Field, extract_mesh
from ...neural_fields.meshing.mesh import Mesh
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS

__all__ = ["CELLS", "GRID", "shell_mesh", "surface_reach"]

# Between the corners of those meshes a coarser level may be this much further from zero.
MARGIN = 1.25
CELLS = 36  # along the box: a few thousand triangles
# Distance of the mesh from the band, in cells. No point of a cell is further than √3/2 of a cell from a corner, so
# that a part of the band within a cell shows at its corners, and chords of the mesh do not cut into the band.
ROOM = 0.9
# Steps into which the box of the mesh is divided for the page. A corner is moved by at most √3/2 of one, 0.002 in the
# largest box: a thirtieth of a cell, which `ROOM` leaves.
GRID = 1023


@torch.no_grad()
def shell_mesh(field: Field, *, cells: int = CELLS) -> Mesh:
    """The surface f_0 = δ_0 + `ROOM` cells, closed by a ball a little larger than that in which rays are traced.

    Args:
        field: with levels; where it has one only, δ_0 counts as 0.
        cells: along the box.

    Raises:
        NoSurfaceError: level 0 has no such surface.
        ValueError: see `extract_mesh`.
    """
    delta = float(field.deltas[0]) if field.num_levels > 1 else 0.0
    half = BOUNDING_RADIUS * (1 + 6 / cells)
    step = 2 * half / cells
    radius = half - 1.5 * step

    def outside(x: Tensor) -> Tensor:
        # The ball is flatter than a cell is wide, so its chords stay outside the smaller ball of the rays.
        return torch.maximum(field.value(x, level=0) - delta - ROOM * step, x.norm(dim=-1) - radius)

    assert radius * math.cos(step / radius) > BOUNDING_RADIUS
    corner = (half, half, half)
    mesh = extract_mesh(outside, resolution=cells, bounds=((-half, -half, -half), corner), normals=False)
    return Mesh(np.asarray(mesh.vertices), mesh.faces)


@torch.no_grad()
def surface_reach(field: Field) -> list[list[float]]:
    """How far from zero a coarser level is on the surface of a finer one; rays look there alone for finer levels.

    A band is as wide as training wanted it; the surface lies in its inner part,

        reach[l][j] = min(δ_j, `MARGIN` · max |f_j(x)| over the corners x of the meshes of levels j < k ≤ l).

    Returns:
        For each level l the reaches of levels 0 … l − 1.

    Raises:
        NoSurfaceError: a level has no surface.
    """
    found: list[list[float]] = [[]]
    for level in range(1, field.num_levels):
        mesh = extract_mesh(field, resolution=96, level=level, normals=False)
        corners = torch.from_numpy(np.asarray(mesh.vertices)).to(field.like)
        before = [*found[-1], 0.0]
        reaches = [MARGIN * float(field.value(corners, level=j).abs().max()) for j in range(level)]
        deltas = [float(delta) for delta in field.deltas[:level]]
        found.append([min(delta, max(pair)) for delta, *pair in zip(deltas, before, reaches, strict=True)])
    return found
