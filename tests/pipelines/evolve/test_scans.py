"""Clouds and meshes as shapes: each is fitted once, and poses of one mesh are landmarks of each other."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from evolutions import QUICK, fails
from mplicits.neural_fields import Similarity, Sphere, save_field
from mplicits.neural_fields.backend.files import write_json
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.evolve import scans
from mplicits.pipelines.evolve.scans import fitted_scans, scans_among
from mplicits.pipelines.evolve.shapes import read_landmarks
from mplicits.pipelines.surface.surface import read_surface
from mplicits.pipelines.training.folder import FIELD_FILE, RECORD_FILE, read_record
from mplicits.pipelines.training.settings import FitConfig

FITS = FitConfig(widths=(16,), depths=(1,), omegas=(4.0,), steps=(30,), learning_rates=(1e-2,), batch=256, samples=1000)


def ball_for(file: Path, config: FitConfig, *, out: Path, **_: object) -> None:
    """In place of a fit: the ball around the vertices, as a finished run."""
    out.mkdir(parents=True, exist_ok=True)
    similarity = Similarity.to_unit_sphere(read_surface(file).vertices)
    save_field(out / FIELD_FILE, Sphere(radius=1.0), similarity=similarity)
    record = {"finished": True, "cloud": str(file.absolute()), "config": asdict(config)}
    write_json(out / RECORD_FILE, record)


SHIFT = np.array([0.3, 0.1, 0.0])


@pytest.fixture
def poses(tmp_path) -> list[str]:
    """A ball of 162 vertices, and the same one stretched and moved."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    files = [str(tmp_path / f"{name}.ply") for name in ("first", "second")]
    for file, vertices in zip(files, (ball.vertices, ball.vertices * [1.0, 1.2, 0.9] + SHIFT), strict=True):
        trimesh.Trimesh(vertices, ball.faces, process=False).export(file)
    return files


def test_poses_of_one_mesh_are_fitted_once_and_are_landmarks(poses: list[str], tmp_path, monkeypatch):
    monkeypatch.setattr(scans, "fit", ball_for)
    config = replace(QUICK, kind="deform", velocity=(0.0, 0.0, 0.0), shapes=(poses[0], poses[1], "sphere:0.4"))
    found = scans_among(config.shapes)
    assert list(found) == poses
    folder = tmp_path / "run-fits"
    fitted = fitted_scans(config, found, folder, FITS)
    assert fitted.shapes == (str(folder / "00-first"), str(folder / "01-second"), "sphere:0.4")
    assert fitted.landmarks == ()  # a formula has no vertices
    kept = [(folder / name / FIELD_FILE).stat().st_mtime_ns for name in ("00-first", "01-second")]
    two = replace(config, shapes=tuple(poses))
    (pairs,) = fitted_scans(two, found, folder, FITS).landmarks
    assert [(folder / name / FIELD_FILE).stat().st_mtime_ns for name in ("00-first", "01-second")] == kept
    before, after = read_landmarks(pairs)
    assert 20 < len(before) < 162  # a ball is not the one that was stretched
    assert np.abs(before * [1.0, 1.2, 0.9] + SHIFT - after).max() < 1e-6  # nine digits, and float32 in the files
    own = replace(two, landmarks=("mine.txt",))
    assert fitted_scans(own, found, folder, FITS).landmarks == ("mine.txt",)
    assert fitted_scans(replace(two, kind="morph"), found, folder, FITS).landmarks == ()
    again: list[Path] = []
    monkeypatch.setattr(scans, "fit", lambda file, *_, **__: again.append(file))
    fitted_scans(two, found, folder, replace(FITS, seed=1))
    assert [str(file) for file in again] == poses


def test_other_faces_and_clouds_are_no_poses(poses: list[str], tmp_path, monkeypatch):
    monkeypatch.setattr(scans, "fit", lambda *_, **__: None)
    monkeypatch.setattr(scans, "_on_fit", lambda _run, vertices: np.zeros(len(vertices), bool))
    config = replace(QUICK, kind="deform", velocity=(0.0, 0.0, 0.0), shapes=tuple(poses))
    assert fitted_scans(config, scans_among(poses), tmp_path / "fits", FITS).landmarks == ()  # lost by the fits
    monkeypatch.setattr(scans, "_on_fit", lambda _run, vertices: np.ones(len(vertices), bool))
    mesh = trimesh.load_mesh(poses[1], process=False)
    trimesh.Trimesh(mesh.vertices, mesh.faces[::-1], process=False).export(poses[1])
    assert fitted_scans(config, scans_among(poses), tmp_path / "fits", FITS).landmarks == ()
    for file in poses:
        trimesh.PointCloud(mesh.vertices).export(file)
    assert fitted_scans(config, scans_among(poses), tmp_path / "fits", FITS).landmarks == ()


@pytest.mark.slow
def test_a_series_of_scans_on_the_command_line(poses: list[str], tmp_path, capsys):
    fits = tmp_path / "fits.yaml"
    fits.write_text(
        "widths: [16]\ndepths: [1]\nomegas: [4]\nsteps: [30]\nlearning_rates: [1.0e-2]\nbatch: 256\nsamples: 1000\n"
    )
    flags = (
        "--widths 16 --depths 1 --omegas 5 --steps 5 --learning-rates 1e-3 --data-weights 100 --start-steps 5 "
        "--batch 64 --samples 500 --frames 2 --resolution 16 --motion-steps 3 --motion-width 8 --quiet"
    )
    run = tmp_path / "run"
    line = f"evolve {' '.join(poses)} --kind deform --align none --fits {fits} -o {run} {flags}"
    assert main(line.split()) == 0
    told = capsys.readouterr().out
    assert f"{tmp_path / 'run-fits'}: the fits of {poses[0]}, {poses[1]}" in told
    assert "vertices are landmarks" in told
    record = read_record(run)
    assert record["config"]["landmarks"] == [str(tmp_path / "run-fits" / "pairs-00.txt")]
    assert record["finished"]


def test_bad_scans_are_named(tmp_path, capsys):
    bad = tmp_path / "bad.ply"
    bad.write_text("no ply")
    assert str(bad) in fails(capsys, f"evolve {bad} sphere -o {tmp_path / 'run'}")
