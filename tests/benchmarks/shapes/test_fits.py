"""The fit benchmark on a small shape: every level has a row, noise is applied, Poisson joins when it is there."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from benches import SMALL
from mplicits.datasets import read_cloud
from mplicits.neural_fields import Mesh, MultiscaleSDF, Sphere, Union, extract_mesh
from mplicits.pipelines.surface.surface import components, face_normals

from benchmarks.harness.report import as_text
from benchmarks.shapes import fits as module
from benchmarks.shapes.fits import STEEPEST, FitBench, facing_camera
from benchmarks.shapes.prisms import PRISMS


@pytest.mark.slow
def test_rows_picture_and_table(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "has_poisson", lambda: False)
    monkeypatch.setattr(module, "picture_of", partial(module.picture_of, samples=1))  # a quarter of the pixels
    bench = FitBench(shapes=[ball], config=SMALL, resolution=32, samples=5000, pictures=tmp_path)
    rows = bench.rows(tmp_path / "out")
    assert [row.method for row in rows] == ["level 0", "level 1"]
    assert rows[1].seconds > rows[0].seconds > 0
    for row in rows:
        assert row.metrics.iou > 0.95
        assert row.metrics.components == 1
        assert row.metrics.chamfer < 2 * row.metrics.chamfer_floor
    assert (tmp_path / "ball.png").stat().st_size > 1000
    table = as_text(*bench.tables(rows, sgemm=1e9))
    finest = rows[1].metrics
    assert all(f"{figure:.2e}" in table for figure in (finest.chamfer, finest.chamfer - finest.chamfer_floor))


def test_blobs_go_as_mplicits_mesh_drops_them(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = module.kept_fit(tmp_path / "run", read_cloud(ball), SMALL)
    blob = Sphere(radius=0.08, center=(0.85, 0.85, 0.85))  # far from all points

    def with_blob(field: MultiscaleSDF, *, resolution: int, level: int) -> Mesh:
        return extract_mesh(Union(field.levels[level], blob), resolution=resolution)

    monkeypatch.setattr(module, "extract_mesh", with_blob)
    for kept, parts in ((replace(run, directory=None), 2), (run, 1)):
        assert components(module.timed_mesh(kept, 64, level=0)[0]) == parts


def test_noise_reaches_the_fit(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def reconstruct(self, cloud, *_):
        radii = np.linalg.norm(cloud.points - [5.0, 0.0, -1.0], axis=1)
        seen.append(abs(radii - 14.0).max())
        return []

    monkeypatch.setattr(FitBench, "reconstructions", reconstruct)
    FitBench(shapes=[ball], config=SMALL).rows(tmp_path)
    FitBench(shapes=[ball], config=SMALL, noise=0.01).rows(tmp_path)
    diagonal = 28.0 * 3**0.5
    assert seen[0] < 0.02
    assert 0.9 * 0.01 * diagonal < seen[1] < 1.01 * 0.01 * diagonal + 0.02


@pytest.mark.parametrize(
    ("normals", "methods"),
    [("auto", ["screened Poisson"]), ("estimate", ["screened Poisson", "screened Poisson, MeshLab's normals"])],
)
def test_screened_poisson_when_installed(ball: Path, tmp_path: Path, normals: str, methods: list[str]) -> None:
    pytest.importorskip("pymeshlab", reason="the extra mplicits[poisson] is not installed")
    config = replace(SMALL, normals=normals)
    rows = FitBench(shapes=[ball], config=config, resolution=32, samples=5000, poisson_depth=6).rows(tmp_path)
    assert [row.method for row in rows] == ["level 0", "level 1", *methods]
    assert rows[-1].metrics.iou > 0.95


def test_the_camera_faces_the_widest_side() -> None:
    gear = Mesh(*PRISMS["gear"]())  # the two flat sides
    normals, areas = face_normals(gear)
    flat = normals[((normals @ normals.T > 0.999) @ areas).argmax()]
    assert float(facing_camera(gear).forward @ torch.from_numpy(flat)) == pytest.approx(-1, abs=1e-6)
    # Of a slab that lies the camera stands a little before it, not in its axis: up would have no direction.
    slab = Mesh(np.array([[-2.0, 0, -1], [2, 0, -1], [2, 0, 1], [-2, 0, 1]]), np.array([[0, 2, 1], [0, 3, 2]]))
    down = facing_camera(slab).forward
    assert float(down[1]) == pytest.approx(-np.sin(np.radians(STEEPEST)), abs=1e-6)
