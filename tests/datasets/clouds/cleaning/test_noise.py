"""Noise on surfaces where it is known; refitted normals: exact where they were, better where noise made them bad."""

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets import PointCloud, add_noise, add_outliers, prepare_cloud, sample_sphere, sample_surface
from mplicits.datasets.clouds.cleaning import noise
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.neural_fields import Box, Torus
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.training.settings import FitConfig

RNG = np.random.default_rng(0)
DOUBLE = unit_roundoff(torch.float64)
UP = np.array([0.0, 0.0, 1.0])


def sphere(count: int, *, radius: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    """Random points ``(N, 3)`` of a sphere, exact in float64, and their normals."""
    normals = unit_rows(RNG.normal(size=(count, 3)))
    return radius * normals, normals


def even_sphere(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spread points of a sphere of radius 0.5, and their normals."""
    points = sample_sphere(count).points
    return points, 2 * points


def plate(count: int, *, thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """The two sides of a square plate, without its edges; the upper one first."""
    points = RNG.uniform(-0.7, 0.7, (count, 3))
    side = np.where(np.arange(count) < count // 2, 1.0, -1.0)
    points[:, 2] = side * thickness / 2
    return points, side[:, None] * UP


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def angles(normals: np.ndarray, exact: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.einsum("nd,nd->n", normals, exact).clip(-1, 1)))


def mean_square(normals: np.ndarray, exact: np.ndarray) -> float:
    """Of the angles, in degrees²."""
    return float(np.square(angles(normals, exact)).mean())


def box_with_normals(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a box, the exact normals of their faces, and these turned by five degrees or so."""
    half = np.array([0.6, 0.5, 0.4])
    axis = RNG.choice(3, count, p=np.roll(half, 1) * np.roll(half, 2) / (half * np.roll(half, 1)).sum())
    side = RNG.choice([-1.0, 1.0], count)
    points = RNG.uniform(-1, 1, (count, 3)) * half
    points[np.arange(count), axis] = side * half[axis]
    exact = np.zeros((count, 3))
    exact[np.arange(count), axis] = side
    return points, exact, unit_rows(exact + RNG.normal(0, 0.06, exact.shape))


def jittered(normals: np.ndarray, tilt: float) -> np.ndarray:
    """Unit normals off by ``tilt`` radians (σ) along each axis across them: by less than a right angle."""
    shift = np.random.default_rng(11).normal(0, tilt, normals.shape)
    return unit_rows(normals + shift - (shift * normals).sum(axis=1, keepdims=True) * normals)


@pytest.mark.parametrize("radius", [0.7, 0.05])
def test_a_sphere_and_a_plate_thinner_than_its_spacing_have_no_noise(radius):
    """(n_i + n_j)·(p_j − p_i) is zero on any sphere, however few points it has."""
    for points, normals in (plate(4000, thickness=0.005), sphere(3000, radius=radius)):
        assert noise.noise_level(points, normals) == noise.noise_deviation(points, normals) == 0
    assert np.abs(noise.smooth_along_normals(points, normals, 0.02 * radius) - points).max() < 16 * DOUBLE
    few, normals = sphere(12)
    assert noise.noise_level(few, normals) == 0
    assert np.isfinite(noise.smooth_along_normals(few, normals, 0.1)).all()


@pytest.mark.parametrize(("count", "amplitude"), [(8000, 0.02), (8000, 0.04), (60000, 0.02)])
def test_the_level_is_measured(count, amplitude):
    """Uniform noise of ±a has the standard deviation a/√3; within 20 %, for the layer is never seen as a whole."""
    points, normals = sphere(count)
    noisy = points + RNG.uniform(-amplitude, amplitude, (count, 1)) * normals
    assert noise.noise_level(noisy, normals) == pytest.approx(amplitude / np.sqrt(3), rel=0.2)


@pytest.mark.slow
def test_points_at_the_rim_of_a_layer_come_back_as_far_as_those_in_its_middle():
    """With 3 levels instead of 4, points above 0.7 σ only would move one at z = 3 σ; with 4, all above the middle."""
    sigma, count = 0.02, 30000
    heights = RNG.normal(0, sigma, count)
    points = np.column_stack((RNG.uniform(-0.7, 0.7, (count, 2)), heights))
    normals = np.tile(UP, (count, 1))
    level = noise.noise_level(points, normals)
    assert 0.75 * sigma < level <= sigma
    left = noise.smooth_along_normals(points, normals, level)[:, 2]
    inner = np.abs(points[:, :2]).max(axis=1) < 0.7 - 2 * 3 * sigma  # points whose neighbours have all neighbours
    rim = inner & (np.abs(heights) > 2.8 * sigma) & (np.abs(heights) < 3.2 * sigma)
    assert rms(left[rim]) < 2 * rms(left[inner])


def with_noise(direction: str, points: np.ndarray, normals: np.ndarray, sigma: float) -> np.ndarray:
    """Points with noise of the standard deviation ``sigma`` along the normals, whatever its direction."""
    if direction == "all":
        return points + RNG.normal(0, sigma, points.shape)
    along = normals if direction == "normals" else np.array([1.0, 0.0, 0.0]) / np.abs(normals[:, :1])  # parallel rays
    return points + RNG.normal(0, sigma, (len(points), 1)) * along


@pytest.mark.parametrize("sigma", [0.006, 0.0075])
def test_noise_narrower_than_the_spacing_is_told_from_a_shape(sigma):
    """Neighbours in waves 2 σ high, 2π spacings long, are as high as in noise; only there are further ones higher."""
    count = 8000
    spacing = 1.4 / np.sqrt(count)
    points = np.column_stack((RNG.uniform(-0.7, 0.7, (count, 2)), np.zeros(count)))
    normals = np.tile(UP, (count, 1))
    assert sigma < spacing / 2
    noisy = points + RNG.normal(0, sigma, (count, 1)) * normals
    assert 0.65 * sigma < noise.noise_level(noisy, normals) <= sigma  # up to a third less, as on any plane
    waves = points + 2 * sigma * np.sin(points[:, :1] / spacing) * normals
    assert noise.noise_level(waves, normals) == 0


@pytest.mark.parametrize("direction", ["normals", "all", "rays"])
@pytest.mark.parametrize(("count", "sigma"), [(8000, 0.0115), (60000, 0.03)])
def test_the_deviation_is_that_along_the_normals_whatever_the_direction(direction, count, sigma):
    # Neighbourhoods of 16 are at most 8 σ in radius; at least area/(π 64 σ²) of them are independent. Each variance is
    # off by √(2/15), their median's standard error is 1.25 of the mean's, and the deviation is off by half of that.
    points, normals = sphere(count)
    seen = normals[:, 0] > 0.5 if direction == "rays" else np.ones(count, bool)  # rays that graze move too far
    points, normals = points[seen], normals[seen]
    area = 4 * np.pi * 0.7**2 * (0.25 if direction == "rays" else 1.0)
    error = 0.5 * 1.25 * np.sqrt(2 / 15) / np.sqrt(area / (64 * np.pi * sigma**2))
    found = noise.noise_deviation(with_noise(direction, points, normals, sigma), normals)
    assert abs(found / sigma - 1) < 4 * error


@pytest.mark.parametrize(("count", "gain"), [(8000, 5), pytest.param(60000, 7, marks=pytest.mark.slow)])
def test_points_come_back_to_the_sphere(count, gain):
    points, normals = sphere(count)
    noisy = points + RNG.uniform(-0.02, 0.02, (count, 1)) * normals
    moved = noise.smooth_along_normals(noisy, normals, noise.noise_level(noisy, normals))
    error = np.linalg.norm(moved, axis=1) - 0.7
    assert rms(error) < 0.02 / np.sqrt(3) / gain
    assert abs(error.mean()) < 5e-4  # it does not shrink
    assert np.abs(np.cross(moved - noisy, normals)).max() < 1e-12  # nor does anything slide


@pytest.mark.slow
def test_the_sides_of_a_plate_thinner_than_the_noise_stay_apart():
    points, normals = plate(30000, thickness=0.01)
    noisy = points + RNG.uniform(-0.02, 0.02, (30000, 1)) * normals
    assert (noisy[:15000, 2] < 0).mean() > 0.3
    moved = noise.smooth_along_normals(noisy, normals, noise.noise_level(noisy, normals))
    assert rms(moved[:, 2] - points[:, 2]) < 0.0025
    assert (moved[:15000, 2] > 0).mean() > 0.99


def test_a_crease_stays_sharp():
    box = Box(half_size=(0.5, 0.4, 0.3))
    cloud = sample_surface(box, 20000, shell=0.002)
    noisy = add_noise(cloud, 0.01)
    normals = cloud.normals.astype(np.float64)
    moved = noise.smooth_along_normals(noisy.points, normals, noise.noise_level(noisy.points, normals))
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
    level = noise.noise_level(noisy, normals)
    assert noise.noise_level(there, normals_there) == pytest.approx(7 * level, rel=1e-9)
    moved = noise.smooth_along_normals(noisy, normals, level)
    assert noise.smooth_along_normals(there, normals_there, 7 * level) == pytest.approx(
        7 * moved @ turn.T + 2, abs=1e-9
    )


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
    assert noise.noise_level(points, normals) > 0
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
    deviation = 0.01 * float(np.linalg.norm(np.ptp(clean.points, axis=0))) / np.sqrt(3)
    assert prepared.report.smoothed_noise == pytest.approx(deviation, rel=0.2 if given else 0.5)
    assert "along the normals smoothed" in prepared.report.summary()
    radius = np.linalg.norm(prepared.similarity.to_input(prepared.points), axis=1)
    assert rms(radius - 0.5) < deviation / (4 if given else 1.5)  # normals of noisy neighbourhoods are noisy too


def test_beside_a_noisy_blade_is_outside():
    blade = sample_surface(Box(half_size=(0.7, 0.15, 0.01)), 12000, shell=0.002)
    prepared = prepare_cloud(add_noise(blade, 0.01), smooth_noise=True)
    points, normals = torch.from_numpy(prepared.points), torch.from_numpy(prepared.normals)
    distance = CloudDistance(points, normals, noise=prepared.noise)

    def share_inside(low: float, high: float) -> float:
        places = np.column_stack([RNG.uniform(-0.6, 0.6, 4000), RNG.uniform(low, high, 4000), np.zeros(4000)])
        query = torch.from_numpy(prepared.similarity.to_unit(places).astype(np.float32))
        return float((distance.signed(query) < 0).float().mean())

    assert share_inside(0.18, 0.25) == 0
    assert share_inside(-0.1, 0.1) > 0.97


def test_distances_weigh_no_more_than_the_noise_allows():
    config = FitConfig(residual_data_weight=2.0)
    for error, deviation, expected in ((1e-4, 0.0, 2e4), (1e-6, 0.0, 2e6), (1e-6, 0.01, 2e4)):
        assert config.data_weight_after(error, deviation) == pytest.approx(expected)


@pytest.mark.parametrize(("estimated", "dense"), [(True, False), (False, False), (True, True)])
def test_less_noise_is_smoothed_off_where_it_is_in_the_normals_too(estimated, dense, monkeypatch):
    """Of a fifth of the spacing: a network averages over it if normals are exact, but estimated ones are tilted."""
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


def test_planes_of_one_side_keep_its_normal_and_sign():
    """Of a plane, and of a plate of whose thickness neighbourhoods are twenty times as wide."""
    points = np.column_stack((RNG.uniform(-1, 1, (500, 2)), np.zeros(500)))
    tilted = unit_rows(-UP + RNG.normal(0, 0.1, (500, 3)))
    # Eigenvectors are as exact as rounding beside the gap between eigenvalues, which is the size of the largest.
    assert np.abs(noise.refit_normals(points, tilted, 0.3) + UP).max() < 6400 * DOUBLE
    points, exact = plate(4000, thickness=0.014)
    assert np.abs(noise.refit_normals(points, exact, 0.14) - exact).max() < 6400 * DOUBLE


def test_an_edge_stays_sharp():
    """Sides at a right angle weigh nothing in each other's planes, once normals tell them apart."""
    cloud = sample_surface(Box(half_size=(0.5, 0.4, 0.3)), 8000, shell=0.002)
    exact = cloud.normals.astype(np.float64)
    flat = np.abs(exact).max(axis=1) > 1 - 1e-6
    assert flat.mean() > 0.95
    noisy = unit_rows(exact + RNG.normal(0, 0.05, exact.shape))
    after = angles(noise.refit_normals(cloud.points, noisy, 0.08), exact)[flat]
    # 1e-3 of the points' exactness over a neighbourhood of 0.05 is a degree.
    assert np.quantile(after, 0.9) < 1


def test_only_normals_with_at_least_the_given_cosine_count():
    """Two planes at sixty degrees: cosine ½ counts from 0.3 on, and not from 0.6 on."""
    flat = np.column_stack((RNG.uniform(-1, 1, 4000), RNG.uniform(0, 1, 4000), np.zeros(4000)))
    cosine, sine = 0.5, 0.75**0.5
    turn = np.array([[1, 0, 0], [0, -cosine, sine], [0, sine, cosine]])  # y to the other side, and up by sixty degrees
    points = np.concatenate((flat[:2000], flat[2000:] @ turn.T))
    exact = np.repeat([[0.0, 0.0, 1.0], [0.0, sine, cosine]], 2000, axis=0)
    loose, strict = (noise.refit_normals(points, exact, 0.2, alike=alike) for alike in (0.3, 0.6))
    assert np.abs(strict - exact).max() < 6400 * DOUBLE
    assert angles(loose, exact).max() > 5


def test_filtered_normals_are_means_over_a_face():
    """A filter of 32 neighbours weighs as 32/3 equal ones; three passes leave less noise than one: below a third."""
    points, exact, noisy = box_with_normals(6000)
    before, after = angles(noisy, exact), angles(noise.filter_normals(points, noisy), exact)
    assert np.median(after) < np.median(before) / 3
    assert after.max() < before.max()
    # Across an edge a normal counts exp(−1/0.04) = 1e-11 of its own side's.
    assert np.abs(noise.filter_normals(points, exact) - exact).max() < 1e-9


def test_a_box_has_edges_and_a_sphere_has_none():
    points, _, noisy = box_with_normals(6000)
    assert noise.has_edges(points, noise.filter_normals(points, noisy))
    points, exact = even_sphere(6000)
    assert not noise.has_edges(points, exact)
    assert not noise.has_edges(points, noise.filter_normals(points, exact))


@pytest.mark.slow
def test_noise_on_a_box_comes_off_and_leaves_its_edges():
    points, exact, first = box_with_normals(8000)
    sigma = 0.015
    moved, normals, level = noise.denoise(points + RNG.normal(0, sigma, points.shape), first)
    assert 0.5 * sigma < level < 1.5 * sigma
    half = np.array([0.6, 0.5, 0.4])
    outside = np.linalg.norm((np.abs(moved) - half).clip(min=0), axis=1)
    off = np.where(outside > 0, outside, (half - np.abs(moved)).min(axis=1))
    assert rms(off) < sigma / 3
    assert np.median(angles(normals, exact)) < 2


@pytest.mark.parametrize("half", [(0.6, 0.5, 0.4), (0.8, 0.05, 0.05)], ids=["box", "bar, four spacings wide"])
def test_normals_of_a_box_and_a_thin_bar_lose_what_other_sides_gave_them(half):
    """Planes through all neighbours round edges; neighbours with like normals lie in one face, and leave its normal."""
    points, exact, _ = box_with_normals(6000)
    points *= np.array(half) / (0.6, 0.5, 0.4)
    estimated = prepare_cloud(PointCloud(points), normals="estimate", isolation=None).normals.astype(np.float64)
    signed = np.where((estimated * exact).sum(axis=1, keepdims=True) < 0, -estimated, estimated)
    before, after = angles(signed, exact), angles(noise.sharper_normals(points, signed), exact)
    assert (before > 5).mean() > 0.1
    assert (after > 5).mean() < (before > 5).mean() / 2


def test_normals_of_slightly_noisy_points_stay():
    """A tenth of the spacing: too little to be smoothed, and fewer points make worse planes."""
    sphere = sample_sphere(6000)
    noisy = PointCloud(sphere.points + RNG.normal(0, 0.0015, (6000, 3)))
    left, given = (prepare_cloud(noisy, smooth_noise=choice) for choice in (False, True))
    assert given.noise == 0
    assert (left.normals == given.normals).all()


@pytest.mark.parametrize(
    "cloud",
    [
        sample_surface(Torus(), 4000, shell=0.002),
        sample_surface(Box(half_size=(0.5, 0.4, 0.3)), 4000, shell=0.002),
        add_noise(sample_sphere(6000), 0.01),
    ],
    ids=["curved", "edges", "noise"],
)
def test_exact_normals_are_kept_as_they_are(cloud):
    prepared = prepare_cloud(cloud, smooth_noise=True)
    assert prepared.report.reestimated_normals == 0
    assert np.abs(prepared.normals - cloud.normals).max() < 1e-6


@pytest.mark.parametrize("tilt", [0.15, 0.3])
def test_normals_worse_than_the_points_are_replaced_and_keep_their_signs(tilt):
    points, exact = even_sphere()
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
    assert mean_square(mended.normals, exact) < mean_square(noisy, exact) / 4


def test_normals_and_points_that_are_both_noisy_are_mended_together():
    points, exact = even_sphere()
    noisy = points + np.random.default_rng(5).normal(0, 0.02, points.shape)  # 1.4 spacings
    tilted = jittered(exact, 0.4)
    prepared = prepare_cloud(PointCloud(noisy, tilted.astype(np.float32)), smooth_noise=True)
    assert prepared.report.reestimated_normals == 4000
    assert mean_square(prepared.normals, exact) < mean_square(tilted, exact) / 4
