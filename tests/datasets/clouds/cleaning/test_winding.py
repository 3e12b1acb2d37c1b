"""Orientation by winding numbers: shapes that propagation gets wrong, and those that have no inside."""

import numpy as np
import pytest
from mplicits.datasets import PointCloud, prepare_cloud, sample_sphere, sample_surface
from mplicits.datasets.clouds.cleaning.winding import (
    WINDING,
    layer_thickness,
    misfit,
    orient_by_winding,
    winding_normals,
)
from mplicits.neural_fields import Box
from scipy.optimize import brentq
from scipy.spatial import KDTree
from scipy.stats import norm

RNG = np.random.default_rng(0)


def moved(points: np.ndarray, amplitude: float) -> np.ndarray:
    """Noise of the same strength in all directions: along each, as strong as U(-1, 1) diagonals times ``amplitude``."""
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    return points + np.random.default_rng(1).normal(size=points.shape) * amplitude * diagonal / np.sqrt(3)


def blade(count: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    """A bar eight times as wide as thick."""
    cloud = sample_surface(Box(half_size=(0.8, 0.16, 0.02)), count, shell=0.004)
    assert cloud.normals is not None
    return cloud.points, cloud.normals.astype(np.float64)


def legs(count: int = 4000, *, radius: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """A ball with six thin legs that begin at its surface."""
    ball = RNG.normal(size=(count // 2, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    axes = np.concatenate((np.eye(3), -np.eye(3)))[RNG.integers(0, 6, count // 2)]
    across = np.cross(RNG.normal(size=axes.shape), axes)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = RNG.uniform(0.3, 0.95, (len(axes), 1))
    return np.concatenate((0.3 * ball, along * axes + radius * across)), np.concatenate((ball, across))


def wrong(normals: np.ndarray, exact: np.ndarray) -> float:
    return float(((normals * exact).sum(axis=1) < 0).mean())


def test_misfit_of_shapes_where_it_is_known():
    sphere = sample_sphere(4000)
    normals = 2 * sphere.points
    assert misfit(sphere.points, normals) < 0.15  # ½ but for the random spacing of its points
    assert misfit(sphere.points, -normals) == pytest.approx(1, abs=0.15)  # −½
    sheet = np.column_stack((RNG.uniform(-1, 1, (3000, 2)), np.zeros(3000)))
    assert misfit(sheet, np.tile([0.0, 0, 1], (3000, 1))) == pytest.approx(
        0.5, abs=1e-6
    )  # a plane sees nothing of itself


def expected_thickness(density: float, sigma: float, *, flat: float = 0.25) -> tuple[float, int]:
    """What `layer_thickness` should find of a plane under Gaussian noise, and of how many neighbours.

    The k nearest of a point at the height e fill a ball of radius R, in which ``density`` φ(z) π (R² − (z − e)²) points
    lie at the height z: that, summed up, is k, and its second moment about its mean the variance that they have. The
    plane through them takes 3 of k degrees of freedom. What is left out are terms of the order 1/k.
    """
    z = np.linspace(-5, 5, 2001) * sigma
    share = np.exp(-((z / sigma) ** 2) / 2) / np.exp(-((z / sigma) ** 2) / 2).sum()
    levels = norm.ppf((np.arange(100) + 0.5) / 100) * sigma  # of the points in the middle
    for size in WINDING.sizes:
        spreads, radii = [], []
        for level in levels:

            def beyond(radius: float, level: float = level, size: int = size) -> float:
                return density * (share * np.pi * (radius**2 - (z - level) ** 2).clip(min=0)).sum() - size

            radius = float(brentq(beyond, 1e-3 * sigma, 100 * sigma))  # pyright: ignore[reportArgumentType]
            weight = density * share * np.pi * (radius**2 - (z - level) ** 2).clip(min=0) / size
            variance = (weight * z**2).sum() - (weight * z).sum() ** 2
            spreads.append(np.sqrt(variance * (1 - 3 / size)))
            radii.append(radius)
        if np.median(np.array(spreads) / radii) < flat:
            return float(np.median(spreads)), size
    raise AssertionError("no neighbourhood looks flat")


def test_thickness_is_the_noise_where_neighbourhoods_are_wide_enough():
    """Balls cut the outskirts of the layer off; how much is known.

    Terms of the order 1/k are left out, and the median of the variances of N/k neighbourhoods, each with the relative
    deviation √(2/k), has the standard error 1.25 √(2/N); the thickness, half of it.
    """
    sphere, sigma, count = sample_sphere(20000, seed=1), 0.015, 20000  # 64 neighbours: others are far from flat
    assert layer_thickness(sphere.points) < 1e-3
    expected, size = expected_thickness(count / np.pi, sigma)
    found = layer_thickness(sphere.points + np.random.default_rng(2).normal(0, sigma, (count, 3)))
    assert abs(found / expected - 1) < 1 / size + 5 * 0.5 * 1.25 * np.sqrt(2 / count)
    assert expected < sigma


@pytest.mark.parametrize("shape", [blade, legs])
def test_normals_out_of_nothing(shape):
    points, exact = shape()
    found = winding_normals(7 * points + (100.0, 0, 0))
    assert len(found.rows) == len(points)
    assert np.allclose(np.linalg.norm(found.normals, axis=1), 1)
    assert wrong(found.normals, exact[found.rows]) < 0.01


@pytest.mark.parametrize("shape", [blade, legs])
def test_thin_parts_as_noisy_as_they_are_thick_keep_their_sides(shape):
    """Judged by the side of the exact surface that the noisy point is nearest to: it may have left its own."""
    points, exact = shape()
    noisy = moved(points, 0.01)
    side = exact[KDTree(points).query(noisy)[1]]
    found = winding_normals(noisy)
    assert wrong(found.normals, side[found.rows]) < 0.05


@pytest.mark.parametrize("thickness", [0.4, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_blade_as_thin_as_a_part_of_a_spacing_gets_its_sides(thickness):
    """Wider dipoles of its two sides cancel: only narrow ones tell them apart."""
    size = (0.8, 0.16)
    spacing = 0.01
    flat = np.stack(np.meshgrid(*(np.arange(-half, half, spacing) for half in size)), axis=-1).reshape(-1, 2)
    half = thickness * spacing / 2
    shift = np.random.default_rng(4).uniform(-spacing / 3, spacing / 3, (2, len(flat), 2))
    points = np.concatenate(
        [np.column_stack((flat + s, np.full(len(flat), z))) for s, z in zip(shift, (half, -half), strict=True)]
    )
    exact = np.repeat([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], len(flat), axis=0)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    assert wrong(up, exact) == 0.5
    oriented = orient_by_winding(points, up)
    assert oriented is not None
    assert wrong(oriented, exact) < 0.01


def test_what_propagation_got_wrong_is_turned():
    points, exact = legs()
    half = np.where(points[:, :1] > 0.1, -exact, exact)
    oriented = orient_by_winding(points, half)
    assert oriented is not None
    assert wrong(oriented, exact) < 0.01
    assert orient_by_winding(points, oriented) is None  # clean, and fits


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_an_open_sheet_keeps_its_signs(noise):
    flat = RNG.uniform(-1, 1, (4000, 2))
    height = 0.2 * np.sin(4 * flat[:, 0]) * np.cos(3 * flat[:, 1])
    slopes = (
        0.8 * np.cos(4 * flat[:, 0]) * np.cos(3 * flat[:, 1]),
        -0.6 * np.sin(4 * flat[:, 0]) * np.sin(3 * flat[:, 1]),
    )
    normals = np.column_stack((-slopes[0], -slopes[1], np.ones(4000)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert orient_by_winding(moved(np.column_stack((flat, height)), noise), normals) is None


def test_the_report_says_what_oriented():
    points, exact = blade()
    thin = prepare_cloud(PointCloud(moved(points, 0.005)))
    assert thin.report.oriented_by == "winding"
    assert "oriented by winding numbers" in thin.report.summary()
    assert wrong(thin.normals, exact) < 0.05
    easy = prepare_cloud(PointCloud(sample_sphere(2000).points))
    assert "oriented from point to point" in easy.report.summary()
    assert prepare_cloud(PointCloud(points), sensor_origin=(9.0, 0, 0)).report.oriented_by == "sensor"
    assert prepare_cloud(PointCloud(points, exact.astype(np.float32))).report.oriented_by is None


def test_a_cavity_is_a_cavity():
    """Each piece by itself looks like a body of its own; together they are a shell."""
    outer, inner = sample_sphere(3000, radius=0.8), sample_sphere(1500, radius=0.5, seed=1)
    cloud = prepare_cloud(PointCloud(np.concatenate((outer.points, inner.points))))
    assert (cloud.report.pieces, cloud.report.oriented_by) == (2, "winding")
    assert wrong(cloud.normals, np.concatenate((outer.points, -inner.points))) == 0
