"""Signs of normals from evidence at some points and from neighbours at the others."""

import numpy as np
import pytest
from mplicits.datasets import sample_sphere
from mplicits.datasets.clouds.cleaning.orientation import _agreement, nearest, settle_signs


def test_signs_walk_from_where_evidence_is() -> None:
    cloud = sample_sphere(5000)
    assert cloud.normals is not None
    random = np.random.default_rng(0)
    wrong = random.choice([-1.0, 1.0], len(cloud))
    evidence = np.where(random.uniform(size=len(cloud)) < 0.6, wrong, 1e-6)
    normals = cloud.normals.astype(np.float64) * wrong[:, None]
    assert (settle_signs(cloud.points, normals, evidence) == wrong).mean() > 0.99  # evidence alone: 0.8


def test_evidence_outvotes_its_neighbours_where_it_is_strong() -> None:
    """The two sides of a wall are neighbours, and have opposite normals."""
    ball = sample_sphere(5000, radius=0.5)
    assert ball.normals is not None
    normals = ball.normals.astype(np.float64)
    evidence = np.ones(len(ball))
    evidence[:50] = -1.0  # single contradictions among thousands of equal weight
    signs = settle_signs(ball.points, normals, evidence, weight=0.2)
    assert (signs == 1).all()
    followed = settle_signs(ball.points, normals, evidence, weight=100.0)
    assert (followed == evidence).all()


def test_neighbours_on_a_sphere_agree_whatever_it_bends() -> None:
    points = sample_sphere(500, radius=0.7).points.astype(np.float64)
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    near = nearest(points, 9)
    rows, columns = np.repeat(np.arange(len(points)), 8), near[:, 1:].ravel()

    def mean_agreement(n: np.ndarray) -> float:
        return float(_agreement(points, n, np.zeros(len(points)), rows, columns).mean())

    assert mean_agreement(normals) == pytest.approx(1, abs=1e-9)
    assert mean_agreement(-normals) == pytest.approx(1, abs=1e-9)
    sign = np.where(np.arange(len(points)) % 7, 1.0, -1.0)
    by_signs = np.mean([sign[i] * sign[j] for i, row in enumerate(near) for j in row if j != i])
    assert mean_agreement(sign[:, None] * normals) == pytest.approx(by_signs, abs=1e-9)
