"""Parts with sharp edges as exact meshes: a box, a cylinder, a gear."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Prism = tuple[Float64, NDArray[np.int64]]

# Away from the axes: marching cubes are exact on faces along them.
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def prism(outline: Float64, half_height: float) -> Prism:
    """The solid over a polygon ``(n, 2)``, star-shaped and counter-clockwise around the origin, turned by `TURN`.

    Vertices ``(2 n + 2, 3)`` and faces ``(4 n, 3)`` of a closed mesh, outward.
    """
    count = len(outline)
    corner, after = np.arange(count), np.roll(np.arange(count), -1)
    low, high = np.full(count, 2 * count), np.full(count, 2 * count + 1)  # the middles of the two ends
    rings = [np.column_stack((outline, np.full(count, height))) for height in (-half_height, half_height)]
    vertices = np.concatenate([*rings, [[0.0, 0.0, -half_height], [0.0, 0.0, half_height]]])
    faces = [
        np.column_stack((corner, after, after + count)),
        np.column_stack((corner, after + count, corner + count)),
        np.column_stack((high, corner + count, after + count)),
        np.column_stack((low, after, corner)),
    ]
    return vertices @ TURN.T, np.concatenate(faces).astype(np.int64)


def box(width: float = 1.0, depth: float = 0.7, height: float = 1.2) -> Prism:
    """A box of three sizes."""
    x, y = width / 2, depth / 2
    return prism(np.array([[-x, -y], [x, -y], [x, y], [-x, y]]), height / 2)


def cylinder(radius: float = 0.55, height: float = 1.2, *, sides: int = 512) -> Prism:
    """A cylinder with flat sides: 512 of them are within radius · 2e-5 of a round one."""
    angle = 2 * math.pi * np.arange(sides) / sides
    return prism(radius * np.column_stack((np.cos(angle), np.sin(angle))), height / 2)


def gear(teeth: int = 12, *, root: float = 0.62, tip: float = 0.85, height: float = 0.44) -> Prism:
    """A spur gear with straight flanks: convex edges, and concave ones between teeth."""
    # As shares of a tooth's turn: the gap, the flank, the tip and the other flank.
    turn = np.arange(teeth)[:, None] + np.array([0.0, 0.22, 0.36, 0.64, 0.78])
    radius = np.broadcast_to([root, root, tip, tip, root], turn.shape).ravel()
    angle = 2 * math.pi * turn.ravel() / teeth
    return prism(radius[:, None] * np.column_stack((np.cos(angle), np.sin(angle))), height / 2)


PRISMS: Mapping[str, Callable[[], Prism]] = MappingProxyType({"box": box, "cylinder": cylinder, "gear": gear})
