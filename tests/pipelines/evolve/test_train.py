"""Evolutions from shapes to run directories: they learn, they are judged, they are interrupted and resumed."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from evolutions import BRIEF, QUICK, ball, fails, few_points, interrupt
from mplicits.neural_fields import InputError, Moving, MultiscaleSDF, RigidMotion, Siren, Sphere, at_time, load_field
from mplicits.pipelines.cli.entry import main
from mplicits.pipelines.evolve.checks import check_evolution, slope_figures
from mplicits.pipelines.evolve.problem import End
from mplicits.pipelines.evolve.samples import band_points
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.training.settings import EvolveConfig, load_config, preset_names
from mplicits.pipelines.training.trainer import Interrupted

from benchmarks.motion.figures import ShrinkingSphere

TRAVEL = RigidMotion(velocity=(0.4, 0.0, 0.0))
FLAGS = (
    "--widths 16 --depths 1 --omegas 5 --steps 5 --learning-rates 1e-3 --data-weights 100 --start-steps 5 --batch 64 "
    "--samples 500 --frames 2 --resolution 16 --quiet"
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        few_points(patch)
        evolve(BRIEF, out=directory)
    return directory


def test_a_travelling_sphere_is_learnt():
    field = evolve(QUICK).field
    points = torch.nn.functional.normalize(torch.randn(3000, 3), dim=1) * 0.4 + torch.tensor([-0.2, 0.0, 0.0])
    time = torch.rand(3000)
    assert field.value(at_time(TRAVEL.forward(points, time), time)).abs().mean() < 5e-3
    assert slope_figures(field)["mean"] == pytest.approx(1, abs=0.05)


def test_the_second_level_improves_on_the_first(finished: Path):
    record = json.loads((finished / "run.json").read_text())
    first, second = record["stages"]
    assert second["rms_at_ends"] < first["rms_at_ends"]
    assert second["delta"] >= 0.05
    assert first["parameters"] == 16 * 5 + 17
    assert record["parameters"] == 2 * first["parameters"]


def test_points_of_a_band_are_spread_over_it():
    truth = ShrinkingSphere(radius=0.8, alpha=0.1)
    points = band_points(truth, 4000, 0.2, torch.Generator().manual_seed(0))
    value = truth.value(points)
    assert 3000 < len(points) <= 4000
    assert value.abs().max() < 0.2 + 1e-3
    assert [float(x) for x in value.histc(4, -0.2, 0.2) / len(value)] == pytest.approx([0.25] * 4, abs=0.03)
    assert [float(x) for x in points[:, 3].histc(4, 0, 1) / len(value)] == pytest.approx([0.25] * 4, abs=0.12)


def test_points_of_a_residual_band_lie_in_it():
    field = MultiscaleSDF(ShrinkingSphere(radius=0.8, alpha=0.1), [Siren(16, 1, omega=5.0, in_dim=4)], [0.05])
    points = band_points(field, 2000, 0.05, torch.Generator().manual_seed(0), level=1)
    assert len(points) > 500
    assert bool(field.in_band(points, level=1).all())


def test_the_checks_of_an_exact_field():
    truth = ShrinkingSphere(radius=0.8, alpha=0.12)
    unit = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1)
    other = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1)
    checks = check_evolution(truth, [End("ball", 1.0, 0.4 * unit, 0.4 * other)], frames=3, resolution=48)
    for frame, radius in zip(checks["frames"], (0.8, math.sqrt(0.64 - 0.24), 0.4), strict=True):
        assert frame["volume"] == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.01)
        assert frame["components"] == 1
        assert frame["slope_error"] < 1e-5
    (end,) = checks["ends"]
    assert end["max_value"] < 1e-5
    assert end["ratio"] == pytest.approx(1, abs=0.2)
    assert checks["slopes"]["mean"] == pytest.approx(1, abs=1e-5)
    assert checks["warnings"] == []


def test_empty_frames_and_missed_ends_are_warned_about():
    nothing = Moving(Sphere(radius=0.1, center=(9.0, 0.0, 0.0)), TRAVEL)
    points = torch.rand(100, 3)
    checks = check_evolution(nothing, [End("ball", 0.0, points, points)], frames=4, resolution=16)
    assert [frame["components"] for frame in checks["frames"]] == [0] * 4
    empty, missed = checks["warnings"]
    assert empty.startswith("no surface at 4 of 4 times, the first at t = 0")
    assert missed.startswith("ball is not met at t = 0 (nothing is there)")
    others = torch.rand(100, 3)
    end = End("ball", 0.0, 0.5 * points, 0.5 * others)
    wrong = check_evolution(ShrinkingSphere(radius=0.8, alpha=0.1), [end], frames=2, resolution=24)
    assert "sampling floor" in wrong["warnings"][0]


def test_a_run_holds_its_field_and_its_record(finished: Path):
    field, _, metadata = load_field(finished / "field.safetensors")
    assert field.num_levels == 2
    assert {path.name for path in finished.iterdir()} == {"field.safetensors", "run.json", "run.lock"}
    record = json.loads((finished / "run.json").read_text())
    assert record["finished"]
    assert record["placements"][0]["shift"] == [-0.2, 0.0, 0.0]
    assert len(record["checks"]["frames"]) == 3
    assert [end["time"] for end in record["checks"]["ends"]] == [0.0, 1.0]
    assert load_config(EvolveConfig, None, record["config"]) == BRIEF
    assert metadata["run"]["kind"] == "transport"


@pytest.mark.parametrize(("stage", "step"), [("level 0", 40), ("level 1", 20), ("checks", 1)])
def test_an_interrupted_run_resumes_to_the_same_field(finished: Path, tmp_path, stage: str, step: int):
    directory = tmp_path / "run"
    if stage == "checks":  # what was trained is kept; the flag is only read between steps
        evolve(BRIEF, out=directory, progress=interrupt(stage, step))
    else:
        with pytest.raises(Interrupted):
            evolve(BRIEF, out=directory, progress=interrupt(stage, step))
        assert (directory / "resume.safetensors").is_file()
        assert not json.loads((directory / "run.json").read_text())["finished"]
        assert load_field(directory / "field.safetensors").field.num_levels == 1 + (stage == "level 1")
        evolve(EvolveConfig(), out=directory, resume=True)
    expected, found = (load_field(run / "field.safetensors").field.state_dict() for run in (finished, directory))
    torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_other_shapes_cannot_be_resumed(tmp_path):
    file = tmp_path / "ball.safetensors"
    ball(file, 0.4)
    config = replace(BRIEF, shapes=(str(file),))
    with pytest.raises(Interrupted):
        evolve(config, out=tmp_path / "run", progress=interrupt("level 0", 20))
    ball(file, 0.5)
    with pytest.raises(InputError, match="not the shapes that"):
        evolve(config, out=tmp_path / "run", resume=True)


def test_a_time_budget_ends_the_training():
    record = evolve(replace(BRIEF, steps=(100_000, 100_000), time_budget=1.0)).record
    assert all(stage["ended_by_time_budget"] for stage in record["stages"])
    assert record["training_seconds"] < 5


def test_a_morph_of_two_runs_on_the_command_line(tmp_path, capsys):
    files = [tmp_path / f"{name}.safetensors" for name in "ab"]
    for file, radius in zip(files, (0.4, 0.6), strict=True):
        ball(file, radius)
    run = tmp_path / "run"
    assert main(f"evolve {files[0]} {files[1]} -o {run} {FLAGS}".split()) == 0
    output = capsys.readouterr().out
    assert "morph of" in output
    assert "t = 1" in output
    record = json.loads((run / "run.json").read_text())
    assert record["align"] == "center"
    assert record["similarity"] == {"center": [5.0, 0.0, 0.0], "scale": 2.0}
    assert "--force" in fails(capsys, f"evolve {files[0]} {files[1]} -o {run} {FLAGS}")
    assert "nothing to resume" in fails(capsys, f"evolve -o {run} --resume")


def test_a_yaml_file_on_the_command_line(tmp_path, capsys):
    file = tmp_path / "scene.yaml"
    file.write_text("kind: smooth\nshapes: [sphere:0.6]\nalpha: 0.03\n")
    assert main(f"evolve {file} -o {tmp_path / 'run'} {FLAGS}".split()) == 0
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["kind"] == "smooth"
    assert record["config"]["alpha"] == 0.03
    assert "holds all settings" in fails(capsys, f"evolve {file} sphere -o {tmp_path / 'b'}")
    file.write_text("shapes: [sphere:0.6]\nalhpa: 1\n")
    assert "did you mean 'alpha'" in fails(capsys, f"evolve {file} -o {tmp_path / 'b'}")
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("-o RUN", "no shapes to evolve"),
        ("sphere nothing -o RUN", "nothing: no such run directory or file"),
        ("sphere torus --shapes box -o RUN", "--shapes: the shapes are given already"),
        ("sphere -o RUN --resume", "--resume: continues with the run's own settings"),
    ],
)
def test_bad_arguments(tmp_path, capsys, arguments: str, message: str):
    run = tmp_path / "run"
    assert message in fails(capsys, f"evolve {arguments.replace('RUN', str(run))} --quiet")
    assert not run.exists()


def test_the_bundled_presets_are_valid():
    assert all(load_config(EvolveConfig, name) for name in preset_names("evolve"))


def test_a_budget_that_is_too_small_leaves_out_levels_and_samples(tmp_path):
    """A tenth of a second is less than sixty steps of a (512, 4) level take, and less than these checks."""
    config = replace(BRIEF, widths=(16, 512), depths=(1, 4), samples=400_000, frames=40, batch=4096, time_budget=0.1)
    record = evolve(config, out=tmp_path / "run").record
    assert record["budget"]["left_out"] == [1]
    assert len(record["stages"]) == 1
    assert record["stages"][0]["steps"] > 0
    assert record["config"]["samples"] < config.samples
    assert len(record["checks"]["frames"]) < config.frames
    assert len(record["budget"]["notes"]) == 3
