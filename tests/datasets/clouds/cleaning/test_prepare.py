"""``prepare_cloud``: what is dropped, repaired, estimated and turned round."""

import numpy as np
import pytest
from mplicits.datasets import (
    PointCloud,
    add_noise,
    prepare_cloud,
    sample_sphere,
    sample_surface,
    sample_torus,
)
from mplicits.neural_fields import Box, InputError, Similarity, Sphere, Torus


def agreement(prepared, normals):
    cosines = (prepared.normals * normals).sum(axis=1)
    return float((cosines > 0).mean()), float(cosines.mean())


def test_nan_and_duplicates_are_dropped_and_counted():
    torus = sample_torus(1000)
    points = np.concatenate((torus.points, torus.points[:7], np.full((3, 3), np.nan), [[np.inf, 0, 0]]))
    normals = np.concatenate((torus.normals, -torus.normals[:7], np.zeros((4, 3))))
    colors = np.linspace(0, 1, 3 * len(points)).reshape(-1, 3)
    cloud = prepare_cloud(PointCloud(points, normals, colors))
    assert len(cloud) == cloud.report.kept == 1000
    assert (cloud.report.read, cloud.report.dropped_nan, cloud.report.dropped_duplicates) == (1011, 4, 7)
    assert np.abs(cloud.normals - torus.normals).max() < 1e-6  # the first of equal points stays
    assert np.array_equal(cloud.colors, colors[:1000].astype(np.float32))
    assert "dropped 4 not finite, 7 duplicate" in cloud.report.summary()


def test_map_coordinates_keep_their_digits():
    """UTM metres with tenths of millimetres: shifted in float64 before they are rounded."""
    torus = sample_torus(500)
    placed = Similarity((431234.5678, 5412345.6789, 250.0), 0.35).to_input(torus.points)
    cloud = prepare_cloud(PointCloud(placed, torus.normals))
    assert cloud.points.dtype == np.float32
    assert np.linalg.norm(cloud.points, axis=1).max() <= 1 + 1e-6
    assert np.abs(cloud.similarity.to_input(cloud.points) - placed).max() < 1e-7


def test_normals_are_normalised_and_repaired():
    torus = sample_torus(4000)
    normals = torus.normals * np.random.default_rng(0).uniform(0.1, 9, (4000, 1)).astype(np.float32)
    normals[::10] = 0
    normals[5::100] = np.nan
    cloud = prepare_cloud(PointCloud(torus.points, normals))
    assert cloud.report.repaired_normals == 440
    assert np.abs(np.linalg.norm(cloud.normals, axis=1) - 1).max() < 1e-6
    assert (cloud.normals * torus.normals).sum(axis=1).min() > 0.98


def test_undecidable_normals_are_dropped():
    """Between two coincident sheets with opposite normals, no neighbourhood has a majority."""
    side = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=-1).reshape(-1, 2)
    sheets = np.concatenate([np.column_stack((side, np.full(400, z))) for z in (0.0, 0.01)])
    normals = np.repeat([[0.0, 0, -1], [0, 0, 1]], 400, axis=0)
    points = np.concatenate((sheets, [[9.5, 9.5, 0.005]]))
    cloud = prepare_cloud(PointCloud(points, np.concatenate((normals, [[0.0, 0, 0]]))), normals="file")
    assert cloud.report.dropped_normals == 1
    assert len(cloud) == 800


@pytest.mark.parametrize(("shape", "least"), [("sphere", 1.0), ("torus", 1.0), ("box", 0.999)])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_estimated_normals_agree_with_exact_ones(shape, least, noise):
    field = {"sphere": Sphere(), "torus": Torus(), "box": Box(half_size=(0.5, 0.3, 0.2))}[shape]
    exact = sample_surface(field, 6000)
    cloud = prepare_cloud(PointCloud(add_noise(exact, noise).points))
    assert cloud.report.normals_source == "estimated"
    right, cosine = agreement(cloud, exact.normals)
    assert right >= least
    assert cosine > 0.95


def test_separate_pieces_are_each_turned_outward():
    spheres = [sample_sphere(1500, radius=0.2, seed=i) for i in range(3)]
    points = np.concatenate([s.points + np.array((i, 0, 0)) for i, s in enumerate(spheres)])
    cloud = prepare_cloud(PointCloud(points))
    assert cloud.report.pieces == 3
    assert "3 separate pieces" in cloud.report.summary()
    assert agreement(cloud, np.concatenate([s.normals for s in spheres]))[0] == 1.0


def test_sensor_origin_orients():
    """Seen from within, a room's walls face inward."""
    exact = sample_sphere(3000)
    cloud = prepare_cloud(PointCloud(exact.points * 10 + (100.0, 50.0, 0.0)), sensor_origin=(100.0, 51.0, 0.0))
    assert agreement(cloud, -exact.normals)[0] == 1.0


