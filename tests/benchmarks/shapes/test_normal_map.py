import dataclasses
import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from evolutions import fails
from mplicits.datasets import turntable
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.neural_fields import Field, MultiscaleSDF, Similarity, Siren, Sphere, extract_mesh, save_field
from mplicits.neural_fields.checkpoint import SavedField
from mplicits.pipelines.mesh.files import write_mesh

from benchmarks.cli import main
from benchmarks.paper.isolation import IndependentLevels
from benchmarks.shapes import normal_map as module
from benchmarks.shapes.normal_map import NormalMapBench

RADIUS = 0.6
PLACE = Similarity((400.0, -20.0, 3.0), 25.0)
MAPPED = " + normals of level 1"
METHODS = ["level 0", "level 0" + MAPPED, "mesh of level 0", "mesh of level 0" + MAPPED, "level 1"]
VIEW = {"size": 64, "views": 2, "resolution": 96, "repeats": 1, "device": "cpu"}


def bumpy_ball() -> MultiscaleSDF:
    """A residual of small waves with slopes of about a third."""
    torch.manual_seed(3)
    waves = Siren(16, 1, omega=18.0).requires_grad_(False)
    waves.output.weight.uniform_(-0.012, 0.012)
    waves.output.bias.zero_()
    return MultiscaleSDF(Sphere(radius=RADIUS), [waves], [0.2])


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Makes a field what the bench reads, and the mesh of one of its levels the reference."""

    def prepare(field: Field, level: int) -> NormalMapBench:
        monkeypatch.setattr(module, "find_field", Path)
        (tmp_path / "run").write_bytes(b"")
        monkeypatch.setattr(module, "load_field", lambda *_, **__: SavedField(field, PLACE, {}))
        write_mesh(tmp_path / "reference.ply", extract_mesh(field, resolution=128, level=level), PLACE)
        return NormalMapBench(run_file=tmp_path / "run", reference=tmp_path / "reference.ply", **VIEW)

    return prepare


def test_the_level_that_is_the_original_has_no_error(opened, tmp_path):
    rows = opened(bumpy_ball(), 0).rows(tmp_path / "out")
    assert [row.method for row in rows] == METHODS
    for row in rows:
        if row.method in ("level 0", "mesh of level 0"):
            assert row.degrees < 0.3
            assert math.sqrt(row.error.both) < 3e-3
            assert row.error.pixels_either - row.error.pixels_both < 30
        else:
            assert row.degrees > 3
            assert math.sqrt(row.error.both) > 0.02


def test_mapped_normals_are_between_the_levels(opened, tmp_path):
    bench = dataclasses.replace(opened(bumpy_ball(), 1), picture=tmp_path / "sheet.png")
    rows = bench.rows(tmp_path / "out")
    coarse, mapped, coarse_mesh, mapped_mesh, fine = rows
    assert fine.degrees < 1
    assert math.sqrt(fine.error.both) < 0.01
    assert fine.degrees < mapped.degrees < 0.5 * coarse.degrees
    assert fine.error.both < mapped.error.both < 0.7 * coarse.error.both
    assert mapped_mesh.error.both == pytest.approx(mapped.error.both, rel=0.3)
    assert coarse_mesh.error.both == pytest.approx(coarse.error.both, rel=0.1)
    # Only tracing the finer level mends the silhouette.
    assert mapped.error.pixels_either == coarse.error.pixels_either > fine.error.pixels_either
    assert iio.imread(tmp_path / "sheet.png").shape == (2 * (64 + 40), 6 * (64 + 12), 3)


def test_the_angle_between_normals_in_closed_form(opened, tmp_path):
    shifted = IndependentLevels([Sphere(radius=RADIUS), Sphere(radius=RADIUS, center=(0.0, 0.15, 0.0))], [math.inf])
    rows = opened(shifted, 0).rows(tmp_path / "out")
    outline = extract_mesh(Sphere(radius=RADIUS), resolution=128).vertices
    angles = []
    for camera in turntable(outline, 2, width=64, height=64):
        eye, directions = (rays.numpy() for rays in camera.rays(dtype=torch.float64))
        middle = directions @ eye
        inside = middle**2 - eye @ eye + RADIUS**2
        hit = (eye + (-middle - np.sqrt(inside.clip(0)))[..., None] * directions)[inside > 0]
        cosine = (unit_rows(hit) * unit_rows(hit - [0.0, 0.15, 0.0])).sum(axis=1)
        angles.append(np.degrees(np.arccos(cosine.clip(-1, 1))))
    assert rows[1].degrees == pytest.approx(np.concatenate(angles).mean(), rel=5e-3)


def test_the_command(tmp_path, capsys):
    field = MultiscaleSDF(Siren(8, 1, omega=2.0), [Siren(8, 1, omega=2.0, output_gain=0.1)], [0.2])
    save_field(tmp_path / "field.safetensors", field)
    mesh = extract_mesh(field, resolution=48, level=0)
    write_mesh(tmp_path / "reference.ply", mesh, Similarity.identity())
    command = f"normal-map {tmp_path} {tmp_path / 'reference.ply'} --size 48 --views 1 --resolution 48 --repeats 1"
    sheet, figures = tmp_path / "sheet.png", tmp_path / "figures.json"
    assert main(f"{command} --device cpu -o {sheet} --json {figures}".split()) == 0
    assert "mesh of level 0 + normals of level 1" in capsys.readouterr().out
    (record,) = json.loads(figures.read_text())["records"]
    assert [row["method"] for row in record["outputs"]] == METHODS
    assert sheet.stat().st_size > 500
    assert "'.gif'" in fails(capsys, f"{command} -o {tmp_path / 'sheet.gif'}", main)
