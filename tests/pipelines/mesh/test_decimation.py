"""Fewer triangles: how far they are from those before, against distances that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from mplicits.neural_fields import Mesh, Sphere, extract_mesh

pytest.importorskip("fast_simplification", reason="the extra mplicits[texture] is not installed")

from mplicits.pipelines.mesh.atlas import decimated, deviation

ROUNDING = 1e-6  # the decimation works in float32, on a mesh of unit size


@pytest.fixture(scope="module")
def ball():
    return extract_mesh(Sphere(radius=0.8), resolution=48)


@pytest.mark.parametrize("at", [0.0, 1000.0])
def test_the_distance_of_a_decimated_ball_is_what_is_stated(ball, at):
    """The farthest a decimated sphere is from the sphere is at a face centre, to within the full mesh's own error."""
    mesh, cost = decimated(replace(ball, vertices=ball.vertices + at), 600)
    assert 400 <= len(mesh.faces) <= 600
    assert (cost.faces_before, cost.faces) == (len(ball.faces), len(mesh.faces))
    assert (cost.closed_before, cost.closed) == (True, True)
    corners = mesh.vertices[mesh.faces] - at
    assert np.linalg.det(corners).min() > 0  # all faces point outward
    ends = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])
    probes = np.concatenate((corners.reshape(-1, 3), corners.mean(axis=1), ends.mean(axis=1)))
    radial = np.abs(np.linalg.norm(probes, axis=1) - 0.8).max()
    chords = ball.vertices[ball.faces].mean(axis=1)
    sag = 0.8 - np.linalg.norm(chords, axis=1).min()  # of the full mesh
    assert cost.largest == pytest.approx(radial, abs=1.5 * sag)
    assert 0 < cost.mean < cost.largest


def test_more_triangles_are_nearer(ball):
    costs = [decimated(ball, faces).cost for faces in (300, 1200)]
    assert costs[0].largest > 2 * costs[1].largest > 0


def test_a_mesh_of_no_more_stays_as_it_is(ball):
    mesh, cost = decimated(ball, len(ball.faces))
    assert mesh.vertices is ball.vertices
    assert (cost.largest, cost.mean, cost.closed) == (0.0, 0.0, True)


def test_flat_faces_cost_nothing():
    """A box whose sides are grids, decimated to a few triangles: still the same box."""
    fine = trimesh.creation.box((1.0, 0.8, 0.6)).subdivide().subdivide().subdivide()
    assert len(fine.faces) == 768
    mesh, cost = decimated(Mesh(np.asarray(fine.vertices), np.asarray(fine.faces, np.int32)), 64)
    assert len(mesh.faces) <= 64
    assert cost.largest < ROUNDING
    assert cost.closed
    holed, cost = decimated(Mesh(np.asarray(fine.vertices), np.asarray(fine.faces[1:], np.int32)), 10_000)
    assert not cost.closed_before
    assert "not watertight, as before" in cost.describe("mm")
    assert len(holed.faces) == 767


def test_both_ways_count():
    """Of a box and a tip 0.4 above it only the box is left: both see that."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    tip = np.array([[0.0, 0.0, 0.9], [0.1, 0.0, 0.9], [0.0, 0.1, 0.9]])
    alone = Mesh(np.asarray(box.vertices), np.asarray(box.faces, np.int64))
    both = Mesh(np.concatenate((alone.vertices, tip)), np.concatenate((alone.faces, [[8, 9, 10]])))
    assert deviation(both, alone) == (pytest.approx(0.4), pytest.approx(0.4 * 3 / 11 / 2))
    # Of 11 vertices, 19 + 3 edges and 13 faces of the larger mesh, 3, 3 and 1 are on the tip.
    edges = len(box.edges_unique) + 3
    assert deviation(alone, both) == (pytest.approx(0.4), pytest.approx(0.4 * 7 / (11 + edges + 13) / 2))
