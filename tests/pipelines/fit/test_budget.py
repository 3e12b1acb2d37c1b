"""Fits whose time budget is too small for all of it; and the stages that a fit reports."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets import PointCloud
from mplicits.pipelines.fit.train import fit
from mplicits.pipelines.training.folder import read_record
from mplicits.pipelines.training.progress import Progress
from mplicits.pipelines.training.settings import FitConfig


def sphere_cloud(count: int = 3000) -> PointCloud:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(normals, normals=normals.astype(np.float32), source="ball")


SMALL = FitConfig(
    widths=(32, 512), depths=(2, 4), omegas=(10.0, 15.0), steps=(1000, 1000), learning_rates=(3e-3, 1e-3), batch=2048
)


def test_a_budget_that_is_too_small_makes_less_and_says_so(tmp_path: Path) -> None:
    """400 thousand samples alone would take longer, and so would sixty steps of a (512, 4) level."""
    started = time.monotonic()
    run = fit(sphere_cloud(), replace(SMALL, time_budget=0.7), out=tmp_path)
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
    assert record["preparation_seconds"] > 0


def test_without_a_budget_nothing_is_said_of_one(tmp_path: Path) -> None:
    fit(sphere_cloud(), replace(SMALL, levels=1, steps=(2, 2), samples=2000), out=tmp_path)
    assert "budget" not in read_record(tmp_path)


def test_stages_are_reported_in_order() -> None:
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
    samples = [progress.fraction for progress in said if progress.stage == "level 0: samples"]
    assert samples == [0.0, 1.0]


def test_a_budget_that_is_large_enough_changes_nothing(tmp_path: Path) -> None:
    """All steps are taken, with all samples: the field is that without a budget, to the last bit."""
    config = replace(SMALL, widths=(16, 16), depths=(1, 1), steps=(40, 20), samples=6000)
    free = fit(sphere_cloud(), config)
    held = fit(sphere_cloud(), replace(config, time_budget=1e6))
    assert held.record["budget"] == {"seconds": 1e6, "left_out": [], "notes": []}
    pairs = zip(free.field.parameters(), held.field.parameters(), strict=True)
    assert all(np.array_equal(a.detach().numpy(), b.detach().numpy()) for a, b in pairs)


@pytest.mark.slow
def test_a_budget_is_kept() -> None:
    """Of a fit that would take minutes. Reading the compiler, and other programs, may take some seconds."""
    config = replace(SMALL, widths=(64, 64), depths=(2, 2), steps=(10**6, 10**6))
    fit(sphere_cloud(), replace(config, time_budget=0.5))
    started = time.monotonic()
    run = fit(sphere_cloud(), replace(config, time_budget=12.0))
    assert 10 < time.monotonic() - started < 20
    assert run.field.num_levels == 2
    assert all(stage["steps"] > 60 for stage in run.record["stages"])
