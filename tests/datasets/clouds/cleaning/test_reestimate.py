"""Normals fitted again: exact where they must not change, better where noise made them bad, edges kept."""

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets import PointCloud, prepare_cloud, sample_sphere, sample_surface
from mplicits.datasets.clouds.cleaning.reestimate import (
    denoise,
    filter_normals,
    has_edges,
    refit_normals,
    sharper_normals,
)
from mplicits.neural_fields import Box

RNG = np.random.default_rng(0)
DOUBLE = 64 * unit_roundoff(torch.float64)


def angles(normals: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """In degrees ``(N,)``."""
    return np.degrees(np.arccos(np.einsum("nd,nd->n", normals, exact).clip(-1, 1)))


def test_a_plane_keeps_its_normal_and_its_sign():
    points = np.column_stack((RNG.uniform(-1, 1, (500, 2)), np.zeros(500)))
    down = np.tile([0.0, 0.0, -1.0], (500, 1))
    tilted = down + RNG.normal(0, 0.1, (500, 3))
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    # Eigenvectors are as exact as rounding beside the gap between eigenvalues, which is the size of the largest.
    assert np.abs(refit_normals(points, tilted, 0.3) - down).max() < 100 * DOUBLE


def test_the_sides_of_a_thin_plate_do_not_see_each_other():
    """Neighbourhoods are twenty times as wide as the plate is thick."""
    points = RNG.uniform(-1, 1, (4000, 3))
    side = np.where(np.arange(4000) < 2000, 1.0, -1.0)
    points[:, 2] = 0.01 * side
    exact = side[:, None] * np.array([0.0, 0.0, 1.0])
    assert np.abs(refit_normals(points, exact, 0.2) - exact).max() < 100 * DOUBLE


def test_an_edge_stays_sharp():
    """Sides at a right angle weigh nothing in each other's planes, once normals tell them apart."""
    cloud = sample_surface(Box(half_size=(0.5, 0.4, 0.3)), 8000, shell=0.002)
    assert cloud.normals is not None
    exact = cloud.normals.astype(np.float64)
    flat = np.abs(exact).max(axis=1) > 1 - 1e-6
    assert flat.mean() > 0.95
    noisy = exact + RNG.normal(0, 0.05, exact.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    after = angles(refit_normals(cloud.points, noisy, 0.08), exact)[flat]
    # 1e-3 of the points' exactness over a neighbourhood of 0.05 is a degree.
    assert np.quantile(after, 0.9) < 1


def test_only_as_alike_normals_as_are_asked_for_count():
    """Two planes at sixty degrees: cosine ½ counts when 0.3 is asked for, and not when 0.6 is."""
    flat = np.column_stack((RNG.uniform(-1, 1, 4000), RNG.uniform(0, 1, 4000), np.zeros(4000)))
    cosine, sine = 0.5, 0.75**0.5
    turn = np.array([[1, 0, 0], [0, -cosine, sine], [0, sine, cosine]])  # y to the other side, and up by sixty degrees
    points = np.concatenate((flat[:2000], flat[2000:] @ turn.T))
    exact = np.repeat([[0.0, 0.0, 1.0], [0.0, sine, cosine]], 2000, axis=0)
    loose, strict = (refit_normals(points, exact, 0.2, alike=alike) for alike in (0.3, 0.6))
    assert np.abs(strict - exact).max() < 100 * DOUBLE
    assert angles(loose, exact).max() > 5


def box_with_normals(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a box, the exact normals of their faces, and these turned by five degrees or so."""
    half = np.array([0.6, 0.5, 0.4])
    axis = RNG.choice(3, count, p=np.roll(half, 1) * np.roll(half, 2) / (half * np.roll(half, 1)).sum())
    side = RNG.choice([-1.0, 1.0], count)
    points = RNG.uniform(-1, 1, (count, 3)) * half
    points[np.arange(count), axis] = side * half[axis]
    exact = np.zeros((count, 3))
    exact[np.arange(count), axis] = side
    noisy = exact + RNG.normal(0, 0.06, exact.shape)
    return points, exact, noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


def test_filtered_normals_are_means_over_a_face():
    """A filter of 32 neighbours has the weight of 32/3 equal ones, and three passes less noise than one: below a third.

    Across an edge a normal counts exp(−1/0.04) = 1e-11 of its own side's.
    """
    points, exact, noisy = box_with_normals(6000)
    before, after = angles(noisy, exact), angles(filter_normals(points, noisy), exact)
    assert np.median(after) < np.median(before) / 3
    assert after.max() < before.max()
    assert np.abs(filter_normals(points, exact) - exact).max() < 1e-9


def test_a_box_has_edges_and_a_sphere_has_none():
    points, _, noisy = box_with_normals(6000)
    assert has_edges(points, filter_normals(points, noisy))
    sphere = sample_sphere(6000)
    assert not has_edges(sphere.points, 2 * sphere.points)
    assert not has_edges(sphere.points, filter_normals(sphere.points, 2 * sphere.points))


@pytest.mark.slow
def test_noise_on_a_box_comes_off_and_leaves_its_edges():
    """Points near edges end up on their faces: in the mean of squares there is less left than without filtered normals.

    Less than a third of the noise's deviation is left, all edges and corners among it.
    """
    points, exact, first = box_with_normals(8000)
    sigma = 0.015
    moved, normals, level = denoise(points + RNG.normal(0, sigma, points.shape), first)
    assert 0.5 * sigma < level < 1.5 * sigma
    half = np.array([0.6, 0.5, 0.4])
    outside = np.linalg.norm((np.abs(moved) - half).clip(min=0), axis=1)
    off = np.where(outside > 0, outside, (half - np.abs(moved)).min(axis=1))
    assert np.sqrt(np.square(off).mean()) < sigma / 3
    assert np.median(angles(normals, exact)) < 2


@pytest.mark.slow
def test_noise_equal_in_all_directions_is_taken_off_points_and_normals():
    sphere = sample_sphere(12000)
    exact, sigma = 2 * sphere.points, 0.01
    noisy = sphere.points + RNG.normal(0, sigma, (12000, 3))
    first = exact + RNG.normal(0, 0.2, exact.shape)  # eleven degrees off along each axis
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    moved, normals, level = denoise(noisy, first)
    assert level == pytest.approx(sigma, rel=0.3)
    assert np.median(angles(normals, exact)) < np.median(angles(first, exact)) / 2
    left = np.linalg.norm(moved, axis=1) - 0.5
    assert np.sqrt((left**2).mean()) < 0.4 * sigma


def test_without_noise_nothing_changes():
    sphere = sample_sphere(3000)
    exact = 2 * sphere.points
    moved, normals, level = denoise(sphere.points, exact)
    assert level == 0
    assert moved is sphere.points
    assert normals is exact


def test_normals_of_a_clean_box_and_a_thin_bar_lose_what_other_sides_gave_them():
    """Planes through all neighbours round edges; like neighbours of a face lie in it, and leave its exact normal.

    Signs are the exact ones: here is asked for directions. A face of the bar is four spacings wide.
    """
    for half in (np.array([0.6, 0.5, 0.4]), np.array([0.8, 0.05, 0.05])):
        points, exact, _ = box_with_normals(6000)
        points *= half / (0.6, 0.5, 0.4)
        estimated = prepare_cloud(PointCloud(points), normals="estimate", isolation=None).normals.astype(np.float64)
        signed = np.where((estimated * exact).sum(axis=1, keepdims=True) < 0, -estimated, estimated)
        before, after = angles(signed, exact), angles(sharper_normals(points, signed), exact)
        assert (before > 5).mean() > 0.1
        assert (after > 5).mean() < (before > 5).mean() / 2


def test_normals_of_slightly_noisy_points_stay():
    """A tenth of the spacing: too little to be smoothed, and fewer points make worse planes."""
    sphere = sample_sphere(6000)
    noisy = PointCloud(sphere.points + RNG.normal(0, 0.0015, (6000, 3)))
    left, given = (prepare_cloud(noisy, smooth_noise=choice) for choice in (False, True))
    assert given.noise == 0
    assert (left.normals == given.normals).all()


@pytest.mark.slow
def test_estimated_normals_are_fitted_again_where_noise_is_smoothed():
    sphere = sample_sphere(8000)
    cloud = PointCloud(sphere.points + RNG.normal(0, 0.008, (8000, 3)))
    exact = 2 * sphere.points
    left, smoothed = (prepare_cloud(cloud, smooth_noise=choice) for choice in (False, True))
    assert np.median(angles(smoothed.normals, exact)) < 0.7 * np.median(angles(left.normals, exact))
