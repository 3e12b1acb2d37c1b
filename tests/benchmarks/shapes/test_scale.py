from pathlib import Path

import numpy as np
import pytest
import trimesh
from mplicits.datasets import read_cloud
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.training.settings import FitConfig

from benchmarks.shapes.fits import ScaleBench, write_noisy_cloud


def test_clouds_have_the_noise_that_was_asked_for(tmp_path: Path) -> None:
    trimesh.creation.box((2, 2, 2)).export(tmp_path / "box.ply")
    write_noisy_cloud(tmp_path / "cloud.ply", read_surface(tmp_path / "box.ply"), 25_000, noise=0.001, rows=10_000)
    cloud = read_cloud(tmp_path / "cloud.ply")
    assert len(cloud) == 25_000
    off = (cloud.points * cloud.normals).sum(axis=1) - 1
    assert abs(off.std() / (0.001 * np.sqrt(12)) - 1) < 0.03
    assert abs(off.mean()) < 1e-4


@pytest.mark.slow
def test_rows_of_two_sizes(tmp_path: Path) -> None:
    trimesh.creation.icosphere(3).export(tmp_path / "ball.ply")
    one = {"widths": (32,), "depths": (1,), "omegas": (10.0,), "steps": (150,), "learning_rates": (5e-3,)}
    config = FitConfig(**one, batch=256, samples=2000, merge_above=2000, device="cpu")
    few = {"counts": [1000, 20_000], "resolution": 32, "samples": 2000}
    bench = ScaleBench(config=config, folder=tmp_path, shape=tmp_path / "ball.ply", **few)
    rows = bench.rows(tmp_path / "out")
    assert [row.points for row in rows] == [1000, 20_000]
    assert rows[0].kept == 1000
    assert 300 < rows[1].kept <= 2000
    assert all(row.chamfer is not None and row.chamfer < 0.05 for row in rows)
    assert not list(tmp_path.glob("cloud_*"))
