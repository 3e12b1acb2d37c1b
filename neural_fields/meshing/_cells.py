"""The cells of a lattice that a surface crosses, and the 256 cases of marching cubes (Lorensen and Cline 1987).

All indices are lattice points (see `Lattice`). Blocks of cells are culled down to 2³ cells, whose centre is itself a
lattice point; then signs at the corners of the remaining blocks are found.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..fields.field import Field

Ints = NDArray[np.integer]
Floats = NDArray[np.floating]
Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Lattice:
    """Cubic cells of edge ``step`` from ``low`` upwards; ``shape`` counts cells, so there are ``shape + 1`` points.

    A part of a lattice has the same ``low``, and begins at that lattice's point ``first``.
    """

    low: tuple[float, float, float]
    step: float
    shape: tuple[int, int, int]
    first: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def over(cls, bounds: Bounds, resolution: int) -> Lattice:
        """The lattice with ``resolution`` cells along the longest axis of a box; other axes round up to whole cells.

        ValueError if the box is empty or not finite, or for fewer than two cells.
        """
        low, high = (np.asarray(corner, np.float64) for corner in bounds)
        if low.shape != (3,) or high.shape != (3,) or not np.isfinite([low, high]).all() or not (low < high).all():
            raise ValueError(
                f"bounds={bounds}: expected two corners of three finite numbers, the first below the second"
            )
        if resolution < 2:
            raise ValueError(f"resolution={resolution}: expected at least 2 cells along the longest axis")
        step = float((high - low).max()) / resolution
        # A millionth of a cell is rounding, not a reason for another layer.
        x, y, z = (max(1, math.ceil(extent / step - 1e-6)) for extent in high - low)
        return cls((float(low[0]), float(low[1]), float(low[2])), step, (x, y, z))

    def positions(self, index: NDArray[np.integer] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Coordinates of points ``(N, 3)`` counted in cells, whole or not."""
        return (np.asarray(index, np.float64) + self.first) * self.step + np.asarray(self.low)

    def part(self, first: Ints, cells: int) -> Lattice:
        """The part of at most ``cells`` cells along each axis that begins at the point ``first``."""
        x, y, z = (min(cells, end - start) for start, end in zip(first.tolist(), self.shape, strict=True))
        i, j, k = first.tolist()
        return Lattice(self.low, self.step, (x, y, z), (i, j, k))

    def __str__(self) -> str:
        """The box, for messages."""
        low, high = self.positions(np.array([(0, 0, 0), self.shape]))
        return " × ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))


