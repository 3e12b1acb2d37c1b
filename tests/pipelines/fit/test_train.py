"""The whole fit on small clouds: accuracy, bands, interruption, resumption, refusal."""

import signal
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import mplicits
import numpy as np
import pytest
import torch
from fits import SMALL, assert_same, interrupt
from mplicits.datasets import PointCloud, sample_sphere
from mplicits.neural_fields import InputError, extract_mesh, load_field
from mplicits.neural_fields.backend.devices import choose_device
from mplicits.pipelines.cli.fit import describe
from mplicits.pipelines.fit import FitConfig, Interrupted, fit
from mplicits.pipelines.fit.level import JUDGE, LEVEL, Verdict, calm_omega
from mplicits.pipelines.training.folder import read_record

CENTER = np.array([1000.0, -50.0, 5.0])
# A budget of seconds has no room for its second level.
LONG = FitConfig(
    widths=(32, 512), depths=(2, 4), omegas=(10.0, 15.0), steps=(1000, 1000), learning_rates=(3e-3, 1e-3), batch=2048
)


def sphere_cloud(count: int = 3000) -> PointCloud:
    """A sphere in the user's own coordinates."""
    ball = sample_sphere(count, radius=7.0)
    return replace(ball, points=ball.points + CENTER, source="ball")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    fit(sphere_cloud(), SMALL, out=directory)
    return directory


def test_a_sphere_comes_out_as_a_sphere(fitted: Path) -> None:
    field, similarity, metadata = load_field(fitted / "field.safetensors")
    mesh = extract_mesh(field, resolution=48)
    radii = np.linalg.norm(similarity.to_input(mesh.vertices) - CENTER, axis=1)
    assert abs(radii - 7.0).max() < 0.05
    errors = [stage["rms_at_points"] for stage in metadata["run"]["stages"]]
    assert errors[1] < errors[0]
    x = torch.rand(2000, 3) * 2 - 1
    x = x[(x.norm(dim=1) - 1).abs() > 0.05]
    assert torch.equal(field.value(x) > 0, x.norm(dim=1) > 1)


def test_bands_hold_the_points(fitted: Path) -> None:
    field, similarity, metadata = load_field(fitted / "field.safetensors")
    points = torch.from_numpy(similarity.to_unit(sphere_cloud().points)).float()
    assert field.in_band(points, level=1).float().mean() > 0.998
    assert field.deltas.tolist() == pytest.approx(metadata["run"]["deltas"])


def test_the_run_directory(fitted: Path) -> None:
    assert {path.stem for path in fitted.iterdir()} == {"field", "run", "support"}
    record = read_record(fitted)
    assert record["finished"] is True
    assert record["cloud"] == "ball"
    assert record["config"]["steps"] == [150, 80]
    assert record["environment"]["versions"]["torch"] == torch.__version__
    assert [stage["steps"] for stage in record["stages"]] == [150, 80]
    assert record["parameters"] == sum(p.numel() for p in load_field(fitted / "field.safetensors").field.parameters())


def test_the_same_seed_gives_the_same_field(fitted: Path) -> None:
    run = fit(sphere_cloud(), SMALL)
    assert_same(run.field, load_field(fitted / "field.safetensors").field)
    seeds = [fit(sphere_cloud(), replace(SMALL, seed=seed, steps=(5, 5))).field.levels[0] for seed in (0, 1)]
    assert not torch.equal(seeds[0].output.weight, seeds[1].output.weight)


@pytest.mark.parametrize(("level", "number"), [(0, signal.SIGINT), (1, signal.SIGTERM)])
def test_an_interrupted_run_resumes_to_the_same(fitted: Path, tmp_path: Path, level: int, number: int) -> None:
    with pytest.raises(Interrupted, match="checkpoint"):
        fit(sphere_cloud(), SMALL, out=tmp_path, progress=interrupt(f"level {level}", 40, number))
    assert load_field(tmp_path / "field.safetensors").field.num_levels == level + 1  # what there is can be used
    assert read_record(tmp_path)["finished"] is False
    fit(sphere_cloud(), out=tmp_path, resume=True)
    assert not (tmp_path / "resume.safetensors").exists()
    assert_same(*(load_field(d / "field.safetensors").field for d in (tmp_path, fitted)))


