"""Orientation by winding numbers, also of shapes without an inside; sums of dipoles against sums over all pairs."""

import numpy as np
import pytest
import torch
from bounds import unit_roundoff
from mplicits.datasets import PointCloud, prepare_cloud, sample_sphere, sample_surface
from mplicits.datasets.clouds.cleaning import winding
from mplicits.datasets.clouds.cleaning.winding import DIPOLES, DipoleField, DipoleSums, orient_by_winding
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.neural_fields import Box
from scipy.optimize import brentq
from scipy.spatial import KDTree
from scipy.stats import norm

RNG = np.random.default_rng(0)
SOFTENING = 0.05
# A leaf of 48 points seen as one dipole from beyond its near leaves; see `near` of `DipoleOptions`.
FAR = 0.05


def moved(points: np.ndarray, amplitude: float) -> np.ndarray:
    """Noise of the same strength in all directions: along each, as strong as U(-1, 1) diagonals times ``amplitude``."""
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    return points + np.random.default_rng(1).normal(size=points.shape) * amplitude * diagonal / np.sqrt(3)


def blade() -> tuple[np.ndarray, np.ndarray]:
    """A bar eight times as wide as thick."""
    cloud = sample_surface(Box(half_size=(0.8, 0.16, 0.02)), 6000, shell=0.004)
    return cloud.points, cloud.normals.astype(np.float64)


