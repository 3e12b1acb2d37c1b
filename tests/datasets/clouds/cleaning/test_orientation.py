"""Signs of normals by evidence and by neighbours; regions of space around clouds whose inside is known."""

import numpy as np
import pytest
from mplicits.datasets import sample_sphere
from mplicits.datasets.clouds.cleaning.orientation import OUTER_REGION, Exterior, solve_signs

PLACES = np.array([[0.0, 0, 0], [0.35, 0, 0], [0.0, 0, 0.95], [-1.1, 1.1, 1.1]])


def test_signs_walk_from_where_evidence_is() -> None:
    points = sample_sphere(5000).points
    random = np.random.default_rng(0)
    wrong = random.choice([-1.0, 1.0], 5000)
    evidence = np.where(random.uniform(size=5000) < 0.6, wrong, 1e-6)
    assert (solve_signs(points, 2 * points * wrong[:, None], evidence) == wrong).mean() > 0.99  # evidence alone: 0.8


def test_evidence_outvotes_its_neighbours_where_it_is_strong() -> None:
    """The two sides of a wall are neighbours, and have opposite normals."""
    points = sample_sphere(5000, radius=0.5).points
    evidence = np.ones(5000)
    evidence[:50] = -1.0  # single contradictions among thousands of equal weight
    assert (solve_signs(points, 2 * points, evidence, weight=0.2) == 1).all()
    assert (solve_signs(points, 2 * points, evidence, weight=100.0) == evidence).all()


def test_a_closed_surface_encloses_what_is_in_it() -> None:
    ball = Exterior(sample_sphere(8000, radius=0.7).points)
    assert ball.regions(PLACES).tolist() == [2, 2, OUTER_REGION, OUTER_REGION]
    assert not ball.regions(sample_sphere(500, radius=0.7, seed=1).points).any()


def test_each_hollow_is_a_region() -> None:
    """Regions are numbered by size: 4/3 π (0.8³ − 0.5³) and 4/3 π 0.5³."""
    points = np.concatenate([sample_sphere(9000, radius=radius).points for radius in (0.8, 0.5)])
    nested = Exterior(points)
    assert nested.count == 3
    assert nested.regions(np.array([[0.0, 0, 0], [0.65, 0, 0], [0.9, 0, 0]])).tolist() == [3, 2, OUTER_REGION]


def test_a_bowl_encloses_nothing() -> None:
    points = sample_sphere(8000, radius=0.7).points
    assert Exterior(points[points[:, 2] < 0]).regions(PLACES[:2]).tolist() == [OUTER_REGION, OUTER_REGION]


@pytest.mark.slow
def test_single_gaps_of_a_random_cloud_do_not_leak() -> None:
    for seed in range(3):
        points = sample_sphere(4000, radius=0.7, seed=seed).points
        gap = 2 * np.sqrt(4 * np.pi * 0.7**2 / 4000)
        kept = np.linalg.norm(points - [0.7, 0, 0], axis=1) > gap
        assert Exterior(points[kept]).regions(PLACES[:2]).tolist() == [2, 2]
