"""Noise along the normals, on surfaces where it is known how much there is and where the points belong."""

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets import PointCloud, add_noise, add_outliers, prepare_cloud, sample_sphere, sample_surface
from mplicits.datasets.clouds.cleaning import noise
from mplicits.datasets.clouds.cleaning.noise import noise_deviation, noise_level, smooth_along_normals
from mplicits.neural_fields import Box, Torus
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.train import FitConfig, fit

RNG = np.random.default_rng(0)


def sphere(count: int, *, radius: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """Points ``(N, 3)`` of a sphere, exact in float64, and their normals."""
    normals = RNG.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


def plate(count: int, *, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """The two sides of a square plate, without its edges; the upper one first."""
    points = RNG.uniform(-0.7, 0.7, (count, 3))
    side = np.where(np.arange(count) < count // 2, 1.0, -1.0)
    points[:, 2] = side * thickness / 2
    return points, side[:, None] * np.array([0.0, 0.0, 1.0])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


@pytest.mark.parametrize("radius", [0.7, 0.05])
def test_on_a_sphere_there_is_no_noise_and_nothing_moves(radius):
    """(n_i + n_j)·(p_j − p_i) is zero on any sphere, however few points it has."""
    points, normals = sphere(3000, radius=radius)
    assert noise_level(points, normals) == 0
    assert np.abs(smooth_along_normals(points, normals, 0.02 * radius) - points).max() < 16 * unit_roundoff(
        torch.float64
    )


def test_the_sides_of_a_plate_thinner_than_its_spacing_are_no_noise():
    points, normals = plate(4000, thickness=0.005)
    assert noise_level(points, normals) == 0


@pytest.mark.parametrize(("count", "amplitude"), [(8000, 0.02), (8000, 0.04), (60000, 0.02)])
def test_the_level_is_measured(count, amplitude):
    """Uniform noise of ±a has the standard deviation a/√3; within 20 %, for the layer is never seen as a whole."""
    points, normals = sphere(count)
    noisy = points + RNG.uniform(-amplitude, amplitude, (count, 1)) * normals
    assert noise_level(noisy, normals) == pytest.approx(amplitude / np.sqrt(3), rel=0.2)


@pytest.mark.slow
def test_points_at_the_rim_of_a_layer_come_back_as_far_as_those_in_its_middle():
    """The level of a plane is above 0.75 σ, so that a point at z = 3 σ looks through more than 3 σ: down to the middle.

    What is above the middle has the mean 0.8 σ; there the first round leaves the point, and the second, which looks
    through 2.25 σ at points that hardly have heights any more, leaves it where they are. Through 3 and then 2 levels
    it would see what is above 0.7 σ only, be left there or higher, and not come down.
    """
    sigma, count = 0.02, 30000
    heights = RNG.normal(0, sigma, count)
    points = np.column_stack((RNG.uniform(-0.7, 0.7, (count, 2)), heights))
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    level = noise_level(points, normals)
    assert 0.75 * sigma < level <= sigma
    left = smooth_along_normals(points, normals, level)[:, 2]
    inner = np.abs(points[:, :2]).max(axis=1) < 0.7 - 2 * 3 * sigma  # what is voted on, and what votes, is whole
    rim = inner & (np.abs(heights) > 2.8 * sigma) & (np.abs(heights) < 3.2 * sigma)
    assert rms(left[rim]) < 2 * rms(left[inner])


def along_normals(points: np.ndarray, normals: np.ndarray, sigma: float) -> np.ndarray:
    return RNG.normal(0, sigma, (len(points), 1)) * normals


def in_all_directions(points: np.ndarray, normals: np.ndarray, sigma: float) -> np.ndarray:
    return RNG.normal(0, sigma, points.shape)


def along_rays(points: np.ndarray, normals: np.ndarray, sigma: float) -> np.ndarray:
    """From a sensor so far away that rays are parallel, as strong along the normals everywhere."""
    ray = np.array([1.0, 0.0, 0.0])
    return RNG.normal(0, sigma, (len(points), 1)) / np.abs(normals @ ray)[:, None] * ray


@pytest.mark.parametrize("sigma", [0.006, 0.0075])
def test_noise_narrower_than_the_spacing_is_told_from_a_shape(sigma):
    """Neighbours in waves 2 σ high, 2π spacings long, are as high as in noise; only there are further ones higher."""
    count = 8000
    spacing = 1.4 / np.sqrt(count)
    points = np.column_stack((RNG.uniform(-0.7, 0.7, (count, 2)), np.zeros(count)))
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    assert sigma < spacing / 2
    noisy = points + RNG.normal(0, sigma, (count, 1)) * normals
    assert 0.65 * sigma < noise_level(noisy, normals) <= sigma  # up to a third less, as on any plane
    waves = points + 2 * sigma * np.sin(points[:, :1] / spacing) * normals
    assert noise_level(waves, normals) == 0


@pytest.mark.parametrize("noise", [along_normals, in_all_directions, along_rays])
@pytest.mark.parametrize(("count", "sigma"), [(8000, 0.0115), (60000, 0.03)])
def test_the_deviation_is_that_along_the_normals_whatever_the_direction(noise, count, sigma):
    """Neighbourhoods of 16 are at most 8 σ in radius: wider ones, halved once less, would have been thin enough.

    At least area/(π 64 σ²) of them are independent. Each variance is off by √(2/15), their median's standard error is
    1.25 of the mean's, and the deviation is off by half of that.
    """
    points, normals = sphere(count)
    seen = normals[:, 0] > 0.5 if noise is along_rays else np.ones(count, bool)  # rays that graze move too far
    points, normals = points[seen], normals[seen]
    area = 4 * np.pi * 0.7**2 * (0.25 if noise is along_rays else 1.0)
    error = 0.5 * 1.25 * np.sqrt(2 / 15) / np.sqrt(area / (64 * np.pi * sigma**2))
    found = noise_deviation(points + noise(points, normals, sigma), normals)
    assert abs(found / sigma - 1) < 4 * error


def test_the_deviation_of_what_is_thin_is_zero():
    assert noise_deviation(*sphere(3000)) == 0
    assert noise_deviation(*plate(4000, thickness=0.005)) == 0


@pytest.mark.parametrize(("count", "gain"), [(8000, 5), pytest.param(60000, 7, marks=pytest.mark.slow)])
def test_points_come_back_to_the_sphere(count, gain):
    points, normals = sphere(count)
    noisy = points + RNG.uniform(-0.02, 0.02, (count, 1)) * normals
    moved = smooth_along_normals(noisy, normals, noise_level(noisy, normals))
    error = np.linalg.norm(moved, axis=1) - 0.7
    assert rms(error) < 0.02 / np.sqrt(3) / gain
    assert abs(error.mean()) < 5e-4  # it does not shrink
    assert np.abs(np.cross(moved - noisy, normals)).max() < 1e-12  # nor does anything slide


@pytest.mark.slow
def test_the_sides_of_a_plate_thinner_than_the_noise_stay_apart():
    """Half of the points have crossed over to the other side; their normals bring them back."""
    points, normals = plate(30000, thickness=0.01)
    noisy = points + RNG.uniform(-0.02, 0.02, (30000, 1)) * normals
    assert (noisy[:15000, 2] < 0).mean() > 0.3
    moved = smooth_along_normals(noisy, normals, noise_level(noisy, normals))
    assert rms(moved[:, 2] - points[:, 2]) < 0.0025
    assert (moved[:15000, 2] > 0).mean() > 0.99


def test_a_crease_stays_sharp():
    """Neighbours round the corner of a box are not asked: flat sides stay flat up to its edges."""
    box = Box(half_size=(0.5, 0.4, 0.3))
    cloud = sample_surface(box, 20000, shell=0.002)
    noisy = add_noise(cloud, 0.01)
    assert cloud.normals is not None
    normals = cloud.normals.astype(np.float64)
    moved = smooth_along_normals(noisy.points, normals, noise_level(noisy.points, normals))
    off = ((moved - cloud.points) * normals).sum(axis=1)
    corner = (0.5, 0.4, 0.3) - np.abs(cloud.points)
    by_an_edge = (np.sort(corner, axis=1)[:, 1] < 0.02) & (np.abs(normals).max(axis=1) > 0.999)
    assert by_an_edge.sum() > 500
    assert rms(off[by_an_edge]) < 1.5 * rms(off[~by_an_edge]) < 0.003


def test_it_does_not_depend_on_where_or_how_large_the_cloud_is():
    points, normals = sphere(4000)
    noisy = points + RNG.uniform(-0.03, 0.03, (4000, 1)) * normals
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    there, normals_there = 7 * noisy @ turn.T + 2, normals @ turn.T
    level = noise_level(noisy, normals)
    assert noise_level(there, normals_there) == pytest.approx(7 * level, rel=1e-9)
    moved = smooth_along_normals(noisy, normals, level)
    assert smooth_along_normals(there, normals_there, 7 * level) == pytest.approx(7 * moved @ turn.T + 2, abs=1e-9)


def test_a_few_points_are_left_alone():
    points, normals = sphere(12)
    assert noise_level(points, normals) == 0
    assert np.isfinite(smooth_along_normals(points, normals, 0.1)).all()


@pytest.mark.parametrize("strays", [0.0, 0.05])
def test_a_clean_cloud_is_prepared_as_without(strays):
    cloud = add_outliers(sample_surface(Torus(), 6000), strays)
    with_it, without = (prepare_cloud(cloud, smooth_noise=choice) for choice in (True, False))
    assert with_it.report.smoothed_noise == 0
    assert np.array_equal(with_it.points, without.points)


def test_flipped_normals_of_a_thin_part_are_no_noise():
    """Unless they are turned round, the far side passes for neighbours on a point's own side."""
    points, normals = plate(8000, thickness=0.02)
    flipped = RNG.permutation(8000)[:1600]
    normals[flipped] *= -1
    assert noise_level(points, normals) > 0
    cloud = PointCloud(points, normals.astype(np.float32))
    prepared = prepare_cloud(cloud, smooth_noise=True, turn_normals=True)
    assert prepared.report.smoothed_noise == 0
    assert prepared.report.turned_normals > 1000


@pytest.mark.parametrize("given", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_noisy_cloud_is_smoothed_and_says_so(given):
    clean = sample_sphere(8000)
    noisy = add_noise(clean, 0.01)
    cloud = PointCloud(noisy.points, noisy.normals if given else None)
    prepared = prepare_cloud(cloud, smooth_noise=True)
    diagonal = float(np.linalg.norm(np.ptp(clean.points, axis=0)))
    assert prepared.report.smoothed_noise == pytest.approx(0.01 * diagonal / np.sqrt(3), rel=0.2 if given else 0.5)
    assert "along the normals smoothed" in prepared.report.summary()
    radius = np.linalg.norm(prepared.similarity.to_input(prepared.points), axis=1)
    left = 0.01 * diagonal / np.sqrt(3) / (4 if given else 1.5)  # normals of noisy neighbourhoods are noisy too
    assert rms(radius - 0.5) < left


def test_beside_a_noisy_blade_is_outside():
    """What is left of noise at its edges must not decide about all that lies beyond them."""
    blade = sample_surface(Box(half_size=(0.7, 0.15, 0.01)), 12000, shell=0.002)
    prepared = prepare_cloud(add_noise(blade, 0.01), smooth_noise=True)
    points, normals = torch.from_numpy(prepared.points), torch.from_numpy(prepared.normals)
    distance = CloudDistance(points, normals, noise=prepared.noise)
    beyond = np.column_stack([RNG.uniform(-0.6, 0.6, 4000), RNG.uniform(0.18, 0.25, 4000), np.zeros(4000)])
    query = torch.from_numpy(prepared.similarity.to_unit(beyond).astype(np.float32))
    assert (distance.signed(query) < 0).float().mean() == 0
    inside = np.column_stack([RNG.uniform(-0.6, 0.6, 4000), RNG.uniform(-0.1, 0.1, 4000), np.zeros(4000)])
    query = torch.from_numpy(prepared.similarity.to_unit(inside).astype(np.float32))
    assert (distance.signed(query) < 0).float().mean() > 0.97


def test_distances_weigh_no_more_than_the_noise_allows():
    config = FitConfig(residual_data_weight=2.0)
    assert config.data_weight_after(1e-4, 0.0) == pytest.approx(2e4)
    assert config.data_weight_after(1e-6, 0.0) == pytest.approx(2e6)
    assert config.data_weight_after(1e-6, 0.01) == pytest.approx(2e4)


@pytest.mark.slow
def test_the_fit_of_a_noisy_cloud_says_what_was_smoothed_and_can_leave_it():
    noisy = add_noise(sample_sphere(6000), 0.02)
    small = {"widths": (16,), "depths": (2,), "omegas": (30.0,), "steps": (2,), "learning_rates": (1e-3,)}
    small |= {"samples": 2000, "batch": 256}
    smoothed = fit(noisy, FitConfig(**small)).record["cleaning"]["smoothed_noise"]
    assert smoothed == pytest.approx(0.02, rel=0.25)  # ± 0.02 diagonals of √3
    assert fit(noisy, FitConfig(**small, smooth_noise=False)).record["cleaning"]["smoothed_noise"] == 0


@pytest.mark.parametrize(("estimated", "dense"), [(True, False), (False, False), (True, True)])
def test_less_noise_is_smoothed_off_where_it_is_in_the_normals_too(estimated, dense, monkeypatch):
    """A fifth of the spacing: the network's own business if normals are exact, but estimated ones are tilted by it."""
    count, radius = 8000, 0.7
    monkeypatch.setattr(noise, "NOISE", noise.NoiseOptions(dense=count + (not dense)))
    points, normals = sphere(count, radius=radius)
    sigma = np.sqrt(4 * np.pi * radius**2 / count) / 5
    cloud = PointCloud(points + RNG.normal(0, sigma, points.shape), normals.astype(np.float32), None, "ball")
    prepared = prepare_cloud(cloud, normals="estimate" if estimated else "file", smooth_noise=True)
    left = np.linalg.norm(prepared.similarity.to_input(prepared.points.astype(np.float64)), axis=1) - radius
    if estimated and not dense:
        assert prepared.report.noise_deviation == pytest.approx(sigma, rel=0.1)
        assert rms(left) < 0.5 * sigma
    else:
        assert prepared.report.noise_deviation == 0
        assert rms(left) == pytest.approx(sigma, rel=0.05)  # one in √(2 · 8000)
