"""A surface too fine for memory: marching cubes on one lattice, part by part, with what parts share made equal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..backend.errors import positive
from ..fields.field import FieldLike, solid
from ._cells import CORNERS, OFFSETS, Floats, Given, Ints, Lattice, NoSurfaceError, Progress, Sampler, cull_blocks
from .extract import DEFAULT_BOUNDS, Bounds, extract_surface
from .mesh import Mesh

Place = tuple[int, int, int]


class Border(NamedTuple):
    """What neighbours need of a part: values and vertices on the sides of its cube.

    Attributes:
        points: ``(P, 3)`` lattice points at which the field was evaluated.
        values: ``(P,)`` of the field there.
        edges: ``(S,)`` numbers of the lattice edges that the surface crosses.
        vertices: ``(S, 3)`` of the surface there.
        normals: ``(S, 3)``.
    """

    points: Ints
    values: Floats
    edges: Ints
    vertices: NDArray[np.float64]
    normals: Floats


class Part(NamedTuple):
    """The surface in one cube of a lattice.

    Attributes:
        place: ``(3,)`` number of the cube along each axis, from the lowest corner.
        mesh: its vertices on sides of the cube are repeated by its neighbours there, equal to the last bit.
        shared: ``(S,)`` rows of these vertices.
        border: has their lattice edges, by which the neighbours know them.
    """

    place: Place
    mesh: Mesh
    shared: NDArray[np.intp]
    border: Border


def extract_parts(
    field: FieldLike,
    *,
    resolution: int,
    cells: int = 128,
    level: int = -1,
    bounds: Bounds = DEFAULT_BOUNDS,
    lipschitz: float = 1.25,
    clearance: float = 1e-3,
    batch: int = 1 << 18,
    known: Mapping[Place, Border] | None = None,
    progress: Progress | None = None,
) -> Iterator[Part]:
    """The surface that `extract_mesh` extracts, in cubes of ``cells`` cells, one after the other.

    A part takes values and vertices at its sides from neighbours that came before. If it crosses a side where an
    earlier one does not, as it may where |∇f| > L, that one is extracted again: it comes a second time, and replaces
    the first. So in the end the parts, joined at shared vertices, are watertight inside the box. Memory is that of one
    part, and of the sides of all.

    Args:
        field: as for `extract_mesh`.
        resolution: cells along the longest axis of the box.
        cells: cells along each edge of a cube, a power of two.
        level: the level whose zero set is wanted.
        bounds: lowest and highest corner of the box.
        lipschitz: L, as for `extract_mesh`.
        clearance: least distance of a vertex from the ends of its edge, in cells.
        batch: points per call of the field.
        known: of the parts of an extraction with the same arguments that was interrupted; the others come.
        progress: called with ``("parts", done, total)`` after every part.

    Raises:
        NoSurfaceError: no part has a surface.
        ValueError: an argument is out of range, or the field is not finite.

    Example:
        >>> from mplicits.neural_fields import Sphere
        >>> from mplicits.neural_fields.meshing.parts import extract_parts
        >>> len(list(extract_parts(Sphere(radius=0.5), resolution=64, cells=32)))
        8
    """
    field = solid(field)
    positive(lipschitz=lipschitz, batch=batch)
    if cells < 2 or cells & (cells - 1):
        raise ValueError(f"cells={cells}: expected a power of two, at least 2")
    level = field.resolve_level(level)
    slope = field.slope_bound(lipschitz)
    lattice = Lattice.over(bounds, resolution)
    size = np.array(lattice.shape) + 1
    blocks, _, kept = cull_blocks(Sampler(field, lattice, batch), level=level, lipschitz=slope, smallest=cells)
    borders = dict(known or {})

    def around(place: Place) -> list[Place]:
        """The cubes beside one."""
        beside = np.array(place) + OFFSETS - 1
        exists = ((beside >= 0) & (beside * cells < lattice.shape)).all(axis=1)
        return [tuple(each) for each in beside[exists].tolist()]

    def lacking(place: Place) -> Iterator[Place]:
        """The cubes beside a part that do not know all the edges which the surface crosses there."""
        mine = borders[place].edges
        starts, ends = _ends(mine, size)
        for other in around(place):
            box = lattice.part(np.array(other) * cells, cells)
            theirs = borders[other].edges if other in borders else ()
            if len(np.setdiff1d(mine[_inside(starts, box) & _inside(ends, box)], theirs)):
                yield other

    every = map(tuple, np.unique(blocks[kept] // cells, axis=0).tolist())
    waiting: dict[Place, None] = dict.fromkeys(place for place in every if place not in borders)
    for place in borders:
        waiting |= dict.fromkeys(lacking(place))
    done = len(borders)
    while waiting:
        place = next(iter(waiting))
        del waiting[place]
        part = lattice.part(np.array(place) * cells, cells)
        beside = [borders[each] for each in around(place) if each in borders]
        try:
            found = _part(Sampler(field, part, batch), size, place, beside, level, slope, clearance=clearance)
        except NoSurfaceError:
            continue
        finally:
            done += 1
            if progress is not None:
                progress("parts", done, done + len(waiting))
        borders[place] = found.border
        waiting |= dict.fromkeys(lacking(place))
        yield found
    if not borders:
        raise NoSurfaceError(f"no surface in any of {done} parts of the box {lattice}")


def _inside(points: Ints, box: Lattice) -> NDArray[np.bool_]:
    """Which points ``(N, 3)`` of the whole lattice lie in a part of it, or on its sides."""
    first = np.array(box.first)
    return np.all((points >= first) & (points <= first + box.shape), axis=1)


def _ends(edges: Ints, size: NDArray[np.int64]) -> tuple[Ints, Ints]:
    """Both lattice points ``(N, 3)`` of numbered edges."""
    at, along = np.divmod(edges, 3)
    starts = np.stack(np.unravel_index(at, tuple(size)), axis=1)
    return starts, starts + (np.arange(3) == along[:, None])


def _part(
    sampler: Sampler,
    size: NDArray[np.int64],
    place: Place,
    known: list[Border],
    level: int,
    slope: float,
    *,
    clearance: float,
) -> Part:
    """A part that takes what is ``known`` of its border.

    ``size`` ``(3,)`` counts the points of the whole lattice.
    """
    lattice = sampler.lattice
    first, shape = np.array(lattice.first), np.array(lattice.shape)
    rows = np.empty((0, 3))
    nothing = Border(rows.astype(np.int64), rows[:, 0], rows[:, 0].astype(np.int64), rows, rows.astype(np.float32))
    points, values, edges, places, directions = map(np.concatenate, zip(nothing, *known, strict=True))
    within = _inside(points, lattice)
    edges, chosen = np.unique(edges, return_index=True)
    starts, stops = _ends(edges, size)
    corners = (starts - first)[:, None] - CORNERS * (starts == stops)[:, None]
    blocks = corners[_inside(starts, lattice) & _inside(stops, lattice)].reshape(-1, 3) // 2 * 2
    crossed = np.unique(blocks[((blocks >= 0) & (blocks < shape)).all(axis=1)], axis=0)
    given = Given(points[within] - first, values[within], crossed)
    mesh, active, ends = extract_surface(sampler, level, slope, normals=True, clearance=clearance, given=given)
    low, high = active.points[ends[:, 0]].astype(np.int64), active.points[ends[:, 1]]
    flat = low == high  # on the axes that an edge does not run along
    shared = np.flatnonzero((flat & ((low == 0) | (low == shape))).any(axis=1))
    own = 3 * np.ravel_multi_index(tuple((low[shared] + first).T), tuple(size)) + flat[shared].argmin(axis=1)
    _, mine, theirs = np.intersect1d(own, edges, assume_unique=True, return_indices=True)
    assert mesh.normals is not None
    mesh.vertices[shared[mine]], mesh.normals[shared[mine]] = places[chosen[theirs]], directions[chosen[theirs]]
    on_sides, asked = active.on_sides
    border = Border(on_sides + first, asked, own, mesh.vertices[shared], mesh.normals[shared])
    return Part(place, mesh, shared, border)
