"""The town is exact, its scans are of it, and one benchmark runs from end to end."""

from pathlib import Path

import numpy as np
import pytest
from mplicits.pipelines.training.settings import FitConfig

from benchmarks.shapes.tiles import SINGLE, TILED, TilesBench
from benchmarks.shapes.town import TOWN, Town, TownScan

ROUNDING = 1e-9  # metres: coordinates up to 5.4e6 in float64


@pytest.fixture(scope="module")
def town() -> Town:
    return Town(2)


def heights(town: Town, places: np.ndarray) -> np.ndarray:
    """Of the ground's triangles, from its own corners."""
    low = np.floor(places / TOWN.ground)
    u, v = (places / TOWN.ground - low).T
    a, b, c, d = (town.height((low + corner) * TOWN.ground) for corner in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return np.where(v <= u, a + u * (b - a) + v * (c - b), a + u * (c - d) + v * (d - a))


def test_points_lie_on_the_ground_or_on_a_solid_above_it(town: Town) -> None:
    points, normals = town.even(20_000)
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-12
    above = points[:, 2] - heights(town, points[:, :2])
    on_ground = np.abs(above) < ROUNDING
    assert 0.2 < on_ground.mean() < 0.9
    assert above.min() > -ROUNDING
    # A step outwards leaves everything, a step inwards is inside of a solid or the ground.
    owner = np.full(len(points), -2)
    assert not town.buried(points + 1e-6 * normals, owner)[~on_ground].mean() > 1e-3
    inside = town.buried(points - 1e-6 * normals, owner) | (above < 1e-6)
    assert inside.mean() > 0.999


def test_a_scan_is_uneven_and_the_same_in_any_pieces_of_its_size(town: Town) -> None:
    scan = TownScan(town, 20_000, noise=0.0)
    cloud = scan.cloud()
    points = cloud.points - TOWN.origin
    assert 0.5 * 20_000 < len(cloud) <= 20_000
    assert (points[:, 2] - heights(town, points[:, :2])).min() > -1e-6
    again = TownScan(town, 20_000, noise=0.0).cloud()
    assert np.array_equal(again.points, cloud.points)
    noisy = TownScan(town, 20_000, noise=0.01).cloud()
    along = ((noisy.points - cloud.points) * cloud.normals).sum(axis=1)
    assert abs(along.std() / 0.01 - 1) < 5 / np.sqrt(2 * len(along))


@pytest.mark.slow
def test_rows(tmp_path: Path) -> None:
    one = {"widths": (32,), "depths": (1,), "omegas": (10.0,), "steps": (100,), "learning_rates": (5e-3,)}
    config = FitConfig(**one, batch=256, samples=4000, device="cpu")
    few = {"plots": 2, "points": 60_000, "resolution": 48, "eval_samples": 5000, "methods": (TILED, SINGLE)}
    tiled, single = TilesBench(config=config, **few).rows(tmp_path)
    assert (tiled.method, single.method, single.tiles) == (TILED, SINGLE, 1)
    for row in (tiled, single):
        assert 0 < row.floor < row.accuracy < 5
        assert row.floor < row.completeness < 5
