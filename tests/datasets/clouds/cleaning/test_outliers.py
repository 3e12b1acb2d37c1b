"""Strays and flipped normals, on surfaces where it is known which they are."""

import numpy as np
import pytest
import torch
from mplicits import datasets
from mplicits.datasets import PointCloud, prepare_cloud, sample_sphere, sample_surface, sample_torus
from mplicits.datasets.clouds.cleaning.outliers import agreement, inspect_points
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.neural_fields import Box, Torus


def normals_of(cloud: PointCloud) -> np.ndarray:
    return cloud.normals.astype(np.float64)


def inspected(cloud: PointCloud, **settings):
    return inspect_points(cloud.points, normals_of(cloud), **settings)


def ball_on_sparse_ground() -> PointCloud:
    """A dense half ball, and around it ground that is six times as sparse: its nearest points see little else."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.arange(-1, 1, 0.06)] * 2)
    ground = np.c_[x.ravel(), y.ravel()] + random.uniform(-0.015, 0.015, (x.size, 2))
    ground = np.c_[ground, np.zeros(len(ground))][np.linalg.norm(ground, axis=1) > 0.4]
    ball = sample_sphere(12_000, radius=0.4)
    upper = ball.points[:, 2] > 0
    normals = np.concatenate([np.tile([0, 0, 1], (len(ground), 1)), normals_of(ball)[upper]]).astype(np.float32)
    return PointCloud(np.concatenate([ground, ball.points[upper]]), normals, source="ground")


CLEAN = {
    "ball on sparse ground": ball_on_sparse_ground,
    "sphere": lambda: sample_sphere(6000),
    "torus": lambda: sample_torus(8000),
    "thin box": lambda: sample_surface(Box(half_size=(0.7, 0.5, 0.01)), 8000, shell=0.002),
    "box thinner than its points are spaced": lambda: sample_surface(
        Box(half_size=(0.7, 0.5, 0.005)), 2000, shell=0.002
    ),
    "noisy sphere": lambda: datasets.add_noise(sample_sphere(6000), 0.01),
}


@pytest.mark.parametrize("shape", CLEAN)
def test_a_clean_cloud_loses_nothing(shape):
    found = inspected(CLEAN[shape](), isolation=30.0)
    assert not found.isolated.any()
    assert not found.outliers.any()
    # Thinner than the points are spaced, a box's two sides are told apart by hardly anything.
    assert found.flipped.mean() <= (0.03 if "thinner" in shape else 0)


def test_the_sparse_part_of_a_thin_plate_is_kept_without_normals():
    """Its points are as far from each other as its two sides, so that no plane fits them."""
    plate = sample_surface(Box(half_size=(0.7, 0.5, 0.02)), 60_000, shell=0.001).points
    points = plate[(np.abs(plate[:, 0]) > 0.65) | (np.random.default_rng(0).random(60_000) < 0.04)]
    found = inspect_points(points, None, isolation=30.0)
    assert not found.isolated.any()
    assert not found.outliers.any()


@pytest.mark.parametrize("fraction", [0.001, 0.01, 0.05])
@pytest.mark.parametrize("given", [True, False])
def test_strays_are_found_but_for_those_that_touch_the_surface(fraction, given):
    clean = sample_sphere(8000)
    cloud = datasets.add_outliers(clean, fraction, seed=3)
    found = inspect_points(cloud.points, normals_of(cloud) if given else None)
    assert not found.outliers[:8000].any()
    away = np.abs(np.linalg.norm(cloud.points[8000:], axis=1) - 0.5)
    assert found.outliers[8000:][away > 0.06].mean() > (0.96 if given else 0.9)
    assert found.outliers[8000:].mean() > (0.9 if given else 0.85)


def test_strays_around_a_thin_box():
    found = inspected(datasets.add_outliers(CLEAN["thin box"](), 0.05))
    assert not found.outliers[:8000].any()
    assert found.outliers[8000:].mean() > 0.95


def test_a_point_beside_a_plane_and_one_with_another_normal():
    side = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2)
    points = np.column_stack((side, np.zeros(400)))
    points = np.concatenate((points, [[9.4, 9.6, 1.5], [5.5, 5.5, 0.0]]))
    normals = np.tile([0.0, 0, 1], (402, 1))
    normals[401] = [1, 0, 0]
    assert np.flatnonzero(inspect_points(points, normals).outliers).tolist() == [400, 401]


def test_small_clusters_apart_are_dropped_unless_they_hold_together():
    sphere = sample_sphere(20_000)
    random = np.random.default_rng(0)
    clump = random.normal(size=(15, 3)) * 0.004 + [0.9, 0, 0]
    spray = random.normal(size=(15, 3))
    ball = sample_sphere(15, radius=0.01, seed=5)
    points = np.concatenate((sphere.points, clump, ball.points - [0.9, 0, 0]))
    found = inspect_points(points, np.concatenate((normals_of(sphere), unit_rows(spray), normals_of(ball)))).outliers
    assert not found[:20_000].any()
    assert found[20_000:20_015].sum() >= 13
    assert not found[20_015:].any()


@pytest.mark.parametrize("fraction", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("shape", ["sphere", "torus", "thin box"])
def test_flipped_normals_are_found(shape, fraction):
    cloud = CLEAN[shape]()
    flipped = np.random.default_rng(1).random(len(cloud)) < fraction
    found = inspect_points(cloud.points, normals_of(cloud) * np.where(flipped, -1, 1)[:, None])
    assert found.outliers.mean() < 0.002
    assert found.flipped[flipped].mean() > (0.9 if fraction <= 0.1 else 0.7)
    assert (found.flipped & ~flipped).sum() <= 2


def test_two_sheets_in_one_place_are_left_alone():
    random = np.random.default_rng(0)
    points = np.column_stack((random.uniform(0, 1, (4000, 2)), np.zeros(4000)))
    normals = np.zeros((4000, 3))
    normals[:, 2] = np.where(np.arange(4000) % 2, 1.0, -1.0)
    found = inspect_points(points, normals)
    assert found.flipped.mean() < 0.05
    assert not found.outliers.any()


def test_a_sparser_part_is_not_isolated_but_a_stray_is():
    """Fifty times as sparse as the rest, on its own: with company, it stays."""
    dense, sparse = sample_sphere(60_000, radius=0.1), sample_sphere(600, radius=0.5)
    points = np.concatenate((dense.points, sparse.points + np.array([2.0, 0, 0]), [[0.0, 6.0, 0.0]]))
    normals = np.concatenate((normals_of(dense), normals_of(sparse), [[0.0, 0.6, 0.8]]))
    found = inspect_points(points, normals, isolation=30.0)
    assert np.flatnonzero(found.isolated).tolist() == [60_600]
    assert not found.outliers.any()


def test_prepared_clouds_count_what_was_done():
    cloud = datasets.add_outliers(sample_torus(8000), 0.02, seed=1)
    normals = normals_of(cloud).astype(np.float32)
    normals[:800] *= -1
    prepared = prepare_cloud(PointCloud(cloud.points, normals), drop_outliers=True, turn_normals=True)
    report = prepared.report
    assert report.dropped_isolated + report.dropped_outliers > 0.9 * 160
    assert 760 < report.turned_normals < 810
    for said in (f"{report.dropped_outliers} outliers", f"{report.turned_normals} normals turned round"):
        assert said in report.summary()
    places = prepared.similarity.to_input(prepared.points)
    assert prepared.similarity.scale == pytest.approx(np.linalg.norm([0.7, 0.0]), rel=0.01)  # that of the torus alone
    gradient = Torus(major=0.5, minor=0.2).jet(torch.from_numpy(places)).gradient.numpy()
    assert ((gradient * prepared.normals).sum(axis=1) > 0).mean() > 0.995
    kept = prepare_cloud(PointCloud(cloud.points, normals), normals="file", turn_normals=True, isolation=None)
    assert kept.report.turned_normals == kept.report.dropped_outliers == 0


@pytest.mark.parametrize("count", [4, 10, 30])
def test_tiny_clouds(count):
    """Fewer points than neighbours."""
    cloud = sample_sphere(count)
    for given in (cloud, PointCloud(cloud.points)):
        assert count < 10 or len(prepare_cloud(given, smooth_noise=True)) == count
    found = inspected(cloud, isolation=30.0)
    assert (found.outliers.any(), len(found.flipped)) == (False, count)
    assert count > 10 or (agreement(cloud.points, normals_of(cloud), np.arange(count))[0] == 1).all()
