"""Training textures: exact colours on exact surfaces, the term along the normals, bad input, runs and the command."""

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from fits import interrupt
from mplicits import neural_fields
from mplicits.datasets import PointCloud, write_cloud_ply
from mplicits.neural_fields import InputError, MultiscaleSDF, Similarity, Siren, Sphere, load_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.cli.train import TEXTURE as COMMAND
from mplicits.pipelines.texture.train import default_delta, fit_texture, read_colors, texture_of, texture_run
from mplicits.pipelines.training.folder import TEXTURE_FILE, read_record, texture_state_file
from mplicits.pipelines.training.progress import Lines
from mplicits.pipelines.training.settings import TextureConfig
from numpy.typing import NDArray

SMALL = TextureConfig(
    width=48, depth=2, omega=15.0, steps=250, learning_rate=3e-3, batch=1024, band_batch=512, samples=4000, delta=0.1
)
BRIEF = replace(SMALL, steps=3)
HERE = Similarity((5.0, 0.0, 0.0), 1.0)  # of the runs below


def directions(count: int) -> NDArray[np.float64]:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def painted(unit: NDArray[np.float64]) -> NDArray[np.float32]:
    """A colour for every direction."""
    return (0.5 + 0.4 * np.sin(4 * unit + np.array([0.0, 1.0, 2.0]))).astype(np.float32)


def sphere_cloud(count: int = 4000) -> PointCloud:
    unit = directions(count)
    return PointCloud(0.5 * unit, colors=painted(unit), source="ball.ply")


def psnr(found: torch.Tensor, expected: NDArray[np.float32]) -> float:
    return -10 * math.log10(float(((found.numpy() - expected) ** 2).mean()))


def test_colors_of_a_sphere_on_it_and_on_shifted_surfaces() -> None:
    fitted = fit_texture(Sphere(radius=0.5), sphere_cloud(), SMALL)
    unit = directions(3000)[::-1].copy()
    for radius in (0.42, 0.5, 0.58):  # in the band, with half-width 0.1
        x = torch.from_numpy((radius * unit).astype(np.float32))
        assert fitted.texture.in_band(x).all()
        assert psnr(fitted.texture.value(x), painted(unit)) > 32
    for radius in (0.3, 0.9):  # outside
        colors, reached = neural_fields.map_colors(fitted.texture, torch.from_numpy((radius * unit).astype(np.float32)))
        assert reached.all()
        assert psnr(colors, painted(unit)) > 32
    assert (fitted.record["finished"], fitted.record["steps"], fitted.record["left_out"]) == (True, 250, 0)
    at_points = fitted.texture.value(torch.from_numpy(sphere_cloud().points.astype(np.float32)))
    assert fitted.record["psnr_at_points"] == pytest.approx(psnr(at_points, painted(directions(4000))), abs=0.01)


@pytest.mark.slow
def test_the_second_term_makes_colors_constant_along_normals() -> None:
    unit = directions(2000)
    x = torch.from_numpy((0.57 * unit).astype(np.float32))
    slopes = []
    for weight in (0.0, 1.0):
        texture = fit_texture(Sphere(radius=0.5), sphere_cloud(), replace(SMALL, tangential_weight=weight)).texture
        along = texture.jet(x).gradient @ (x / x.norm(dim=-1, keepdim=True))[..., None]
        slopes.append(float(along.square().mean().sqrt()))
    assert slopes[1] < 0.2 * slopes[0]


def test_points_are_in_input_coordinates() -> None:
    similarity, cloud = Similarity((400_000.0, 5_600_000.0, 100.0), 25.0), sphere_cloud()
    moved = replace(cloud, points=similarity.to_input(cloud.points))
    there = fit_texture(Sphere(radius=0.5), moved, BRIEF, similarity=similarity)
    assert there.record["left_out"] == 0
    here = fit_texture(Sphere(radius=0.5), cloud, BRIEF)
    x = torch.from_numpy(cloud.points[:100].astype(np.float32))
    # Rounding moves the samples a little.
    torch.testing.assert_close(there.texture.value(x), here.texture.value(x), rtol=0, atol=1e-3)