def legs(radius: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """A ball with six thin legs that begin at its surface."""
    ball = unit_rows(RNG.normal(size=(2000, 3)))
    axes = np.concatenate((np.eye(3), -np.eye(3)))[RNG.integers(0, 6, 2000)]
    across = unit_rows(np.cross(RNG.normal(size=axes.shape), axes))
    along = RNG.uniform(0.3, 0.95, (len(axes), 1))
    return np.concatenate((0.3 * ball, along * axes + radius * across)), np.concatenate((ball, across))


def wrong(normals: np.ndarray, exact: np.ndarray) -> float:
    return float(((normals * exact).sum(axis=1) < 0).mean())


def test_misfit_of_shapes_where_it_is_known():
    sphere = sample_sphere(4000)
    normals = 2 * sphere.points
    assert winding.misfit(sphere.points, normals) < 0.15  # ½ but for the random spacing of its points
    assert winding.misfit(sphere.points, -normals) == pytest.approx(1, abs=0.15)  # −½
    sheet = np.column_stack((RNG.uniform(-1, 1, (3000, 2)), np.zeros(3000)))
    up = np.tile([0.0, 0, 1], (3000, 1))
    assert winding.misfit(sheet, up) == pytest.approx(0.5, abs=1e-6)  # the winding number in a plane is 0


def expected_thickness(density: float, sigma: float, *, flat: float = 0.25) -> tuple[float, int]:
    """The thickness of a plane under Gaussian noise, but for terms of the order 1/k, and the number of neighbours k.

    The k nearest of a point at the height e fill a ball of radius R. ``density`` φ(z) π (R² − (z − e)²) of them lie at
    the height z: their sum is k, their second moment the variance. A fitted plane takes 3 of k degrees of freedom.
    """
    z = np.linspace(-5, 5, 2001) * sigma
    share = np.exp(-((z / sigma) ** 2) / 2) / np.exp(-((z / sigma) ** 2) / 2).sum()
    levels = norm.ppf((np.arange(100) + 0.5) / 100) * sigma  # of the points in the middle
    for size in winding.WINDING.sizes:
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
    # The median of the variances of N/k neighbourhoods, each with the relative deviation √(2/k), has the standard error
    # 1.25 √(2/N); the thickness, half of it.
    sphere, sigma, count = sample_sphere(20000, seed=1), 0.015, 20000  # 64 neighbours: others are far from flat
    assert winding.layer_thickness(sphere.points) < 1e-3
    expected, size = expected_thickness(count / np.pi, sigma)
    found = winding.layer_thickness(sphere.points + np.random.default_rng(2).normal(0, sigma, (count, 3)))
    assert abs(found / expected - 1) < 1 / size + 5 * 0.5 * 1.25 * np.sqrt(2 / count)
    assert expected < sigma


@pytest.mark.parametrize(("amplitude", "most"), [(0.0, 0.01), (0.01, 0.05)])
@pytest.mark.parametrize("shape", [blade, legs])
def test_normals_of_thin_parts_even_if_noise_is_as_wide(shape, amplitude, most):
    """Compared with those of the exact points nearest to the noisy ones, which may be on the other side of the part."""
    points, exact = shape()
    noisy = moved(points, amplitude)
    found = winding.winding_normals(7 * noisy + (100.0, 0, 0))
    assert len(found.rows) == len(points)
    assert np.allclose(np.linalg.norm(found.normals, axis=1), 1)
    assert wrong(found.normals, exact[KDTree(points).query(noisy)[1]][found.rows]) < most


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
    assert wrong(oriented, exact) < 0.01


def test_what_propagation_got_wrong_is_turned():
    points, exact = legs()
    half = np.where(points[:, :1] > 0.1, -exact, exact)
    oriented = orient_by_winding(points, half)
    assert wrong(oriented, exact) < 0.01
    assert orient_by_winding(points, oriented) is None  # clean, and fits


@pytest.mark.parametrize("noise", [0.0, 0.004])
def test_an_open_sheet_keeps_its_signs(noise):
    flat = RNG.uniform(-1, 1, (4000, 2))
    height = 0.2 * np.sin(4 * flat[:, 0]) * np.cos(3 * flat[:, 1])
    along_x = 0.8 * np.cos(4 * flat[:, 0]) * np.cos(3 * flat[:, 1])
    along_y = -0.6 * np.sin(4 * flat[:, 0]) * np.sin(3 * flat[:, 1])
    normals = unit_rows(np.column_stack((-along_x, -along_y, np.ones(4000))))
    assert orient_by_winding(moved(np.column_stack((flat, height)), noise), normals) is None


def test_the_report_says_what_oriented():
    points, exact = blade()
    thin = prepare_cloud(PointCloud(moved(points, 0.005)))
    assert thin.report.oriented_by == "winding"
    assert "oriented by winding numbers" in thin.report.summary()
    assert wrong(thin.normals, exact) < 0.05
    easy = prepare_cloud(PointCloud(sample_sphere(2000).points))
    assert "oriented from point to point" in easy.report.summary()


def test_a_cavity_is_a_cavity():
    """Each piece by itself looks like a body of its own; together they are a shell."""
    outer, inner = sample_sphere(3000, radius=0.8), sample_sphere(1500, radius=0.5, seed=1)
    cloud = prepare_cloud(PointCloud(np.concatenate((outer.points, inner.points))))
    assert (cloud.report.pieces, cloud.report.oriented_by) == (2, "winding")
    assert wrong(cloud.normals, np.concatenate((outer.points, -inner.points))) == 0


def sphere(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the sphere of radius 0.8 and their area-weighted normals, each ``(N, 3)``."""
    normals = unit_rows(np.random.default_rng(0).normal(size=(count, 3)))
    return 0.8 * normals, normals * (4 * np.pi * 0.8**2 / count)


def expected(points: np.ndarray, dipoles: np.ndarray, values: np.ndarray) -> dict[str, np.ndarray]:
    offset = points[None] - points[:, None]
    squares = (offset**2).sum(axis=2) + SOFTENING**2
    kernel = squares**-1.5 / (4 * np.pi)
    flux = np.einsum("ijd,jd->ij", offset, dipoles)
    return {
        "winding": (kernel * flux).sum(axis=1),
        "adjoint": np.einsum("ij,ijd,i->jd", kernel, offset, values),
        "descent": kernel @ dipoles - 3 * np.einsum("ij,ijd->id", kernel / squares * flux, offset),
    }


@pytest.mark.parametrize(("count", "relative"), [(DIPOLES.leaf, 0.0), (1500, FAR)])
def test_sums_are_those_over_all_pairs(count, relative):
    points, dipoles = sphere(count)
    values = 1 + points[:, 0]
    sums = DipoleSums(points, SOFTENING)
    found = {
        "winding": sums.winding(torch.from_numpy(dipoles).float()),
        "adjoint": sums.adjoint(torch.from_numpy(values).float()),
        "descent": sums.descent(torch.from_numpy(dipoles).float()),
    }
    # Squared distances are differences of squares, of order 1 beside ε².
    rounding = 16 * unit_roundoff(torch.float32) / SOFTENING**2
    for name, exact in expected(points, dipoles, values).items():
        off = np.linalg.norm(found[name].double().numpy() - exact) / np.linalg.norm(exact)
        assert off < relative + rounding, name


def test_descent_is_the_gradient_of_winding():
    points, dipoles = sphere(DIPOLES.leaf - 1)
    probe, step = np.array([0.1, 0.2, -0.3]), 1e-2

    def at(place: np.ndarray) -> tuple[float, np.ndarray]:
        sums = DipoleSums(np.vstack([points, place]), SOFTENING)
        mu = torch.from_numpy(np.vstack([dipoles, np.zeros(3)])).float()
        return float(sums.winding(mu)[-1]), sums.descent(mu)[-1].double().numpy()

    slopes = [(at(probe - step * axis)[0] - at(probe + step * axis)[0]) / (2 * step) for axis in np.eye(3)]
    # The third derivative of 1/r² at r > 0.4 is below 24 / r⁵, summed over an area of 8 and divided by 4π.
    assert at(probe)[1] == pytest.approx(np.array(slopes), abs=step**2 / 6 * 24 / 0.4**5 * 8 / (4 * np.pi))


@pytest.mark.parametrize(("count", "relative"), [(1, FAR), (DIPOLES.leaf, 0.0), (3000, FAR)])
def test_a_field_of_dipoles_is_the_sum_over_all_of_them(count, relative):
    points, dipoles = sphere(count)
    places = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    softening = np.random.default_rng(2).uniform(SOFTENING, 2 * SOFTENING, count)
    offset = points[None] - places[:, None]
    squares = (offset**2).sum(axis=2) + softening**2
    exact = (np.einsum("ijd,jd->ij", offset, dipoles) * squares**-1.5).sum(axis=1) / (4 * np.pi)
    found = DipoleField(points, dipoles, softening).winding(places)
    rounding = 16 * unit_roundoff(torch.float32) / SOFTENING**2
    # A sum over all is of order 1; a single dipole is as large as its area over the square of its softening.
    assert np.abs(found - exact).max() < (relative + rounding) * max(1.0, np.abs(exact).max())
    assert DipoleField(points, dipoles, softening).winding(np.empty((0, 3))).shape == (0,)


def test_winding_numbers_are_whole_close_to_the_sides_of_a_plate():
    """A plate a tenth as thick as a leaf is wide: its sides, merged by leaves, would cancel."""
    side = np.linspace(-0.5, 0.5, 60)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    top = np.stack((x, y, np.full_like(x, 0.01)), axis=1)
    points = np.concatenate((top, top * (1, 1, -1)))
    normals = np.zeros_like(points)
    normals[:, 2] = np.sign(points[:, 2])
    spacing, softening = side[1] - side[0], 0.003
    field = DipoleField(points, spacing**2 * normals, np.full(len(points), softening))
    # Of an infinite plate the number is 1 halfway through and 0 above it. What the rim leaves out is its solid angle;
    # dipoles on a square lattice waver by 4 e^(−2πz/h) of their own at the height z, and softened ones see less.
    rim, waver, soft = 2 * 0.01 / 0.3, 4 * np.exp(-2 * np.pi * 0.01 / spacing), 1 - 0.01 / np.hypot(0.01, softening)
    inner = np.random.default_rng(0).uniform(-0.2, 0.2, (500, 2))
    halfway, above = (np.column_stack((inner, np.full(500, z))) for z in (0.0, 0.03))
    assert rim + waver + soft + FAR < 0.3  # of 0.5, at which a side is taken for the other
    assert (np.abs(field.winding(halfway) - 1) < rim + waver + soft + FAR).all()
    assert (np.abs(field.winding(above)) < rim + waver + soft + FAR).all()


def test_leaves_of_a_large_cloud_are_no_more_than_so_many():
    points, dipoles = sphere(2 * DIPOLES.leaf * DIPOLES.most_leaves)
    found = DipoleField(points, dipoles, np.full(len(points), SOFTENING)).winding(np.array([[0.0, 0, 0], [0, 0, 0.95]]))
    assert np.abs(found - (1, 0)).max() < FAR
