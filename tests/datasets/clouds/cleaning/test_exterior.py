"""Regions of space around clouds whose in- and outside is known."""

import numpy as np
import pytest
from mplicits.datasets import sample_sphere
from mplicits.datasets.clouds.cleaning.exterior import OUTER_REGION, Exterior

PLACES = np.array([[0.0, 0, 0], [0.35, 0, 0], [0.0, 0, 0.95], [-1.1, 1.1, 1.1]])


def test_a_closed_surface_encloses_what_is_in_it() -> None:
    ball = Exterior(sample_sphere(8000, radius=0.7).points)
    assert ball.count == 2
    assert ball.regions(PLACES).tolist() == [2, 2, OUTER_REGION, OUTER_REGION]
    assert not ball.regions(sample_sphere(500, radius=0.7, seed=1).points).any()


def test_each_hollow_is_a_region() -> None:
    """Regions are numbered by their size, of which ∫ is 4/3 π (0.8³ − 0.5³) here and 4/3 π 0.5³ there."""
    points = np.concatenate([sample_sphere(9000, radius=radius).points for radius in (0.8, 0.5)])
    nested = Exterior(points)
    assert nested.count == 3
    assert nested.regions(np.array([[0.0, 0, 0], [0.65, 0, 0], [0.9, 0, 0]])).tolist() == [3, 2, OUTER_REGION]


def test_a_bowl_encloses_nothing() -> None:
    points = sample_sphere(8000, radius=0.7).points
    assert Exterior(points[points[:, 2] < 0]).regions(PLACES[:2]).tolist() == [OUTER_REGION, OUTER_REGION]


@pytest.mark.slow
def test_single_gaps_of_a_random_cloud_do_not_leak() -> None:
    """An empty disc of two spacings' radius in each of several clouds."""
    for seed in range(3):
        points = sample_sphere(4000, radius=0.7, seed=seed).points
        gap = 2 * np.sqrt(4 * np.pi * 0.7**2 / 4000)
        kept = np.linalg.norm(points - [0.7, 0, 0], axis=1) > gap
        assert Exterior(points[kept]).regions(PLACES[:2]).tolist() == [2, 2]