def test_the_callers_random_state_and_geometry_are_left_alone() -> None:
    geometry, before = plane_field(), torch.random.get_rng_state()
    fitted = fit_texture(geometry, plane_cloud(center=0.0), BRIEF)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert fitted.texture.geometry is geometry
    assert all(parameter.grad is None and parameter.requires_grad for parameter in geometry.parameters())
    assert not any(parameter.requires_grad for parameter in fitted.texture.network.parameters())


@pytest.mark.parametrize(
    ("points", "distance"),
    [
        pytest.param(lambda p: 3 * p, "1", id="three times as large"),
        pytest.param(lambda p: p + 100.0, "173", id="elsewhere"),
        pytest.param(lambda p: 0.02 * p, "0.49", id="metres for millimetres"),
    ],
)
def test_another_shape_or_scale_is_refused(points: Callable[[Any], Any], distance: str) -> None:
    cloud = replace(sphere_cloud(), points=points(sphere_cloud().points))
    with pytest.raises(InputError, match=rf"ball\.ply: points: 0% .*half are further off than {distance}[^\n]*$"):
        fit_texture(Sphere(radius=0.5), cloud, BRIEF)


def test_a_part_outside_the_band_is_left_out_and_counted() -> None:
    cloud = sphere_cloud(1000)
    points = cloud.points.copy()
    points[:100] *= 1.5
    points[100] = np.nan
    assert fit_texture(Sphere(radius=0.5), replace(cloud, points=points), BRIEF).record["left_out"] == 101


def test_a_geometry_in_double_precision_gets_a_texture_in_it() -> None:
    texture = fit_texture(plane_field().double(), plane_cloud(center=0.0), BRIEF).texture
    assert texture.value(torch.zeros(4, 3, dtype=torch.float64)).dtype == torch.float64


def test_a_time_budget_ends_the_training() -> None:
    fitted = fit_texture(Sphere(radius=0.5), sphere_cloud(), replace(SMALL, steps=1_000_000, time_budget=0.3))
    assert fitted.record["finished"]
    assert 0 < fitted.record["steps"] < 1_000_000
    assert fitted.record["training_seconds"] < 2


@pytest.mark.parametrize(("deltas", "expected"), [([], 0.05), ([0.06, 0.01], 0.06), ([0.006, 0.001], 0.02)])
def test_the_band_that_is_chosen(deltas: list[float], expected: float) -> None:
    field = MultiscaleSDF(Sphere(), [Siren(4, 1) for _ in deltas], deltas) if deltas else Sphere()
    assert default_delta(field) == pytest.approx(expected)


def plane_field() -> MultiscaleSDF:
    """A network that is nearly ``f(x) = z``: ten times the sine of z / 10."""
    network = Siren(4, 1, omega=1.0)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        network.layers[0].weight[0, 2] = 0.1
        network.output.weight[0, 0] = 10.0
    return MultiscaleSDF(network, [], [])


def plane_cloud(count: int = 2000, *, colors: bool = True, center: float = 5.0) -> PointCloud:
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (count, 3)) * np.array([1, 1, 0])
    return PointCloud(points + np.array([center, 0.0, 0.0]), colors=painted(points) if colors else None)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    directory = tmp_path / "run"
    directory.mkdir()
    neural_fields.save_field(directory / "field.safetensors", plane_field(), similarity=HERE)
    (directory / "run.json").write_text(json.dumps({"config": {}, "cloud": "plane.ply"}))
    return directory


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    write_cloud_ply(tmp_path / "plane.ply", plane_cloud())
    return tmp_path / "plane.ply"


def test_a_run_gets_its_texture(run: Path, cloud: Path) -> None:
    geometry = load_field(run / "field.safetensors").field
    assert texture_of(run, geometry) is None
    fitted = texture_run(run, cloud, SMALL)
    points = plane_cloud(center=0.0).points
    x = torch.from_numpy(points.astype(np.float32))
    found = texture_of(run, geometry).value(x)
    assert torch.equal(found, fitted.texture.value(x))
    assert psnr(found, painted(points)) > 30
    record = read_record(run)
    assert record["cloud"] == "plane.ply"
    assert record["texture"] == json.loads(json.dumps(fitted.record))
    assert {path.stem for path in run.iterdir()} == {"field", "run", "texture"}


