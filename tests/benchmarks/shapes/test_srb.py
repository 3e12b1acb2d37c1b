"""The surface reconstruction benchmark: its distances in closed form, its folders, and its rows on two spheres."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from benches import PLACE, RADIUS, SMALL
from mplicits.datasets import read_cloud
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.neural_fields import Similarity, Sphere, extract_mesh
from mplicits.pipelines.mesh.files import write_mesh
from mplicits.pipelines.surface.surface import read_surface

from benchmarks.harness.report import as_text
from benchmarks.shapes import srb as module
from benchmarks.shapes.srb import SrbBench, distances, find_scans


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere of radius 14 around (5, 0, −1): its surface, a scan of it with normals, and one without."""
    folder = tmp_path_factory.mktemp("srb")
    write_mesh(folder / "bigball.ply", extract_mesh(Sphere(radius=RADIUS), resolution=64), PLACE)
    normals = unit_rows(np.random.default_rng(0).normal(size=(4000, 3)))
    points = PLACE.to_input(RADIUS * normals)
    np.save(folder / "big_ball_scan.npy", np.concatenate((points, normals), axis=1))
    np.save(folder / "BigBall-raw.npy", points)
    return folder


def test_distances_between_parallel_grids() -> None:
    plane = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    first = np.concatenate((plane, np.zeros((25, 1))), axis=1)
    second = np.vstack((np.column_stack((plane, np.full(25, 0.25))), [2.0, 2.0, 3.0]))  # a stray, 3 from the first
    found = distances(first, second)
    assert found.there == 0.25
    assert found.back == pytest.approx((25 * 0.25 + 3) / 26, rel=1e-15)
    assert found.hausdorff == 3


def test_scans_belong_to_the_longest_name(folder: Path, tmp_path: Path) -> None:
    found = find_scans(folder)
    assert {scan.cloud.name for scan in found} == {"big_ball_scan.npy", "BigBall-raw.npy"}
    assert {scan.truth.name for scan in found} == {"bigball.ply"}
    shutil.copy(folder / "bigball.ply", tmp_path / "big.ply")
    for path in folder.iterdir():
        shutil.copy(path, tmp_path)
    assert {scan.shape for scan in find_scans(tmp_path)} == {"bigball"}


def test_the_layout_that_is_shipped(folder: Path, tmp_path: Path) -> None:
    for name in ("scans", "ground_truth"):
        (tmp_path / name).mkdir()
    shutil.copy(folder / "big_ball_scan.npy", tmp_path / "scans" / "ball.npy")
    shutil.copy(folder / "big_ball_scan.npy", tmp_path / "ground_truth" / "ball.npy")  # dense points are a truth there
    (scan,) = find_scans(tmp_path)
    assert scan.cloud.parent.name == "scans"
    assert scan.truth.parent.name == "ground_truth"


@pytest.mark.slow
def test_rows_in_both_units(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "has_poisson", lambda: False)
    monkeypatch.setattr(module, "NORMALISED_SAMPLES", 5000)
    monkeypatch.setattr(module, "BAND_SAMPLES", 2000)
    bench = SrbBench(folder=folder, config=SMALL, resolution=48, samples=20_000)
    rows = bench.rows(tmp_path)
    asked = [(row.scan, row.normals) for row in rows if row.method == "level 1"]
    assert asked == [("BigBall-raw.npy", "none"), ("big_ball_scan.npy", "file"), ("big_ball_scan.npy", "none")]
    truth_radius = RADIUS * PLACE.scale
    for row in rows:
        assert (row.closed, row.parts) == (True, 1)
        # A sampling of another surface is no nearer than one of the truth, but for chance; and the fit is a sphere.
        assert 0.9 * row.floor < row.chamfer < row.floor + 0.02 * truth_radius
        assert row.chamfer <= row.hausdorff
        assert row.scan_chamfer < row.floor + 0.02 * truth_radius
        assert row.scan_error == pytest.approx(row.floor, rel=0.05)  # its points are on the sphere
        # Means of nearest distances fall as 1 / √samples: 5,000 in the unit sphere against 20,000 in raw units.
        assert row.normalised_floor == pytest.approx(2 * row.floor / truth_radius * 2, rel=0.05)
        assert row.sdf_error < 0.02
    ours, published = bench.tables(rows, sgemm=1e9)
    assert f"{rows[0].chamfer:.3f}" in as_text(ours)
    assert "DiGS" in as_text(published)


def test_the_error_in_the_band_is_in_the_truths_unit_sphere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "NORMALISED_SAMPLES", 1000)
    monkeypatch.setattr(module, "BAND_SAMPLES", 2000)

    judge = module._Judge(read_surface(folder / "bigball.ply"), read_cloud(folder / "BigBall-raw.npy"), 1000, 0)
    # A sphere that is 0.1 of the field's unit too small, where that unit is 40 raw ones and the truth's 14.
    field = Sphere(radius=14 / 40 - 0.1)
    error = judge.sdf_error(field, Similarity((5.0, 0.0, -1.0), 40.0), -1)
    facets = (1 - np.cos(np.pi / 64)) * 2  # how far a facet of the mesh lies inside the sphere, at most
    assert error == pytest.approx(0.1 * 40 / 14, abs=facets)
