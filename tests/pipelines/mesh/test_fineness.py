"""Cells fine enough for thin parts: plates whose thickness is known."""

import numpy as np
import pytest
from mplicits.neural_fields import Box, Similarity, Sphere, Union, save_field
from mplicits.pipelines.mesh import MeshOptions, export_run, extract
from mplicits.pipelines.mesh.extract import RESOLUTIONS, fineness, thin_share
from mplicits.pipelines.surface.surface import Support

DEPTHS = {resolution: 3**0.5 * 2.04 / resolution for resolution in RESOLUTIONS}  # of √3 cells


def sides(thickness: float, count: int = 500) -> np.ndarray:
    """Points on the two wide faces of `plate`."""
    random = np.random.default_rng(0)
    across = np.where(np.arange(count) % 2, 0.5, -0.5) * thickness
    return np.stack((*random.uniform(-0.1, 0.1, (2, count)), across), axis=1)


def plate(thickness: float) -> Box:
    return Box(half_size=(0.1, 0.1, thickness / 2))


@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_a_plate_is_thin_below_root_three_cells(resolution: int):
    depth = DEPTHS[resolution]
    assert thin_share(plate(1.01 * depth), sides(1.01 * depth), resolution) == 0
    assert thin_share(plate(0.99 * depth), sides(0.99 * depth), resolution) == 1


@pytest.mark.parametrize(("cells", "resolution"), [(1.1, 256), (0.6, 512), (0.3, 1024), (0.26, 1024)])
def test_as_many_cells_as_the_plate_asks_for(cells: float, resolution: int):
    thickness = cells * DEPTHS[256]
    found = fineness(plate(thickness), sides(thickness))
    assert found.resolution == resolution
    assert found.missed == (resolution > 256)


def test_a_thin_part_of_a_thick_shape_counts_by_its_share():
    thickness = 0.6 * DEPTHS[256]
    ball = Sphere(radius=0.3, center=(0.0, 0.0, 0.6))
    random = np.random.default_rng(1).normal(size=(1500, 3))
    on_ball = 0.3 * random / np.linalg.norm(random, axis=1, keepdims=True) + [0, 0, 0.6]
    points = np.concatenate((sides(thickness), on_ball))
    shape = Union(plate(thickness), ball)
    assert thin_share(shape, points, 256) == 0.25
    assert fineness(shape, points).resolution == 512
    assert fineness(ball, on_ball).resolution == 256


def test_points_off_the_surface_are_of_no_part():
    shape = Sphere(radius=0.5)
    points = np.random.default_rng(2).normal(size=(500, 3))
    points *= (0.5 + 2 * DEPTHS[256]) / np.linalg.norm(points, axis=1, keepdims=True)
    assert thin_share(shape, points, 256) == 0


def test_mesh_takes_as_many_and_says_so(tmp_path, monkeypatch):
    thickness = 0.55 * DEPTHS[256]
    file = tmp_path / "plate.safetensors"
    save_field(file, plate(thickness), similarity=Similarity((0.0, 0.0, 0.0), 1.0))
    monkeypatch.setattr(extract, "read_support", lambda *_: Support(sides(thickness), 0.1))
    for resolution, words in ((None, "256 per side: taken are 512"), (128, "--resolution 128"), (512, None)):
        said: list[str] = []
        mesh = export_run(file, tmp_path / "a.ply", MeshOptions(resolution=resolution), say=said.append).mesh
        assert len(said) == (words is not None)
        assert not said or words in said[0]
        if resolution is None:
            # Faces of the plate lie between corners of the lattice, so a coordinate is off by less than a rounding.
            assert np.allclose(np.abs(mesh.vertices).max(axis=0), (0.1, 0.1, thickness / 2), atol=1e-6)