def test_another_place_leaves_the_run_as_it_is(run: Path, cloud: Path, tmp_path: Path) -> None:
    before = (run / "run.json").read_text()
    texture_run(run, cloud, BRIEF, out=tmp_path / "other.safetensors")
    assert (run / "run.json").read_text() == before
    assert not (run / TEXTURE_FILE).exists()
    geometry = load_field(run / "field.safetensors").field
    assert neural_fields.load_texture(tmp_path / "other.safetensors", geometry).num_levels == 1


def test_an_interrupted_training_leaves_a_usable_texture_and_continues_to_the_same(run: Path, cloud: Path) -> None:
    config = replace(SMALL, steps=60)
    whole = texture_run(run, cloud, config, out=run.parent / "whole.safetensors").texture
    texture_run(run, cloud, config, progress=interrupt("texture", 20))
    record = read_record(run)["texture"]
    assert not record["finished"]
    assert 20 <= record["steps"] < 60
    partial = texture_of(run, load_field(run / "field.safetensors").field)
    x = torch.rand(100, 3) * torch.tensor([1.0, 1.0, 0.05])
    assert partial.value(x).isfinite().all()
    assert texture_state_file(run / TEXTURE_FILE).is_file()
    resumed = texture_run(run, cloud, BRIEF, level=7, resume=True)  # its own settings and level count
    assert torch.equal(resumed.texture.value(x), whole.value(x))
    assert resumed.record["config"]["steps"] == 60
    assert not texture_state_file(run / TEXTURE_FILE).exists()
    record = read_record(run)["texture"]
    assert (record["finished"], record["steps"]) == (True, 60)


def test_a_training_is_not_continued_with_other_colours_or_another_field(run: Path, cloud: Path) -> None:
    texture_run(run, cloud, replace(SMALL, steps=60), progress=interrupt("texture", 20))
    state = texture_state_file(run / TEXTURE_FILE)
    kept = state.read_bytes()
    other = plane_cloud()
    write_cloud_ply(run.parent / "other.ply", replace(other, colors=other.colors[::-1]))
    with pytest.raises(InputError, match="not the colours"):
        texture_run(run, run.parent / "other.ply", resume=True)
    bent = plane_field()
    with torch.no_grad():
        next(bent.parameters()).add_(1e-3)
    before = (run / "field.safetensors").read_bytes()
    neural_fields.save_field(run / "field.safetensors", bent, similarity=HERE)
    with pytest.raises(InputError, match="not the field"):
        texture_run(run, cloud, resume=True)
    (run / "field.safetensors").write_bytes(before)
    state.write_bytes(kept[:-100])
    with pytest.raises(InputError, match=r"resume\.safetensors: damaged"):
        texture_run(run, cloud, resume=True)
    state.write_bytes(kept)
    texture_run(run, cloud, resume=True)
    with pytest.raises(InputError, match="nothing to resume"):
        texture_run(run, cloud, resume=True)


def square(path: Path, *, colors: bool = True) -> Path:
    """A PLY mesh of two triangles, red at x = 4.5 and black at x = 5.5."""
    vertices = np.array([[4.5, -0.5, 0], [5.5, -0.5, 0], [5.5, 0.5, 0], [4.5, 0.5, 0]])
    red = [[255, 0, 0], [0, 0, 0], [0, 0, 0], [255, 0, 0]] if colors else None
    trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], vertex_colors=red, process=False).export(path)
    return path


