"""Exact distances to triangles, boxes and needles."""

import numpy as np
import pytest
from mplicits.neural_fields import Mesh
from mplicits.pipelines.surface.distance import MeshDistance, barycentric_of_nearest

HALF = np.array([0.5, 0.3, 0.4])
# Two triangles a side, outward.
CUBOID = Mesh(
    HALF * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)],
    np.array(
        [
            *[[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
            *[[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
        ]
    ),
)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((0.2, 0.3, 1.0), (0.5, 0.2, 0.3)),  # above the inside
        ((-1.0, -1.0, 0.5), (1, 0, 0)),
        ((2.0, -0.5, 0.0), (0, 1, 0)),
        ((0.5, -1.0, 0.0), (0.5, 0.5, 0)),
        ((1.0, 1.0, 0.0), (0, 0.5, 0.5)),
        ((-1.0, 0.25, 0.0), (0.75, 0, 0.25)),
    ],
)
def test_nearest_point_of_a_triangle(point: tuple[float, ...], expected: tuple[float, ...]):
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    weights = barycentric_of_nearest(np.array(point), corners)
    np.testing.assert_allclose(weights, expected, atol=1e-15)
    assert [w == 0 for w in weights] == [e == 0 for e in expected]


def test_distances_to_a_box_are_exact_inside_outside_and_over_its_edges():
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3))
    q = np.abs(points) - HALF
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    np.testing.assert_allclose(MeshDistance(CUBOID).signed(points), exact, atol=1e-14)


@pytest.mark.slow
def test_long_faces_beside_many_small_ones_hide_nobody():
    # A large triangle far below a finely triangulated patch: its centre is much further away than it is.
    grid = np.linspace(-0.05, 0.05, 30)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    patch = np.stack((x, y, np.full_like(x, 0.2)), axis=-1).reshape(-1, 3)
    corner = np.arange(30 * 30).reshape(30, 30)[:-1, :-1].reshape(-1)
    faces = np.concatenate((corner[:, None] + [0, 30, 1], corner[:, None] + [1, 30, 31]))
    vertices = np.concatenate((patch, [[-1, -1, 0], [1, -1, 0], [0, 2, 0]]))
    both = Mesh(vertices, np.concatenate((faces, len(patch) + np.array([[0, 1, 2]]))))
    points = np.array([[0.0, -0.9, 0.03], [0.03, 0.02, 0.06], [0.03, 0.02, 0.14], [0.0, 0.0, 0.25]])
    np.testing.assert_allclose(MeshDistance(both).signed(points), [0.03, 0.06, -0.06, 0.05], atol=1e-14)


def test_sign_at_a_sharp_tip_is_that_of_all_faces_around_it():
    # Past the tip of a flat needle two of its faces, taken alone, would say inside.
    tip = Mesh(
        np.array([[1.0, 0, 0], [0, 0.2, 0], [0, -0.1, 0.17], [0, -0.1, -0.17]]),
        np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]),
    )
    directions = np.random.default_rng(1).normal(size=(500, 3)) * 0.1
    directions[:, 0] = np.abs(directions[:, 0]) + 0.3
    assert (MeshDistance(tip).signed(np.add([1, 0, 0], directions)) > 0).all()
    assert MeshDistance(tip).signed(np.array([[0.5, 0.0, 0.0]]))[0] < 0


def test_a_surface_without_faces_has_no_distances():
    with pytest.raises(ValueError, match="no faces"):
        MeshDistance(Mesh(np.eye(3), np.array([[0, 0, 1]])))