@pytest.mark.parametrize("shape", [sample_sphere, sample_torus])
def test_inward_files_are_turned_round_only_by_auto(shape):
    exact = shape(3000)
    inward = PointCloud(exact.points, -exact.normals)
    for normals, flipped, right in (("auto", True, exact.normals), ("file", False, -exact.normals)):
        cloud = prepare_cloud(inward, normals=normals)
        assert cloud.report.flipped == ("flipped" in cloud.report.summary()) == flipped
        assert agreement(cloud, right)[0] == 1.0


def test_open_scan_of_a_hollow_is_not_turned_round():
    """A bowl seen from above has normals that face its middle: no evidence that they are wrong."""
    sphere = sample_sphere(6000)
    low = sphere.points[:, 2] < -0.2
    assert not prepare_cloud(PointCloud(sphere.points[low], -sphere.normals[low])).report.flipped


def test_auto_estimates_when_most_normals_are_unusable():
    exact = sample_torus(2000)
    normals = exact.normals.copy()
    normals[:1100] = 0  # as in files of Gaussian splats
    assert prepare_cloud(PointCloud(exact.points, normals)).report.normals_source == "estimated"
    cloud = prepare_cloud(PointCloud(exact.points, normals), normals="file")
    assert (cloud.report.normals_source, cloud.report.repaired_normals) == ("file", 1100 - cloud.report.dropped_normals)


@pytest.mark.parametrize(
    ("points", "options", "error", "what"),
    [
        (100, {"normals": "file"}, InputError, "torus: normals"),
        (9, {}, InputError, "points: only 9 of 100"),
        (100, {"normals": "none"}, ValueError, "normals='none'"),
        (100, {"neighbors": 2}, ValueError, "neighbors=2"),
        (100, {"isolation": 0.5}, ValueError, "isolation=0.5"),
        (100, {"sensor_origin": (0.0, 0.0, np.nan)}, InputError, "sensor_origin"),
    ],
)
def test_errors(points, options, error, what):
    places = np.where(np.arange(100)[:, None] < points, sample_torus(100).points, np.nan)
    with pytest.raises(error, match=what):
        prepare_cloud(PointCloud(places, source="torus"), **options)


def test_isolated_points_are_dropped_before_the_scale_is_set():
    cloud = sample_sphere(2000, radius=2.0)
    points, normals = np.vstack((cloud.points, [40.0, 0, 0])), np.vstack((cloud.normals, [1.0, 0, 0]))
    prepared = prepare_cloud(PointCloud(points, normals))
    assert prepared.report.dropped_isolated == 1
    assert "1 isolated" in prepared.report.summary()
    assert prepared.similarity.scale == pytest.approx(2.0, rel=0.01)
    assert len(prepare_cloud(PointCloud(points, normals), isolation=None)) == 2001


@pytest.mark.slow
def test_points_that_smoothing_took_to_the_wrong_place_are_dropped():
    """Smoothing a plate as thick as three deviations moves some points of one side to the other."""
    half = np.array([0.6, 0.5, 0.03])
    plate = sample_surface(Box(half_size=tuple(half)), 5000, shell=0.001, seed=1)
    noisy = plate.points + np.random.default_rng(2).normal(0, 0.02, (5000, 3))
    colors = np.random.default_rng(3).uniform(size=(5000, 3)).astype(np.float32)
    every, sound = (
        prepare_cloud(PointCloud(noisy, None, colors), smooth_noise=True, isolation=None, drop_outliers=drop)
        for drop in (False, True)
    )
    assert every.noise > 0

    def off(points):
        offset = np.abs(every.similarity.to_input(points)) - half
        return np.abs(np.linalg.norm(offset.clip(min=0), axis=1) + offset.max(axis=1).clip(max=0))

    row = {tuple(color): index for index, color in enumerate(every.colors)}  # colours tell which points are left
    left = np.array([row[tuple(color)] for color in sound.colors])
    gone = np.setdiff1d(np.arange(len(every)), left)
    assert len(gone) == sound.report.dropped_outliers > 0
    assert np.square(off(every.points[gone])).mean() > 2 * np.square(off(every.points[left])).mean()


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_points_are_set_apart_with_their_noise(noise):
    clean = sample_sphere(6000)
    cloud = add_noise(clean, noise, isotropic=True)
    rank = np.arange(6000)  # of each point, as its colour
    colors = np.stack((rank / 6000, np.zeros(6000), np.zeros(6000)), axis=1).astype(np.float32)
    prepared = prepare_cloud(PointCloud(cloud.points, None, colors), smooth_noise=True, noisy=300)
    if not noise:
        assert prepared.noisy is None
        return
    assert prepared.noisy is not None
    assert prepared.colors is not None
    given = prepared.similarity.to_unit(cloud.points).astype(np.float32)
    places = {tuple(place): index for index, place in enumerate(given.tolist())}
    apart = {places[tuple(place)] for place in prepared.noisy.tolist()}  # each is a point of the file, not moved
    others = set(np.round(prepared.colors[:, 0] * 6000).astype(int).tolist())
    assert (len(apart), len(others)) == (300, 5700)
    assert not apart & others