def test_meshes_are_sampled_and_clouds_are_not(tmp_path: Path, cloud: Path) -> None:
    assert len(read_colors(cloud, samples=123, seed=0)) == 2000
    mesh = read_colors(square(tmp_path / "square.ply"), samples=123, seed=0)
    assert len(mesh) == 123
    np.testing.assert_allclose(mesh.colors[:, 1:], 0, atol=1e-6)
    assert np.corrcoef(mesh.colors[:, 0], mesh.points[:, 0])[0, 1] < -0.9
    points = tmp_path / "points.obj"
    points.write_text("".join(f"v {5 + i / 20} {i * i / 400} 0 1 0.5 0\n" for i in range(12)))
    assert len(read_colors(points, samples=123, seed=0)) == 12
    square(tmp_path / "bare.ply", colors=False)
    write_cloud_ply(tmp_path / "grey.ply", plane_cloud(colors=False))
    for name, wrong in (("bare.ply", "vertex colours"), ("grey.ply", "colors"), ("none.obj", "no such file")):
        with pytest.raises(InputError, match=rf"{name}: .*{wrong}"):
            read_colors(tmp_path / name, samples=10, seed=0)


def command(*words: object) -> int:
    parser = argparse.ArgumentParser()
    COMMAND.add_arguments(parser)
    return COMMAND.run(parser.parse_args([str(word) for word in words]))


QUICK = ("--quiet", "--steps", "2", "--width", "16", "--depth", "1", "--samples", "1000")


def test_the_command(run: Path, cloud: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(run, cloud, *QUICK) == 0
    printed = capsys.readouterr()
    assert f"{run / TEXTURE_FILE}: (16, 1), 115 parameters, 2 steps" in printed.out
    assert printed.err == ""
    before = (run / TEXTURE_FILE).read_bytes()
    with pytest.raises(InputError, match=r"texture\.safetensors: exists; --force replaces it"):
        command(run, cloud, *QUICK)
    assert (run / TEXTURE_FILE).read_bytes() == before
    points = plane_cloud().points
    points[:37, 2] = 0.3
    write_cloud_ply(cloud, replace(plane_cloud(), points=points))
    assert command(run, cloud, *QUICK, "--force", "--seed", 5) == 0
    assert (run / TEXTURE_FILE).read_bytes() != before
    assert "warning: 37 of 2,000 points" in capsys.readouterr().err


def test_the_command_resumes(
    run: Path, cloud: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"texture\.safetensors: was not begun, so there is nothing to resume"):
        command(run, cloud, "--resume")
    words = ("--steps", "60", "--width", "16", "--depth", "1", "--samples", "1000")
    with monkeypatch.context() as patch:
        patch.setattr(Lines, "__call__", lambda self, progress, /: interrupt("texture", 20)(progress))
        assert main(["texture", str(run), str(cloud), *words]) == 130
    said = capsys.readouterr().err
    assert f"to continue: mplicits texture {run} {cloud} --resume" in said
    with pytest.raises(InputError, match="exists; --resume continues it, --force replaces it"):
        command(run, cloud, *words)
    (run / TEXTURE_FILE).unlink()
    with pytest.raises(InputError, match="an interrupted training; --resume continues it, --force replaces it"):
        command(run, cloud, *words)
    with pytest.raises(InputError, match="--resume: continues with the run's own settings"):
        command(run, cloud, "--resume", "--steps", 7)
    assert command(run, cloud, "--resume", "--quiet") == 0
    assert "(16, 1), 115 parameters, 60 steps" in capsys.readouterr().out
    with pytest.raises(InputError, match=r"texture\.safetensors: is finished, so there is nothing to resume"):
        command(run, cloud, "--resume")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("RUN CLOUD --preset fsat", "no preset 'fsat' for texture"),
        ("RUN CLOUD --steps many", "--steps: got 'many', expected a whole number"),
        ("RUN CLOUD -o texture.png", "unknown extension"),
        ("RUN CLOUD -o RUN/field.safetensors --force", "is the field itself"),
        ("RUN CLOUD --level 1", r"--level 1: .*field\.safetensors has levels 0 to 0"),
        ("none CLOUD", "no such run"),
    ],
)
def test_the_command_refuses_bad_words_before_any_work(run: Path, cloud: Path, words: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        command(*words.replace("RUN", str(run)).replace("CLOUD", str(cloud)).split())
    assert {path.stem for path in run.iterdir()} == {"field", "run"}