class Sampler:
    """Evaluates a field at lattice points in batches of ``batch`` rows, checks that values are finite, and counts.

    ``progress(stage, done, total)`` is called after every batch; ``counts`` holds the points sent to each level so far.
    """

    def __init__(self, field: Field, lattice: Lattice, batch: int, progress: Progress | None = None) -> None:
        self.field, self.lattice, self.batch, self.progress = field, lattice, batch, progress
        self.counts = [0] * field.num_levels
        self._like = field.like

    def _points(self, positions: NDArray[np.float64]) -> torch.Tensor:
        return torch.from_numpy(positions).to(self._like)

    @torch.inference_mode()
    def values(
        self, count: int, points: Callable[[slice], NDArray[np.integer]], *, level: int, stage: str
    ) -> NDArray[np.floating]:
        """Values at ``count`` lattice points → ``(count,)``, in the field's dtype; ValueError if one is not finite.

        ``points`` returns a part of them, ``(n, 3)``, when it is needed, so that they never exist all at once.
        """
        parts = [np.empty(0, np.float32)]
        for start in range(0, count, self.batch):
            positions = self.lattice.positions(points(slice(start, start + self.batch)))
            part = self.field.value(self._points(positions), level=level).cpu().numpy()
            self._check(part, positions, level)
            self._report(level, stage, start + len(part), count, len(part))
            parts.append(part)
        return np.concatenate(parts[1:] or parts)

    @torch.inference_mode()
    def jets(
        self, positions: NDArray[np.float64], *, level: int, stage: str
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Values ``(N,)`` and gradients ``(N, 3)`` at positions ``(N, 3)``; ValueError if one is not finite."""
        values = [np.empty(0, np.float32)]
        gradients = [np.empty((0, 3), np.float32)]
        for start in range(0, len(positions), self.batch):
            batch = positions[start : start + self.batch]
            jet = self.field.jet(self._points(batch), level=level)
            values.append(jet.value.cpu().numpy())
            gradients.append(jet.gradient.cpu().numpy())
            self._check(values[-1] + gradients[-1].sum(axis=1), batch, level)
            self._report(level, stage, start + len(batch), len(positions), len(batch))
        return np.concatenate(values[1:] or values), np.concatenate(gradients[1:] or gradients)

    def _check(self, values: NDArray[np.floating], positions: NDArray[np.float64], level: int) -> None:
        bad = ~np.isfinite(values)
        if bad.any():
            where = ", ".join(f"{c:.4g}" for c in positions[bad.argmax()])
            raise ValueError(
                f"field: level {level} is not finite at {bad.sum()} of {len(values)} points, first at ({where}); "
                "its parameters have probably diverged"
            )

    def _report(self, level: int, stage: str, done: int, total: int, count: int) -> None:
        self.counts[level] += count
        if self.progress is not None:
            self.progress(stage, done, total)


CORNERS: NDArray[np.int64] = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])  # (8, 3)
_EDGES = [(c, c | 1 << axis, axis) for axis in range(3) for c in range(8) if not c >> axis & 1]
EDGE_ENDS: NDArray[np.int64] = np.array([(a, b) for a, b, _ in _EDGES])  # (12, 2), the lower corner first
EDGE_AXIS: NDArray[np.int64] = np.array([axis for _, _, axis in _EDGES])  # (12,)
_EDGE_OF = {frozenset((a, b)): index for index, (a, b, _) in enumerate(_EDGES)}


def _faces() -> list[tuple[int, int, int, int]]:
    """Corners of the six faces, counter-clockwise as seen from outside the cube."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        low, high = 0, 1 << axis
        faces += [(high, high | u, high | u | v, high | v), (low, low | v, low | u | v, low | u)]
    return faces


_FACES = _faces()
_EDGE_FACES = [frozenset(i for i, face in enumerate(_FACES) if {a, b} <= set(face)) for a, b, _ in _EDGES]


class CubeTables(NamedTuple):
    """What a case byte means: bit c says that corner c is inside."""

    crossed: NDArray[np.bool_]  # (256, 12), edges whose ends differ in sign
    ends: NDArray[np.bool_]  # (256, 8), corners at the end of a crossed edge
    start: NDArray[np.int64]  # (257,) first row of each case in `triangles`
    triangles: NDArray[np.int64]  # (T, 3) edge numbers, counter-clockwise as seen from the positive side


def _loops(case: int) -> list[list[int]]:
    """The closed polygons of a case, as edge numbers, counter-clockwise as seen from the positive side."""
    follow: dict[int, int] = {}
    for face in _FACES:
        inside = [bool(case >> corner & 1) for corner in face]
        for i in range(4):
            if inside[i - 1] or not inside[i]:
                continue
            j = i
            while inside[(j + 1) % 4]:
                j += 1
            enter = _EDGE_OF[frozenset((face[i - 1], face[i]))]
            follow[enter] = _EDGE_OF[frozenset((face[j % 4], face[(j + 1) % 4]))]
    loops = []
    while follow:
        loop = [next(iter(follow))]
        while (edge := follow.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        loops.append(loop)
    return loops


def _cut(loop: list[int]) -> list[tuple[int, int, int]]:
    """Triangulate a polygon with the fewest diagonals in a face, where the neighbour might place the same one."""

    @cache
    def best(i: int, j: int) -> tuple[int, tuple[tuple[int, int, int], ...]]:
        if j - i < 2:
            return 0, ()
        options = []
        for k in range(i + 1, j):
            left, right = best(i, k), best(k, j)
            options.append((left[0] + right[0], (*left[1], (loop[i], loop[k], loop[j]), *right[1])))
        closing = (i, j) == (0, len(loop) - 1)
        flat = 0 if closing else bool(_EDGE_FACES[loop[i]] & _EDGE_FACES[loop[j]])
        cost, triangles = min(options, key=lambda option: option[0])
        return cost + flat, triangles

    return list(best(0, len(loop) - 1)[1])


@cache
def cube_tables() -> CubeTables:
    """Derive the 256 cases from one rule per face instead of typing them in; a few milliseconds, once.

    On each face, walked counter-clockwise from outside, every crossing from outside to inside is joined to the next one
    back. Two cubes that share a face draw the same segments on it, so the surface has no cracks. Each crossed edge is
    entered on one of its faces and left on the other, so segments close into loops, which are cut into triangles.
    """
    inside = (np.arange(256)[:, None] >> np.arange(8) & 1).astype(bool)
    crossed = inside[:, EDGE_ENDS[:, 0]] != inside[:, EDGE_ENDS[:, 1]]
    ends = np.zeros((256, 8), bool)
    for edge, (a, b) in enumerate(EDGE_ENDS):
        ends[:, a] |= crossed[:, edge]
        ends[:, b] |= crossed[:, edge]
    cases = [[triangle for loop in _loops(case) for triangle in _cut(loop)] for case in range(256)]
    start = np.concatenate(([0], np.cumsum([len(case) for case in cases])))
    return CubeTables(crossed, ends, start, np.array([triangle for case in cases for triangle in case]))


_BITS = np.array([1, 2, 4])
OFFSETS: Ints = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(27, 3)


class NoSurfaceError(ValueError):
    """The field does not change sign in the box; the message says what it does instead."""


@dataclass(frozen=True)
class ActiveCells:
    """The cells that the surface crosses."""

    cases: NDArray[np.uint8]  # (C,) case of each cell (see `cube_tables`)
    corners: NDArray[np.int32]  # (8, C) rows of `points`
    points: Ints  # (P, 3) lattice points
    values: Floats  # (P,) their values, valid at the ends of crossed edges
    on_sides: tuple[Ints, Floats]  # points (S, 3) on the sides of the box that were evaluated, and their values (S,)


class Given(NamedTuple):
    """Known before: values ``(N,)`` at lattice points ``(N, 3)``; origins ``(B, 3)`` of blocks that are crossed."""

    points: Ints
    values: Floats
    crossed: Ints


def cull_blocks(
    sampler: Sampler, *, level: int, lipschitz: float, along: int = 32, smallest: int = 2
) -> tuple[Ints, Floats, NDArray[np.bool_]]:
    """Halve blocks, at first about ``along`` an axis, down to 2³ cells, dropping those that cannot hold a zero.

    A stage with blocks of half diagonal r evaluates level j at the block centres c and keeps those with

        |f_j(c)| ≤ L r + δ_j,

    because a zero p of the target has |f_j(p)| < δ_j and |f_j(c) − f_j(p)| ≤ L r. The level is the first with 4 δ_j ≤ L
    r: a finer one would cull little more; for the target δ is 0. Neighbouring centres of opposite signs are both kept,
    since there the bound is violated.

    Returns, of all blocks of 2³ cells evaluated: origins ``(B, 3)``, target values at the centres ``(B,)``, and which
    survived ``(B,)``; the others still bound the field. With ``smallest``, a power of two, the same of larger blocks.
    Raises NoSurfaceError if none survives.
    """
    lattice = sampler.lattice
    deltas = [float(delta) for delta in sampler.field.deltas[:level]]
    size = max(smallest, 2 ** max(1, math.floor(math.log2(max(lattice.shape) / along))))
    axes = [np.arange(0, cells, size) for cells in lattice.shape]
    blocks = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    while True:
        reach = lipschitz * lattice.step * size * math.sqrt(3) / 2
        used = next((j for j, delta in enumerate(deltas) if 4 * delta <= reach), level) if size > 2 else level
        slack = deltas[used] if used < level else 0.0
        stage = f"blocks of {size}³ cells"
        values = sampler.values(len(blocks), lambda part: blocks[part] + size // 2, level=used, stage=stage)  # noqa: B023
        kept = (np.abs(values) <= reach + slack) | _beside_other_sign(blocks // size, values < 0)
        if not kept.any():
            raise NoSurfaceError(_where_signs_are(values, blocks + size // 2, lattice, sampler))
        if size == smallest:
            return blocks, values, kept
        size //= 2
        blocks = (blocks[kept, None] + CORNERS * size).reshape(-1, 3)
        blocks = blocks[(blocks < lattice.shape).all(axis=1)]


def _beside_other_sign(cells: Ints, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the ``cells`` ``(N, 3)`` have one of their six neighbours in the list with the other sign."""
    size = cells.max(axis=0) + 2
    strides = np.array([size[1] * size[2], size[2], 1])
    keys = cells @ strides
    order = np.argsort(keys)
    keys, sign = keys[order], inside[order]
    found = np.zeros(len(cells), bool)
    for stride in strides:
        right = np.minimum(np.searchsorted(keys, keys + stride), len(keys) - 1)
        differ = (keys[right] == keys + stride) & (sign[right] != sign)
        found[order[differ]] = True
        found[order[right[differ]]] = True
    return found


def _where_signs_are(values: Floats, points: Ints, lattice: Lattice, sampler: Sampler) -> str:
    smallest = int(np.abs(values).argmin())
    where = ", ".join(f"{c:.4g}" for c in lattice.positions(points[smallest]))
    inside = int((values < 0).sum())
    signs = {0: "all positive", len(values): "all negative"}.get(inside, f"{inside} of them negative")
    return (
        f"no surface in the box {lattice}: of {sum(sampler.counts)} points evaluated the last {len(values)} are "
        f"{signs}, the smallest value {values[smallest]:.4g} at ({where}), cells of {lattice.step:.3g}"
    )


def active_cells(
    sampler: Sampler,
    blocks: Ints,
    centres: Floats,
    kept: NDArray[np.bool_],
    *,
    level: int,
    lipschitz: float,
    given: Given | None = None,
) -> ActiveCells:
    """The crossed cells of 2³-cell blocks, with exact values at both ends of every crossed edge.

    The sign at a corner q follows from any known centre c of a block around it with |f(c)| > L |q − c|; only other
    corners are evaluated, then the ends of crossed edges, until nothing is new. Where the surface leaves the blocks
    through a face, the neighbour there is added: the surface is closed inside the box also where the field is steeper
    than L. What is ``given`` is taken, and then the values at the sides of the box are returned with the cells.

    Raises NoSurfaceError if the blocks hold no sign change.
    """
    known, missing = (np.empty((0, 3), np.int64), centres[:0]), blocks[:0]
    if given is not None:
        known = (given.points, given.values)
        whole = tuple(cells + 1 for cells in sampler.lattice.shape)
        there, wanted = (np.ravel_multi_index(tuple(each.T), whole) for each in (blocks[kept], given.crossed))
        missing = given.crossed[~np.isin(wanted, there)]
    while True:
        if len(missing):
            blocks = np.concatenate((blocks, missing))
            added = sampler.values(len(missing), lambda part: missing[part] + 1, level=level, stage="closing")  # noqa: B023
            centres = np.concatenate((centres, added))
            kept = np.concatenate((kept, np.ones(len(missing), bool)))
        corners = _Corners(sampler, blocks, centres, kept, known, level=level, lipschitz=lipschitz)
        missing = corners.open_neighbours()
        if not len(missing):
            return corners.cells(sides=given is not None)
        known = corners.known_values()


def _merged(first: Ints, second: Ints) -> Ints:
    """The union of two sorted lists, sorted; a stable sort merges sorted runs in linear time."""
    both = np.sort(np.concatenate((first, second)), kind="stable")
    return both[np.append(True, both[1:] != both[:-1])]


class _Corners:
    """Signs and values at the corner points of a set of 2³-cell blocks.

    Every point belongs to the block at its lower end: point ``(2 b + o)`` with ``o`` in {0, 1}³ is number ``o`` of
    block b. Points on the upper sides belong to the neighbours there, listed as owners whether in the set or not:
    shared points have one number, and no sorting of points is needed.
    """

    def __init__(
        self,
        sampler: Sampler,
        blocks: Ints,
        centres: Floats,
        kept: NDArray[np.bool_],
        known: tuple[Ints, Floats],
        *,
        level: int,
        lipschitz: float,
    ) -> None:
        self.sampler, self.level = sampler, level
        self.lattice = sampler.lattice
        # Two spare layers on each axis let the key of any neighbour be had by adding a stride.
        self.size = tuple(cells // 2 + 3 for cells in self.lattice.shape)
        self.strides = np.array([self.size[1] * self.size[2], self.size[2], 1])
        all_keys = (blocks // 2 + 1) @ self.strides
        order = np.flatnonzero(kept)
        order = order[np.argsort(all_keys[order])]
        self.blocks, self.keys = blocks[order], all_keys[order]
        self.owners = self.keys
        for stride in self.strides:
            self.owners = _merged(self.owners, self.owners + stride)
        self.owner_of = [
            np.searchsorted(self.owners, self.keys + corner @ self.strides).astype(np.int32) for corner in CORNERS
        ]
        count = 8 * len(self.owners)
        self.value = np.zeros(count, centres.dtype)
        self.known = np.zeros(count, bool)
        self._set(self.rows(OFFSETS[13]), centres[order])
        points, values = known
        keys = (points // 2 + 1) @ self.strides
        owner = np.minimum(np.searchsorted(self.owners, keys), len(self.owners) - 1).astype(np.int32)
        listed = self.owners[owner] == keys
        self._set(self._row(owner, points)[listed], values[listed])
        self.inside = np.zeros(count, bool)
        self._find_signs(all_keys, centres, lipschitz * self.lattice.step)
        self._verify_ends()

    def rows(self, offset: Ints) -> NDArray[np.int32]:
        """Point numbers of one of the 27 points, ``offset`` in {0, 1, 2}³, of every block."""
        return self._row(self.owner_of[int(offset // 2 @ _BITS)], offset)

    @staticmethod
    def _row(owner: NDArray[np.int32], offset: Ints) -> NDArray[np.int32]:
        return owner * 8 + (offset % 2 @ _BITS).astype(np.int32)

    def points(self, rows: NDArray[np.integer]) -> Ints:
        """Lattice points ``(N, 3)`` of point numbers."""
        return self._places(self.owners[rows // 8], [rows >> axis & 1 for axis in range(3)])

    def _places(self, keys: Ints, within: Sequence[Ints | int]) -> NDArray[np.int32]:
        """Lattice points ``(N, 3)`` at some offsets from the origins of blocks given by their keys."""
        places = np.empty((len(keys), 3), np.int32)
        for axis, block in enumerate(np.unravel_index(keys, self.size)):
            places[:, axis] = 2 * (block - 1) + within[axis]
        return places

    def _set(self, rows: NDArray[np.integer], values: Floats) -> None:
        self.value[rows], self.known[rows] = values, True

    def _evaluate(self, rows: NDArray[np.integer], stage: str) -> None:
        values = self.sampler.values(len(rows), lambda part: self.points(rows[part]), level=self.level, stage=stage)
        self._set(rows, values)

    def _find_signs(self, all_keys: Ints, centres: Floats, slope: float) -> None:
        """Bound the field at every point by ``centres ± slope · distance``, and evaluate where that leaves both signs.

        ``all_keys`` are the keys of all blocks whose centre was evaluated, in the set or not.
        """
        low, high = np.full_like(self.value, -np.inf), np.full_like(self.value, np.inf)
        for corner in CORNERS:
            keys = all_keys + corner @ self.strides
            owner = np.minimum(np.searchsorted(self.owners, keys), len(self.owners) - 1).astype(np.int32)
            listed = self.owners[owner] == keys
            owner, values = owner[listed], centres[listed]
            for offset in OFFSETS[np.all(corner == OFFSETS // 2, axis=1)]:
                rows, reach = self._row(owner, offset), slope * math.sqrt(((offset - 1) ** 2).sum())
                low[rows], high[rows] = np.maximum(low[rows], values - reach), np.minimum(high[rows], values + reach)
        touched = np.zeros(len(self.value), bool)
        for offset in OFFSETS:
            touched[self.rows(offset)] = True
        # Where two centres contradict each other the field is steeper than L: ask it.
        unsure = touched & ~self.known & ((low > 0) == (high < 0))
        self._evaluate(np.flatnonzero(unsure), "corners")
        self.inside = np.where(self.known, self.value < 0, high < 0)

    def _verify_ends(self) -> None:
        """Evaluate both ends of every crossed edge until no sign changes any more."""
        tables = cube_tables()
        while True:
            cases = self._cases()
            needed = np.zeros(len(self.value), bool)
            for cell, case in zip(CORNERS, cases, strict=True):
                ends = tables.ends[case]
                for number, corner in enumerate(CORNERS):
                    needed[self.rows(cell + corner)[ends[:, number]]] = True
            rows = np.flatnonzero(needed & ~self.known)
            self._evaluate(rows, "crossings")
            inside = self.value[rows] < 0
            changed = (inside != self.inside[rows]).any()
            self.inside[rows] = inside
            if not changed:
                return

    def _cases(self) -> NDArray[np.uint8]:
        """The case of each of the eight cells of each block, ``(8, B)``; cells beyond the box are empty."""
        cases = np.zeros((8, len(self.blocks)), np.uint8)
        for offset in OFFSETS:
            inside = self.inside[self.rows(offset)]
            for cell in np.flatnonzero(((offset >= CORNERS) & (offset <= CORNERS + 1)).all(axis=1)):
                cases[cell] |= inside.astype(np.uint8) << np.uint8((offset - CORNERS[cell]) @ _BITS)
        for cell, beyond in enumerate((self.blocks + corner >= self.lattice.shape).any(axis=1) for corner in CORNERS):
            cases[cell][beyond] = 0
        return cases

    def open_neighbours(self) -> Ints:
        """Blocks outside the set, inside the box, that share a face whose points differ in sign."""
        cells = (np.array(self.lattice.shape) + 1) // 2
        found = [self.keys[:0]]
        for axis in range(3):
            for side, step in ((0, -1), (2, 1)):
                face = [self.inside[self.rows(offset)] for offset in OFFSETS[OFFSETS[:, axis] == side]]
                place = self.blocks[:, axis] // 2 + step
                open_ = ~(np.logical_and.reduce(face) | ~np.logical_or.reduce(face))
                keys = self.keys[open_ & (place >= 0) & (place < cells[axis])] + step * self.strides[axis]
                near = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
                found.append(keys[self.keys[near] != keys])
        return self._places(np.unique(np.concatenate(found)), (0, 0, 0))

    def known_values(self) -> tuple[Ints, Floats]:
        """All lattice points evaluated ``(N, 3)``, and their values ``(N,)``."""
        rows = np.flatnonzero(self.known)
        return self.points(rows), self.value[rows]

    def cells(self, *, sides: bool) -> ActiveCells:
        """The crossed cells; with ``sides``, all points evaluated on the sides of the box too."""
        cases = self._cases()
        crossed = [np.flatnonzero((case != 0) & (case != 255)) for case in cases]
        chosen = np.concatenate([case[rows] for case, rows in zip(cases, crossed, strict=True)])
        if not len(chosen):
            centres = self.rows(OFFSETS[13])
            raise NoSurfaceError(
                _where_signs_are(self.value[centres], self.points(centres), self.lattice, self.sampler)
            )
        corners = np.empty((8, len(chosen)), np.int32)
        for number, corner in enumerate(CORNERS):
            columns = [self.rows(cell + corner)[rows] for cell, rows in zip(CORNERS, crossed, strict=True)]
            np.concatenate(columns, out=corners[number])
        is_used = np.zeros(len(self.value), bool)
        is_used[corners] = True
        used = np.flatnonzero(is_used)
        number = np.empty(len(self.value), np.int32)
        number[used] = np.arange(len(used), dtype=np.int32)
        for column in corners:
            column[:] = number[column]
        on_sides = (used[:0].reshape(-1, 3), self.value[:0])
        if sides:
            points, values = self.known_values()
            kept = ((points == 0) | (points == self.lattice.shape)).any(axis=1)
            on_sides = (points[kept], values[kept])
        return ActiveCells(chosen, corners, self.points(used), self.value[used], on_sides)