@pytest.mark.slow
def test_frequencies_of_residuals_follow_the_noise_where_normals_are_guesses(fitted: Path, tmp_path: Path) -> None:
    """Waves of the noise's size are its own; a resumed run has the same."""
    clean = read_record(fitted)
    assert [stage["omega"] for stage in clean["stages"]] == [10.0, 15.0]
    ball = sphere_cloud()
    noisy = ball.points + np.random.default_rng(1).normal(0, 0.35, ball.points.shape)  # a twentieth of the radius
    small = {"widths": (16, 16, 16), "depths": (1, 1, 1), "omegas": (5.0, 5.2, 90.0), "steps": (40, 40, 40)}
    config = replace(SMALL, **small, learning_rates=(3e-3,) * 3, samples=6000, between=False)
    whole = fit(PointCloud(noisy), config, out=tmp_path / "whole")
    stages, noise = whole.record["stages"], whole.record["cleaning"]["smoothed_noise"]
    cap = LEVEL.calm * whole.record["similarity"]["scale"] / noise
    assert 5.2 < cap < 90
    assert [stage["omega"] for stage in stages] == pytest.approx([5.0, 5.2, cap])

    with pytest.raises(Interrupted):
        fit(PointCloud(noisy), config, out=tmp_path / "part", progress=interrupt("level 2", 20))
    run = fit(PointCloud(noisy), out=tmp_path / "part", resume=True)
    assert [level.omega for level in run.field.levels] == [level.omega for level in whole.field.levels]
    assert_same(run.field, whole.field)

    same = fit(PointCloud(noisy), replace(config, omegas=(5.0, 90.0, 90.0), steps=(40, 5, 5))).record
    assert [stage["omega"] for stage in same["stages"]] == pytest.approx([5.0, cap])  # noise allows no third level
    assert same["budget"] == {"seconds": None, "left_out": [2], "notes": [ANY]}


def test_frequencies_fall_no_lower_than_that_of_level_0() -> None:
    config = replace(SMALL, omegas=(10.0, 40.0))
    for noise, omega in ((0.0, 40), (LEVEL.calm / 50, 40), (LEVEL.calm / 20, 20), (LEVEL.calm / 5, 10)):
        assert calm_omega(config, 1, noise) == omega
    assert calm_omega(config, 0, LEVEL.calm / 5) == 10


def test_a_level_that_is_worse_than_none_adds_nothing(fitted: Path, tmp_path: Path) -> None:
    config = replace(SMALL, steps=(150, 5), learning_rates=(3e-3, 3.0), hold_out=0.0)
    run = fit(sphere_cloud(), config, out=tmp_path / "run")
    first, second = run.record["stages"]
    assert (first["silenced"], second["silenced"]) == (False, True)
    assert second["rms_at_points"] == first["rms_at_points"]
    x = 2 * torch.rand(2000, 3) - 1
    assert torch.equal(run.field.value(x), run.field.value(x, level=0))
    assert torch.equal(run.field.jet(x).gradient, run.field.jet(x, level=0).gradient)
    assert "level 1 set to zero: further from the points" in describe(tmp_path / "run")
    assert not any(stage["silenced"] for stage in read_record(fitted)["stages"])


@pytest.mark.parametrize("together", [True, False])
def test_a_level_on_trial_is_kept_or_set_to_zero_with_the_next(
    together: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Verdict, "better", property(lambda verdict: verdict.until == 2 and together))
    monkeypatch.setattr(Verdict, "unsettled", property(lambda verdict: verdict.until is None))
    levels = {"widths": (24, 24, 24), "depths": (1, 1, 1), "omegas": (8.0, 16.0, 32.0)}
    config = replace(SMALL, **levels, steps=(60, 30, 80), learning_rates=(3e-3, 1e-3, 3e-4), hold_out=0.05)
    run = fit(sphere_cloud(5000), config, out=tmp_path / "whole")
    _, first, second = run.record["stages"]
    assert (first["on_trial"], first["silenced"], second["silenced"]) == (False, not together, True)
    assert f"levels 1 to 2 {'kept' if together else 'set to zero'}" in describe(tmp_path / "whole")
    x = 2 * torch.rand(2000, 3) - 1
    assert torch.equal(run.field.value(x), run.field.value(x, level=1))  # level 2 is no better than level 1
    assert torch.equal(run.field.value(x), run.field.value(x, level=0)) is not together
    points = torch.from_numpy(run.similarity.to_unit(sphere_cloud(5000).points)).float()
    rms = float(run.field.value(points).square().mean().sqrt()) * run.similarity.scale
    assert second["rms_at_points"] == pytest.approx(rms, rel=1e-3)
    part = tmp_path / "part"
    with pytest.raises(Interrupted):
        fit(sphere_cloud(5000), config, out=part, progress=interrupt("level 2", 40))
    assert read_record(part)["stages"][1]["on_trial"]
    assert_same(fit(sphere_cloud(5000), out=part, resume=True).field, run.field)


