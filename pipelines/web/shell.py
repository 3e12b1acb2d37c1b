"""The mesh between which a page's rays begin and end: it holds the surface and the band of level 0 around it.

A pixel whose ray misses the mesh costs no evaluation. For a surface that moves, it holds the bands of every moment.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...neural_fields import Field, Union, extract_mesh
from ...neural_fields.meshing.mesh import Mesh
from ...neural_fields.spacetime.field import SpaceTimeSDF, at_time
from ...neural_fields.tracing.sphere import BOUNDING_RADIUS

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
def shell_mesh(field: Field, *, slack: float = 0.0) -> Mesh:
    """The surface f_0 = δ_0 + ``slack`` + `ROOM` cells, closed by a ball a little larger than that of the rays.

    δ_0 is 0 for a field of one level. Raises a NoSurfaceError if level 0 has no such surface.
    """
    delta = float(field.deltas[0]) if field.num_levels > 1 else 0.0
    half = BOUNDING_RADIUS * (1 + 6 / CELLS)
    step = 2 * half / CELLS
    radius = half - 1.5 * step

    def outside(x: Tensor) -> Tensor:
        # The ball is flatter than a cell is wide, so its chords stay outside the smaller ball of the rays.
        return torch.maximum(field.value(x, level=0) - delta - slack - ROOM * step, x.norm(dim=-1) - radius)

    assert radius * math.cos(step / radius) > BOUNDING_RADIUS
    corner = (half, half, half)
    mesh = extract_mesh(outside, resolution=CELLS, bounds=((-half, -half, -half), corner), normals=False)
    return Mesh(np.asarray(mesh.vertices), mesh.faces)


@torch.no_grad()
def surface_reach(field: Field) -> list[list[float]]:
    """How far from zero coarser levels are on the surface of a finer one; rays look for finer levels only there.

        reach[l][j] = min(δ_j, `MARGIN` · max |f_j(x)| over the corners x of the meshes of levels j < k ≤ l)

    for each level l and each j < l. Raises a NoSurfaceError if a level has no surface.
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


MOMENTS = np.linspace(0.0, 1.0, 5)  # at which surfaces are looked at: the first view, what rounding changes
LATTICE, TIMES = 24, 9  # along the box and in time: where changes are measured
CELL = 2 * BOUNDING_RADIUS / CELLS


@torch.no_grad()
def fastest_change(field: SpaceTimeSDF) -> float:
    """The greatest |∂f_0/∂t| near level 0's band, at `LATTICE`³ places and `TIMES` times: measured, not a bound."""
    line = torch.linspace(-BOUNDING_RADIUS, BOUNDING_RADIUS, LATTICE, dtype=field.like.dtype, device=field.like.device)
    places = torch.cartesian_prod(line, line, line)
    places = places[places.norm(dim=-1) <= BOUNDING_RADIUS]
    # Changes are of interest up to 0.2 from the band.
    near = 0.2 + (float(field.deltas[0]) if field.num_levels > 1 else 0.0)
    fastest = 0.0
    for t in np.linspace(0, 1, TIMES):
        jet = field.jet(at_time(places, float(t)), level=0)
        rates = jet.gradient[:, 3][jet.value.abs() <= near].abs()
        if len(rates):
            fastest = max(fastest, float(rates.max()))
    return fastest


def swept_shell(field: SpaceTimeSDF) -> Mesh:
    """A mesh around the bands of all moments: `shell_mesh` of the union of some; raises NoSurfaceError.

    With moments t_k, min_k f(x, t_k) − ½ Δt s ≤ f(x, t) at any t, if no value changes faster than s (`fastest_change`).
    There are as many moments as make ½ Δt s at most half a cell of the mesh, and at most 65.
    """
    speed = fastest_change(field)
    count = min(65, 2 + math.floor(speed / CELL))
    stills = [field.at(float(t)) for t in np.linspace(0, 1, count)]
    return shell_mesh(Union(*stills), slack=0.5 * speed / (count - 1))
