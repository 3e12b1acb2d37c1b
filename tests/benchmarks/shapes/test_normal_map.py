"""The normal mapping benchmark on fields whose surfaces are known."""

import dataclasses
import json
import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from mplicits.datasets import turntable
from mplicits.neural_fields import Field, MultiscaleSDF, Similarity, Siren, Sphere, extract_mesh, save_field
from mplicits.neural_fields.checkpoint import SavedField
from mplicits.pipelines.mesh.files import write_mesh

from benchmarks.cli import main
from benchmarks.shapes import normal_map as module
from benchmarks.shapes.normal_map import NormalMapBench

RADIUS = 0.6
PLACE = Similarity((400.0, -20.0, 3.0), 25.0)
METHODS = [
    "level 0",
    "level 0 + normals of level 1",
    "mesh of level 0",
    "mesh of level 0 + normals of level 1",
    "level 1",
]
VIEW = {"size": 64, "views": 2, "resolution": 96, "repeats": 1, "device": "cpu"}


def bumps() -> Siren:
    """A residual of small waves with slopes of about a third."""
    torch.manual_seed(3)
    waves = Siren(16, 1, omega=18.0)
    with torch.no_grad():
        waves.output.weight.uniform_(-0.012, 0.012)
        waves.output.bias.zero_()
    return waves.requires_grad_(False)


def bumpy_ball() -> MultiscaleSDF:
    return MultiscaleSDF(Sphere(radius=RADIUS), [bumps()], [0.2])


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
    exact = {row.method: row for row in rows}
    for method in ("level 0", "mesh of level 0"):
        assert exact[method].degrees < 0.3
        assert math.sqrt(exact[method].error.both) < 3e-3
        assert exact[method].error.pixels_either - exact[method].error.pixels_both < 30
    for method in ("level 0 + normals of level 1", "mesh of level 0 + normals of level 1", "level 1"):
        assert exact[method].degrees > 3
        assert math.sqrt(exact[method].error.both) > 0.02


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
    class Shifted(Field):
        """A sphere whose second level has the gradient of a sphere about another point."""

        def __init__(self) -> None:
            super().__init__()
            self.in_dim, self.num_levels = 3, 2
            self.register_buffer("deltas", torch.tensor([1.0]))
            self.levels = (Sphere(radius=RADIUS), Sphere(radius=RADIUS, center=(0.0, 0.15, 0.0)))

        def value(self, x, *, level=-1):
            return self.levels[self.resolve_level(level)].value(x)

        def jet(self, x, *, level=-1):
            return self.levels[self.resolve_level(level)].jet(x)

        def in_band(self, x, *, level):
            return torch.ones_like(x[..., 0], dtype=torch.bool)

    rows = opened(Shifted(), 0).rows(tmp_path / "out")
    outline = extract_mesh(Sphere(radius=RADIUS), resolution=128).vertices
    angles = []
    for camera in turntable(outline, 2, width=64, height=64):
        eye, directions = (rays.numpy() for rays in camera.rays(dtype=torch.float64))
        middle = directions @ eye
        inside = middle**2 - eye @ eye + RADIUS**2
        hit = (eye + (-middle - np.sqrt(inside.clip(0)))[..., None] * directions)[inside > 0]
        other = hit - [0.0, 0.15, 0.0]
        cosine = (hit * other).sum(axis=1) / np.linalg.norm(hit, axis=1) / np.linalg.norm(other, axis=1)
        angles.append(np.degrees(np.arccos(cosine.clip(-1, 1))))
    assert rows[1].degrees == pytest.approx(np.concatenate(angles).mean(), rel=5e-3)


def test_the_command(tmp_path, capsys):
    field = MultiscaleSDF(Siren(8, 1, omega=2.0), [Siren(8, 1, omega=2.0, output_gain=0.1)], [0.2])
    save_field(tmp_path / "field.safetensors", field)
    mesh = extract_mesh(field, resolution=48, level=0)
    write_mesh(tmp_path / "reference.ply", mesh, Similarity.identity())
    command = ["normal-map", str(tmp_path), str(tmp_path / "reference.ply"), "--size", "48", "--views", "1"]
    command += ["--resolution", "48", "--repeats", "1", "--device", "cpu"]
    files = ["-o", str(tmp_path / "sheet.png"), "--json", str(tmp_path / "figures.json")]
    assert main([*command, *files]) == 0
    assert "mesh of level 0 + normals of level 1" in capsys.readouterr().out
    (record,) = json.loads((tmp_path / "figures.json").read_text())["records"]
    assert [row["method"] for row in record["outputs"]] == METHODS
    assert (tmp_path / "sheet.png").stat().st_size > 500
    assert main([*command, "-o", str(tmp_path / "sheet.gif")]) == 2
    assert "unknown extension '.gif'" in capsys.readouterr().err
