"""Normals of a file are kept where they are better than planes through the points, and replaced where not."""

import numpy as np
import pytest
from mplicits.datasets import PointCloud, add_noise, prepare_cloud, sample_sphere, sample_surface
from mplicits.datasets.clouds.cleaning.judging import layer_level, worse_normals
from mplicits.neural_fields import Box, Torus


def jittered(normals: np.ndarray, tilt: float) -> np.ndarray:
    """Unit normals off by ``tilt`` radians along each axis across them, in the standard deviation."""
    shift = np.random.default_rng(11).normal(0, tilt, normals.shape)
    moved = normals + shift - (shift * normals).sum(axis=1, keepdims=True) * normals  # less than a right angle off
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def mean_square_angle(normals: np.ndarray, exact: np.ndarray) -> float:
    """In radians²."""
    return float((np.arccos(np.einsum("nd,nd->n", normals, exact).clip(-1, 1)) ** 2).mean())


def sphere(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    points = sample_sphere(count).points
    return points, 2 * points


def test_exact_normals_of_a_sphere_are_not_worse_with_or_without_noise():
    points, exact = sphere()
    assert not worse_normals(points, exact, 0.0).any()
    noisy = points + np.random.default_rng(3).normal(0, 0.01, points.shape)
    assert not worse_normals(noisy, exact, layer_level(noisy, exact)).any()


@pytest.mark.parametrize("shape", [Torus(), Box(half_size=(0.5, 0.4, 0.3))])
def test_exact_normals_of_what_bends_or_has_edges_are_kept_as_they_are(shape):
    cloud = sample_surface(shape, 4000, shell=0.002)
    prepared = prepare_cloud(cloud, smooth_noise=True)
    assert prepared.report.reestimated_normals == 0
    assert cloud.normals is not None
    assert np.abs(prepared.normals - cloud.normals).max() < 1e-6


def test_noise_of_normals_is_no_noise_of_points():
    points, exact = sphere()
    assert layer_level(points, jittered(exact, 0.6)) == 0


@pytest.mark.parametrize("tilt", [0.15, 0.3])
def test_normals_worse_than_the_points_are_replaced_and_keep_their_signs(tilt):
    """Planes through 16 points of a clean sphere: off by its curvature alone, far less than the normals were."""
    points, exact = sphere()
    noisy = jittered(exact, tilt)
    cloud = PointCloud(points, noisy.astype(np.float32))
    kept = prepare_cloud(cloud, normals="file", smooth_noise=True)
    assert kept.report.reestimated_normals == 0
    assert np.abs(kept.normals - noisy).max() < 1e-6
    mended = prepare_cloud(cloud, smooth_noise=True)
    assert mended.report.reestimated_normals > 2000
    assert "normals disagreed with the points and were estimated again" in mended.report.summary()
    assert mended.report.smoothed_noise == 0
    assert ((mended.normals * exact).sum(axis=1) > 0).all()
    assert mean_square_angle(mended.normals, exact) < mean_square_angle(noisy, exact) / 4


def test_noise_of_the_papers_kind_leaves_clean_normals_alone():
    cloud = add_noise(sample_sphere(6000), 0.01)
    prepared = prepare_cloud(cloud, smooth_noise=True)
    assert prepared.report.reestimated_normals == 0
    assert cloud.normals is not None
    assert np.abs(prepared.normals - cloud.normals).max() < 1e-6
    # Uniform noise of ± a has the deviation a/√3; five standard errors of the median of 6000/16 variances.
    sigma = 0.01 * np.linalg.norm(np.ptp(sample_sphere(6000).points, axis=0)) / np.sqrt(3)
    assert abs(prepared.report.noise_deviation / sigma - 1) < 5 * 0.5 * 1.25 * np.sqrt(2 / 15) / np.sqrt(6000 / 64)


def test_normals_and_points_that_are_both_noisy_are_mended_together():
    points, exact = sphere(4000)
    noisy = points + np.random.default_rng(5).normal(0, 0.02, points.shape)  # 1.4 spacings
    tilted = jittered(exact, 0.4)
    prepared = prepare_cloud(PointCloud(noisy, tilted.astype(np.float32)), smooth_noise=True)
    assert prepared.report.reestimated_normals == 4000
    assert mean_square_angle(prepared.normals, exact) < mean_square_angle(tilted, exact) / 4


def test_a_few_points_have_no_judge():
    points, exact = sphere(40)
    assert not worse_normals(points, jittered(exact, 0.5), 0.0).any()
