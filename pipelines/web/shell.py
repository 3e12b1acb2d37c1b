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
from ...neural_fields.mesh import Mesh
from ...neural_fields.tracing import BOUNDING_RADIUS

__all__ = ["CELLS", "shell_mesh"]

CELLS = 36  # along the box: a few thousand triangles
# Distance of the mesh from the band, in cells. No point of a cell is further than √3/2 of a cell from a corner, so
# that a part of the band within a cell shows at its corners, and chords of the mesh do not cut into the band.
ROOM = 0.9


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
