"""Shares of a time budget, by predictions that the tests choose; and fits whose budget is too small for all of it."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mplicits.datasets import PointCloud
from mplicits.pipelines.fit.plan import FEWEST_SAMPLES, FEWEST_STEPS, SAMPLING_SHARE, FitPlan
from mplicits.pipelines.fit.timing import USUAL_POINTS, Timing
from mplicits.pipelines.fit.train import fit
from mplicits.pipelines.fit.unoriented import BATCH, STEPS
from mplicits.pipelines.run.costs import Net, Speed
from mplicits.pipelines.run.folder import read_record
from mplicits.pipelines.run.settings import FitConfig
from mplicits.pipelines.run.trainer import Progress

CONFIG = FitConfig()
PLAN = FitPlan(CONFIG, 50_000, Speed(cpu=2e11, device=2e11, step=0.0))
WHOLE = sum(stage.seconds for stage in PLAN.levels())


def even(_: str) -> float:
    return 1.0


def test_sizes_of_networks() -> None:
    assert [Net.siren(*size).parameters for size in ((128, 2), (256, 2), (400, 2))] == [17_153, 67_073, 162_401]
    assert Net.siren(256, 3).neurons == 768


def test_enough_time_is_shared_out_in_full() -> None:
    shares = PLAN.shares(0, 2 * WHOLE)
    assert [share.samples for share in shares] == [CONFIG.samples] * 3
    assert sum(share.seconds for share in shares) == pytest.approx(2 * WHOLE)


@pytest.mark.parametrize("part", [0.9, 0.5, 0.2, 0.1])
def test_too_little_time_makes_fewer_samples_and_leaves_out_fine_levels(part: float) -> None:
    shares = PLAN.shares(0, part * WHOLE)
    assert sum(share.seconds for share in shares) == pytest.approx(part * WHOLE)
    for level, share in enumerate(shares):
        making = PLAN.sampling_seconds(level, share.samples)
        # Samples take their part, or no more than the fewest do.
        assert making <= max(SAMPLING_SHARE * share.seconds, PLAN.sampling_seconds(level, FEWEST_SAMPLES)) * 1.001
        steps = (share.seconds - making) / PLAN.step_seconds(level)
        assert steps >= FEWEST_STEPS * 0.999


def test_levels_go_one_by_one_the_finest_first() -> None:
    counts = [len(PLAN.shares(0, part * WHOLE)) for part in np.geomspace(1e-4, 1, 60)]
    assert counts == sorted(counts)
    assert set(counts) == {1, 2, 3}
    assert PLAN.shares(1, 0.0) == []  # what is begun is enough
    assert len(PLAN.shares(0, 0.0)) == 1  # without level 0 there is nothing


def test_signs_without_orientation_are_foreseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second witness trains as long as the first, whose places are drawn before; steps are of values, not jets."""
    first, second = PLAN.signs()
    assert first.seconds > second.seconds > 0
    assert second.seconds / STEPS < PLAN.step_seconds(0) * BATCH / CONFIG.batch

    monkeypatch.setattr("mplicits.pipelines.fit.timing.speed", lambda _: PLAN.speed)

    def left(config: FitConfig) -> float:
        told: list[Progress] = []
        Timing(config, told.append, torch.device("cpu")).begin(sphere_cloud())
        assert told[-1].left is not None
        return told[-1].left

    usual = FitPlan(CONFIG, USUAL_POINTS, PLAN.speed)  # the cloud is not read yet
    asked = sum(stage.seconds for stage in usual.signs())
    assert left(replace(CONFIG, normals="none")) - left(CONFIG) == pytest.approx(asked, abs=0.1)  # of a clock that runs


def test_a_slow_machine_is_a_smaller_budget() -> None:
    for part in (1.5, 0.3):
        slow = PLAN.shares(0, 4 * part * WHOLE, lambda _: 4.0)
        assert [share.samples for share in slow] == [share.samples for share in PLAN.shares(0, part * WHOLE)]


def sphere_cloud(count: int = 3000) -> PointCloud:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(normals, normals=normals.astype(np.float32), source="ball")


SMALL = FitConfig(
    widths=(32, 512), depths=(2, 4), omegas=(10.0, 15.0), steps=(1000, 1000), learning_rates=(3e-3, 1e-3), batch=2048
)


def test_a_budget_that_is_too_small_makes_less_and_says_so(tmp_path: Path) -> None:
    """400 thousand samples alone would take longer, and so would sixty steps of a (512, 4) level."""
    said: list[Progress] = []
    started = time.monotonic()
    run = fit(sphere_cloud(), replace(SMALL, time_budget=0.7), out=tmp_path, progress=said.append)
    assert time.monotonic() - started < 60  # on any machine: it is not three minutes
    record = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    budget = record["budget"]
    assert budget["seconds"] == 0.7
    assert budget["left_out"] == [1]
    assert run.field.num_levels == len(record["stages"]) == 1
    stage = record["stages"][0]
    assert stage["steps"] > 0
    assert stage["samples"]["domain"] < SMALL.samples
    assert any("level 1 is left out" in note for note in budget["notes"])
    assert any("samples of each kind instead of 400,000" in note for note in budget["notes"])
    assert max(progress.left or 0.0 for progress in said[1:]) <= 0.7
    assert record["preparation_seconds"] > 0


def test_without_a_budget_nothing_is_said_of_one(tmp_path: Path) -> None:
    fit(sphere_cloud(), replace(SMALL, levels=1, steps=(2, 2), samples=2000), out=tmp_path)
    assert "budget" not in read_record(tmp_path)


def test_stages_are_those_that_are_announced() -> None:
    """The whole is known from the first message on, and nothing happens that was not."""
    said: list[Progress] = []
    config = replace(SMALL, widths=(16, 16), depths=(1, 1), steps=(40, 20), samples=5000)
    fit(sphere_cloud(), config, progress=said.append)
    assert list(dict.fromkeys(progress.stage for progress in said)) == [
        "reading the cloud",
        "preparing the cloud",
        "level 0: samples",
        "level 0",
        "level 1: samples",
        "level 1",
    ]
    assert all(progress.left is not None for progress in said)
    assert said[-1].whole == 1.0
    samples = [progress.fraction for progress in said if progress.stage == "level 0: samples"]
    assert samples == sorted(samples)
    assert (samples[0], samples[-1]) == (0.0, 1.0)
