"""Solids with sharp edges: closed, outward, and of the volume that their outline says."""

import math

import numpy as np
import pytest
import trimesh

from benchmarks.cli.shapes import SOLIDS
from benchmarks.shapes.prisms import PRISMS, TURN, box, cylinder, gear


def volume(solid: tuple[np.ndarray, np.ndarray]) -> float:
    mesh = trimesh.Trimesh(*solid, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    return float(mesh.volume)


def test_volumes() -> None:
    assert np.abs(TURN @ TURN.T - np.eye(3)).max() < 1e-12
    assert np.linalg.det(TURN) == pytest.approx(1)
    assert volume(box(1.0, 0.7, 1.2)) == pytest.approx(0.84)
    sides = 512
    polygon = sides / 2 * math.sin(2 * math.pi / sides) * 0.55**2
    assert volume(cylinder(0.55, 1.2, sides=sides)) == pytest.approx(1.2 * polygon)
    # Of each tooth's sector: the triangles from the middle to gap, flanks and tip.
    root, tip, turn = 0.62, 0.85, 2 * math.pi / 12
    gaps = root**2 / 2 * (math.sin(0.22 * turn) * 2)
    flanks = root * tip / 2 * math.sin(0.14 * turn) * 2
    assert volume(gear(12, height=0.44)) == pytest.approx(
        12 * 0.44 * (gaps + flanks + tip**2 / 2 * math.sin(0.28 * turn))
    )


def test_all_of_them_fit_into_the_mesher_and_lie_along_no_axis() -> None:
    assert tuple(PRISMS) == SOLIDS  # of `python -m benchmarks solid`
    for make in PRISMS.values():
        vertices, faces = make()
        assert np.abs(vertices).max() < 1
        ends = trimesh.Trimesh(vertices, faces, process=False).face_normals[len(faces) // 2 :]
        assert np.abs(ends).max() < 0.9
