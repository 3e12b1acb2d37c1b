import numpy as np
import pytest
from mplicits.neural_fields import Box, extract_mesh
from scipy.spatial import KDTree

from benchmarks.shapes.uneven import DENSITIES, exact_shapes, uneven_cloud


@pytest.mark.parametrize("density", sorted(DENSITIES))
def test_spacings_differ_by_the_root_of_the_ratio_of_densities(density: str) -> None:
    mesh = extract_mesh(Box(half_size=(0.6, 0.4, 0.2)), resolution=48)
    cloud = uneven_cloud(mesh, 2000, density=density, ratio=25.0, seed=1)
    assert 0.8 * 2000 <= len(cloud) <= 2000
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    # A voxel has one point: neighbours are some 0.5 to 1.5 of its edge apart, whose largest is 5 times the least.
    spacing = KDTree(cloud.points).query(cloud.points, 5)[0][:, 4]
    assert 2 < np.quantile(spacing, 0.98) / np.quantile(spacing, 0.1) < 15
    off = np.abs(np.abs(cloud.points) - [0.6, 0.4, 0.2]).min(axis=1)
    assert off.max() < 2.1 / 48  # a cell of the mesh, which cuts edges
    again = uneven_cloud(mesh, 2000, density=density, ratio=25.0, seed=1)
    assert np.array_equal(again.points, cloud.points)


def test_exact_shapes_fit_the_unit_ball() -> None:
    for field, density in exact_shapes().values():
        assert density in DENSITIES
        assert np.linalg.norm(extract_mesh(field, resolution=32).vertices, axis=1).max() < 1
