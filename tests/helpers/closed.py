"""Whether a mesh is closed, as marching cubes promise."""

import numpy as np
from mplicits.neural_fields import Mesh


def directed_edges(mesh: Mesh):
    f = mesh.faces.astype(np.int64)
    a, b = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]).T
    return a, b


def assert_closed(mesh: Mesh):
    """Every edge lies in exactly two faces, which run along it in opposite directions."""
    a, b = directed_edges(mesh)
    forth = np.sort(a * len(mesh.vertices) + b)
    assert (np.diff(forth) > 0).all(), "two faces run along an edge in the same direction"
    assert np.array_equal(forth, np.sort(b * len(mesh.vertices) + a)), "an edge lies in one face only"
