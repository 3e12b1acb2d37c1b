"""Exact clouds are exact and even; the statue is one solid; the scan is a scan."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mplicits import datasets
from mplicits.datasets import Statue, add_noise, sample_sphere, sample_surface, sample_torus
from mplicits.neural_fields import Box, Capsule, Sphere, Torus
from scipy.ndimage import label
from scipy.spatial import KDTree


@pytest.mark.parametrize("field", [Sphere(radius=0.6), Torus(), Capsule(), Box()])
def test_samples_lie_on_the_surface_with_its_normals(field):
    cloud = sample_surface(field, 2000, seed=5)
    jet = field.jet(torch.from_numpy(cloud.points))
    assert len(cloud) == 2000
    assert jet.value.abs().max() < 1e-9
    assert np.abs(cloud.normals - jet.gradient.numpy()).max() < 1e-6
    assert np.array_equal(cloud.points, sample_surface(field, 2000, seed=5).points)
    assert not np.array_equal(cloud.points, sample_surface(field, 2000, seed=6).points)


@pytest.mark.parametrize("cloud", [sample_surface(Torus(), 40000, seed=2), sample_torus(40000, seed=2)])
def test_torus_is_sampled_evenly_by_area(cloud):
    """The outer half of a torus has the share 1/2 + minor/(π major) of the area (Pappus)."""
    outer = (np.hypot(*cloud.points[:, :2].T) > 0.5).mean()
    assert abs(outer - (0.5 + 0.2 / (0.5 * np.pi))) < 4 * 0.5 / 200
    assert Torus().value(torch.from_numpy(cloud.points)).abs().max() < 1e-9


def test_no_surface_is_an_error():
    with pytest.raises(ValueError, match="no zero set"):
        sample_surface(Sphere(center=(9.0, 0.0, 0.0)), 10)


def test_noise_moves_points_along_their_normals():
    cloud = sample_sphere(20000, radius=1.0)
    noisy = add_noise(cloud, 0.01, seed=1)
    shift = ((noisy.points - cloud.points) * cloud.normals).sum(axis=1)
    bound = 0.01 * np.linalg.norm(np.ptp(cloud.points, axis=0))
    assert np.abs(noisy.points - cloud.points - shift[:, None] * cloud.normals).max() < 1e-7
    assert 0.99 * bound < np.abs(shift).max() <= bound * (1 + 1e-6)
    assert abs(shift.std() - bound / 3**0.5) < 0.02 * bound
    assert noisy.normals is cloud.normals
    short = replace(cloud, normals=cloud.normals * np.float32(1e-4))  # as meshes sum them up: of any length
    np.testing.assert_allclose(add_noise(short, 0.01, seed=1).points, noisy.points, atol=1e-6)


def test_isotropic_noise_is_as_strong_along_the_normals_and_across():
    """Of a Gaussian the covariances' standard errors are σ² √((1 + δ_ij)/N); five of them are allowed."""
    cloud = sample_sphere(20000, radius=1.0)
    noisy = add_noise(cloud, 0.01, seed=1, isotropic=True)
    sigma = 0.01 * np.linalg.norm(np.ptp(cloud.points, axis=0)) / 3**0.5
    shift = noisy.points - cloud.points
    bound = 5 * sigma**2 * np.sqrt((1 + np.eye(3)) / 20000)
    assert (np.abs(shift.T @ shift / 20000 - sigma**2 * np.eye(3)) < bound).all()
    along = np.square((shift * cloud.normals).sum(axis=1)).mean()
    assert abs(along - sigma**2) < 5 * sigma**2 * (2 / 20000) ** 0.5
    assert noisy.normals is cloud.normals
    with pytest.raises(ValueError, match="amplitude=-1"):
        add_noise(cloud, -1, isotropic=True)


def test_outliers_fill_the_ball():
    cloud = sample_sphere(20000, radius=2.0)
    dirty = datasets.add_outliers(cloud, 0.5, seed=1)
    assert len(dirty) == 30000
    assert np.array_equal(dirty.points[:20000], cloud.points)
    radii = np.linalg.norm(dirty.points[20000:], axis=1) / 2
    assert radii.max() < 1.01
    assert abs((radii < 0.5).mean() - 1 / 8) < 0.015
    assert np.abs(np.linalg.norm(dirty.normals, axis=1) - 1).max() < 1e-6
    assert np.abs(dirty.normals[20000:].mean(axis=0)).max() < 0.03


@pytest.fixture(scope="module")
def statue():
    return Statue()


def test_statue_gradient_is_that_of_its_value(statue):
    x = (torch.rand(3000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1).requires_grad_()
    (expected,) = torch.autograd.grad(statue.value(x).sum(), x)
    jet = statue.jet(x)
    assert (jet.gradient - expected).abs().max() < 1e-6
    assert torch.equal(jet.value, statue.value(x))
    assert statue.jet(torch.empty(0, 2, 3)).gradient.shape == (0, 2, 3)


@pytest.mark.slow
def test_statue_is_one_solid_inside_the_unit_sphere(statue):
    n = 112
    axis = torch.linspace(-1, 1, n)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
    inside = (statue.value(grid) < 0).numpy()
    assert label(inside)[1] == 1
    assert label(~inside)[1] == 1  # no bubbles
    assert float(grid.norm(dim=-1)[torch.from_numpy(inside)].max()) < 1


@pytest.mark.slow
def test_statue_scan(statue):
    scan = datasets.statue_scan(seed=0)
    assert 60_000 < len(scan) < 120_000
    assert scan.colors is not None
    assert scan.points.max() > 1000  # millimetres in a hall, not the unit sphere
    jet = statue.jet(torch.from_numpy(datasets.STATUE_PLACEMENT.to_unit(scan.points[::300])))
    distance = (jet.value / jet.gradient.norm(dim=1)).numpy()  # to first order
    assert np.abs(distance).max() < 6 * 2e-4
    assert 1e-4 < distance.std() < 2e-4  # the ranges' noise is 2e-4, along rays that meet the surface at up to 84°
    cloud = datasets.prepare_cloud(scan)
    assert cloud.report.repaired_normals > 100
    assert cloud.report.kept > 0.995 * len(scan)
    assert not cloud.report.flipped
    spacing, _ = KDTree(scan.points).query(scan.points, k=2)
    assert np.quantile(spacing[:, 1], 0.95) > 3 * np.quantile(spacing[:, 1], 0.05)  # uneven density