def test_a_level_without_a_judge_learns_from_all_points() -> None:
    run = fit(sphere_cloud(), replace(SMALL, steps=(3, 2), between=False))
    first, second = run.record["stages"]
    kept = len(sphere_cloud()) - run.record["cleaning"]["dropped_outliers"]
    assert first["samples"]["surface"] == kept
    assert second["held_out"]["points"] <= kept - second["samples"]["surface"]
    assert JUDGE.fewest <= kept - second["samples"]["surface"] < 0.1 * kept


def test_levels_are_handed_out_as_they_are_finished() -> None:
    config = replace(SMALL, steps=(3, 2))
    seen: list[tuple[int, float]] = []
    before = signal.getsignal(signal.SIGINT)
    run = fit(sphere_cloud(), config, level_done=lambda field, place: seen.append((field.num_levels, place.scale)))
    assert signal.getsignal(signal.SIGINT) is before
    assert fit(sphere_cloud(), replace(config, levels=1)).field.num_levels == 1
    assert seen == [(1, run.similarity.scale), (2, run.similarity.scale)]


def test_resume_refuses_another_cloud_or_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run\.json: no such file"):
        fit(sphere_cloud(), out=tmp_path / "none", resume=True)

    with pytest.raises(Interrupted):
        fit(sphere_cloud(), SMALL, out=tmp_path, progress=interrupt("level 0", 20))
    with pytest.raises(InputError, match="not the cloud"):
        fit(sphere_cloud(2999), out=tmp_path, resume=True)
    (tmp_path / "resume.safetensors").write_bytes(b"junk")
    with pytest.raises(InputError, match="damaged"):
        fit(sphere_cloud(), out=tmp_path, resume=True)


def test_a_budget_that_is_too_small_makes_less_and_says_so(tmp_path: Path) -> None:
    """400 thousand samples alone would take longer, and so would sixty steps of a (512, 4) level."""
    started = time.monotonic()
    fit(sphere_cloud(), replace(LONG, time_budget=0.7), out=tmp_path)
    assert time.monotonic() - started < 60  # on any machine: it is not three minutes
    record = read_record(tmp_path)
    budget, (stage,) = record["budget"], record["stages"]
    assert (budget["seconds"], budget["left_out"]) == (0.7, [1])
    assert load_field(tmp_path / "field.safetensors").field.num_levels == 1
    assert stage["steps"] > 0
    assert stage["ended_by_time_budget"]
    assert stage["samples"]["domain"] < LONG.samples
    assert any("level 1 is left out" in note for note in budget["notes"])
    assert any("samples of each kind instead of 400,000" in note for note in budget["notes"])


def test_a_budget_that_is_large_enough_changes_nothing() -> None:
    config = replace(LONG, widths=(16, 16), depths=(1, 1), steps=(40, 20), samples=6000)
    free = fit(sphere_cloud(), config)
    assert "budget" not in free.record
    held = fit(sphere_cloud(), replace(config, time_budget=1e6))
    assert held.record["budget"] == {"seconds": 1e6, "left_out": [], "notes": []}
    assert_same(free.field, held.field)


def test_what_may_be_fitted_and_where() -> None:
    cloud = sphere_cloud()
    array = np.hstack((cloud.points, cloud.normals))  # type: ignore[arg-type]
    tiny = replace(SMALL, steps=(3, 3), device="cpu")
    assert_same(fit(array, tiny).field, fit(cloud, tiny).field)
    with pytest.raises(InputError, match="shape"):
        fit(array[:, :5], tiny)
    with pytest.raises(ValueError, match="levels"):
        replace(SMALL, levels=3)
    assert choose_device("cpu").type == "cpu"
    with pytest.raises(InputError, match="--device nonsense"):
        choose_device("nonsense")


def test_a_run_answers_in_the_coordinates_of_its_cloud(tmp_path: Path) -> None:
    run = fit(sphere_cloud(), replace(SMALL, levels=1, steps=(20, 1)))
    points = np.array([[1000.0, -50.0, 14.0], [1000.0, -50.0, 5.0]])
    unit = torch.from_numpy(run.similarity.to_unit(points)).float()
    expected = run.similarity.scale * run.field.value(unit).detach().double().numpy()
    np.testing.assert_allclose(run.world.distance(points), expected, rtol=1e-12)
    run.save(tmp_path / "ball.safetensors")
    assert (mplicits.load(tmp_path / "ball.safetensors").distance(points) == run.world.distance(points)).all()
