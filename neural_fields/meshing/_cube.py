"""The 256 cases of marching cubes (Lorensen and Cline 1987), derived from one rule per face instead of typed in.

A cube has corners ``0..7`` (bit 0 of the number is x, bit 1 y, bit 2 z) and twelve edges. Bit c of a case says that
corner c is inside (negative). On each face, walked counter-clockwise as seen from outside, every crossing from outside
to inside is joined to the next one back. Two cubes that share a face therefore draw the same segments on it, so the
surface has no cracks. Each crossed edge is entered on one of its faces and left on the other, so segments close into
loops. Loops are cut into triangles without diagonals in a face, where the neighbour might place the same one.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["CORNERS", "EDGE_AXIS", "EDGE_ENDS", "CubeTables", "cube_tables"]

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
    """What a case byte means.

    Attributes:
        crossed: ``(256, 12)`` bool, the edges whose ends differ in sign.
        ends: ``(256, 8)`` bool, the corners at the end of a crossed edge.
        start: ``(257,)`` first row of each case in ``triangles``.
        triangles: ``(T, 3)`` edge numbers, counter-clockwise as seen from the positive side.
    """

    crossed: NDArray[np.bool_]
    ends: NDArray[np.bool_]
    start: NDArray[np.int64]
    triangles: NDArray[np.int64]


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
            leave = _EDGE_OF[frozenset((face[j % 4], face[(j + 1) % 4]))]
            follow[enter] = leave
    loops = []
    while follow:
        loop = [next(iter(follow))]
        while (edge := follow.pop(loop[-1])) != loop[0]:
            loop.append(edge)
        loops.append(loop)
    return loops


def _cut(loop: list[int]) -> list[tuple[int, int, int]]:
    """Triangulate a polygon with as few diagonals inside a face of the cube as can be."""

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
    """Derive the tables; a few milliseconds, once."""
    inside = (np.arange(256)[:, None] >> np.arange(8) & 1).astype(bool)
    crossed = inside[:, EDGE_ENDS[:, 0]] != inside[:, EDGE_ENDS[:, 1]]
    ends = np.zeros((256, 8), bool)
    for edge, (a, b) in enumerate(EDGE_ENDS):
        ends[:, a] |= crossed[:, edge]
        ends[:, b] |= crossed[:, edge]
    cases = [[triangle for loop in _loops(case) for triangle in _cut(loop)] for case in range(256)]
    start = np.concatenate(([0], np.cumsum([len(case) for case in cases])))
    triangles = np.array([triangle for case in cases for triangle in case])
    return CubeTables(crossed, ends, start, triangles)
