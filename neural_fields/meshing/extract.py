"""Adaptive marching cubes: a triangle mesh of the zero set, from about as many evaluations as it has vertices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import normalize

from ..backend.errors import InputError, positive
from ..fields.field import FieldLike, as_field, solid
from ._cells import (
    EDGE_AXIS,
    EDGE_ENDS,
    ActiveCells,
    Bounds,
    Given,
    Ints,
    Lattice,
    Progress,
    Sampler,
    active_cells,
    cube_tables,
    cull_blocks,
)
from ._cells import NoSurfaceError as NoSurfaceError
from .mesh import Mesh, MeshStats

# The unit sphere with a little room, so that a surface that touches it is still closed.
DEFAULT_BOUNDS: Bounds = ((-1.02, -1.02, -1.02), (1.02, 1.02, 1.02))

# Cells a vertex may move before its normal is evaluated again: 0.3 degrees at a radius of curvature of ten cells.
RENEWED_NORMAL = 0.05


def extract_mesh(
    field: FieldLike,
    *,
    resolution: int = 256,
    level: int = -1,
    bounds: Bounds = DEFAULT_BOUNDS,
    lipschitz: float = 1.25,
    normals: bool = True,
    clearance: float = 1e-3,
    batch: int = 1 << 18,
    progress: Progress | None = None,
) -> Mesh:
    """Extract the zero set of ``field`` inside a box, outward oriented, with analytic normals.

    Blocks are culled by the bound |f_j(centre)| ≤ L · half diagonal + δ_j, with coarse levels for large blocks. Corner
    signs that the bound decides are inferred; both ends of every crossed edge are evaluated. So the work grows with the
    number of surface cells (×4 when the resolution doubles) and no array of resolution³ exists. With |∇f| ≤ L the mesh
    equals that of evaluating every lattice point. Where f is steeper, the surface is still followed across every face
    of the lattice; only a whole component that no centre noticed could be missed.

    The mesh is watertight and manifold inside the box, and open where the surface leaves it. Vertices lie on lattice
    edges, by linear interpolation and, with normals, one more Newton step along the edge.

    Args:
        field: three-dimensional, negative inside, evaluated on the device of its parameters; or any function of points
            ``(..., 3)`` → ``(...,)``, in torch operations.
        resolution: cells along the longest axis of the box.
        level: the level whose zero set is wanted.
        bounds: lowest and highest corner of the box.
        lipschitz: L, an upper bound on |∇f| near the surface and within a block of it, 1 for an exact distance; of a
            tiled field, that of its tiles.
        normals: whether normals are computed; their jets cost about twice the value at every vertex.
        clearance: least distance of a vertex from the ends of its edge, in cells, so that no two vertices coincide
            where f is exactly zero at a lattice point (which counts as outside).
        batch: points per call of the field.
        progress: called with ``(stage, done, total)`` after every batch.

    Raises:
        NoSurfaceError: no two lattice points differ in sign; the message says what the signs are.
        ValueError: the field returned NaN or an infinity, or an argument is out of range.

    Example:
        >>> from mplicits.neural_fields import Sphere
        >>> mesh = extract_mesh(Sphere(radius=0.5), resolution=32)
        >>> bool(abs((mesh.vertices**2).sum(axis=1) ** 0.5 - 0.5).max() < 1e-5)
        True
    """
    field = solid(field)
    positive(lipschitz=lipschitz, batch=batch)
    level = field.resolve_level(level)
    lipschitz = field.slope_bound(lipschitz)
    sampler = Sampler(field, Lattice.over(bounds, resolution), batch, progress)
    return extract_surface(sampler, level, lipschitz, normals=normals, clearance=clearance)[0]


def extract_surface(
    sampler: Sampler,
    level: int,
    lipschitz: float,
    *,
    normals: bool,
    clearance: float,
    given: Given | None = None,
) -> tuple[Mesh, ActiveCells, Ints]:
    """The mesh in the box of a sampler, its cells, and for each vertex the rows ``(V, 2)`` of the ends of its edge."""
    if not 0 < clearance < 0.5:
        raise ValueError(f"clearance={clearance}: expected a fraction of a cell in (0, 0.5)")
    try:
        along = 32 if given is None else 8
        blocks, centres, kept = cull_blocks(sampler, level=level, lipschitz=lipschitz, along=along)
    except NoSurfaceError:
        if given is None or not len(given.crossed):
            raise
        blocks, centres, kept = given.crossed[:0], given.values[:0], np.empty(0, bool)
    cells = active_cells(sampler, blocks, centres, kept, level=level, lipschitz=lipschitz, given=given)
    faces, ends = _triangles(cells)
    below = cells.values[ends[:, 0]].astype(np.float64)
    # Where the line through the values at both ends, of different signs, is zero.
    fractions = (below / (below - cells.values[ends[:, 1]])).clip(clearance, 1 - clearance)
    start, step = cells.points[ends[:, 0]], cells.points[ends[:, 1]] - cells.points[ends[:, 0]]
    vertices = sampler.lattice.positions(start + fractions[:, None] * step)
    unit = None
    if normals:
        rising = cells.values[ends[:, 1]] > cells.values[ends[:, 0]]
        unit = np.empty((len(vertices), 3), np.float32)
        moved = np.arange(len(vertices))
        for _ in range(2):  # once everywhere, once more where the step has left the point whose normal is known
            values, gradients = sampler.jets(vertices[moved], level=level, stage="normals")
            unit[moved] = gradients / np.maximum(np.linalg.norm(gradients, axis=1, keepdims=True), 1e-30)
            slopes = (gradients * step[moved]).sum(axis=1) * sampler.lattice.step
            stepped = _newton(fractions[moved], values, slopes, rising[moved]).clip(clearance, 1 - clearance)
            far = np.abs(stepped - fractions[moved]) > RENEWED_NORMAL
            fractions[moved] = stepped
            moved = moved[far]
            vertices = sampler.lattice.positions(start + fractions[:, None] * step)
    stats = MeshStats(tuple(sampler.counts), int(kept.sum()), len(cells.cases))
    return Mesh(vertices, faces, unit, stats=stats), cells, ends


def surface_of(field: FieldLike, *, resolution: int, level: int = -1) -> Mesh | None:
    """`extract_mesh` without normals; None without a surface."""
    try:
        return extract_mesh(field, resolution=resolution, level=level, normals=False)
    except NoSurfaceError:
        return None


@contextmanager
def surface_needed(complaint: str) -> Iterator[None]:
    """Inside, a missing surface is an InputError that begins with the ``complaint``."""
    try:
        yield
    except NoSurfaceError as error:
        raise InputError(f"{complaint} ({error})") from error


@torch.no_grad()
def map_normals(mesh: Mesh, field: FieldLike, *, level: int = -1, batch: int = 1 << 18) -> Mesh:
    """Neural normal mapping (paper, Sec. 3): the mesh with normals ∇f_j(p) / |∇f_j(p)| at its vertices p.

    Where f_j is a distance, this is the normal of its surface at the point nearest to p. So a coarse mesh, in the
    coordinates of the field, shades like a fine one as long as it stays within the bands of the level. ``batch`` is
    points per call.
    """
    field = as_field(field)
    points = torch.from_numpy(mesh.vertices).to(field.like)
    gradients = [field.jet(part, level=level).gradient for part in points.split(batch)]
    return replace(mesh, normals=normalize(torch.cat(gradients), dim=-1).float().cpu().numpy())


def _newton(
    fractions: NDArray[np.float64],
    values: NDArray[np.floating],
    slopes: NDArray[np.floating],
    rising: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """One Newton step along the edges, where the slope there agrees with the signs at their ends."""
    sane = np.where(rising, slopes, -slopes) > np.abs(values)
    return fractions - np.where(sane, values / np.where(sane, slopes, 1), 0.0)


def _triangles(cells: ActiveCells) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Connect the crossed edges of the cells.

    Returns faces ``(F, 3)``, and for each vertex the rows ``(V, 2)`` of the lattice points at the ends of its edge.
    """
    tables = cube_tables()
    number = np.zeros(3 * len(cells.points), np.int32)
    for edge, (low, _) in enumerate(EDGE_ENDS):
        crossed = tables.crossed[cells.cases, edge]
        number[3 * cells.corners[low][crossed] + int(EDGE_AXIS[edge])] = 1
    used = np.flatnonzero(number)
    number[used] = np.arange(len(used), dtype=np.int32)
    ends = np.empty((len(used), 2), np.int32)
    ends[:, 0] = used // 3
    for edge, (low, high) in enumerate(EDGE_ENDS):
        crossed = tables.crossed[cells.cases, edge]
        ends[number[3 * cells.corners[low][crossed] + int(EDGE_AXIS[edge])], 1] = cells.corners[high][crossed]

    first = tables.start[cells.cases]
    last = np.cumsum(tables.start[cells.cases.astype(np.int64) + 1] - first)
    faces = np.empty((last[-1], 3), np.int32)
    for begin in range(0, len(first), 1 << 18):
        part = slice(begin, begin + (1 << 18))
        before = np.concatenate(([0] if begin == 0 else [last[begin - 1]], last[part][:-1]))
        cell = np.repeat(np.arange(begin, begin + len(before)), last[part] - before)
        within = np.arange(before[0], before[0] + len(cell)) - np.repeat(before, last[part] - before)
        triangles = tables.triangles[first[cell] + within]  # (f, 3) edges of the cube
        key = 3 * cells.corners[EDGE_ENDS[triangles, 0], cell[:, None]] + EDGE_AXIS[triangles]
        faces[before[0] : before[0] + len(cell)] = number[key]
    return faces, ends
