"""The benchmark of signs on a ball, whose normals all point away from its centre."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mplicits.datasets import OrientedCloud, PointCloud
from mplicits.datasets.clouds.point_cloud import unit_rows
from mplicits.pipelines.fit.train import prepare
from mplicits.pipelines.fit.unoriented import SIGNING
from mplicits.pipelines.training.settings import FitConfig

from benchmarks.harness.report import as_text
from benchmarks.shapes import signs as module
from benchmarks.shapes.signs import SignsBench

CONFIG = FitConfig(widths=(32, 32), depths=(2, 2), omegas=(20.0, 20.0), steps=(1, 1), learning_rates=(3e-3, 1e-3))


@pytest.fixture(autouse=True)
def _few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, less in (("steps", 150), ("batch", 1024), ("samples", 10_000)):
        monkeypatch.setitem(vars(SIGNING), name, less)


@pytest.mark.parametrize(("noise", "points"), [(0.0, None), (0.005, 2000)])
def test_a_ball_has_no_wrong_signs(ball: Path, tmp_path: Path, noise: float, points: int | None) -> None:
    bench = SignsBench(shapes=[ball], config=CONFIG, noise=noise, isotropic=noise > 0, points=points, device="auto")
    (row,) = bench.rows(tmp_path / "out")
    assert row.before == row.after == 0.0
    assert not row.asked
    assert row.points == points or noise == 0
    assert ("+ isotropic noise 0.005" in as_text(*bench.tables([row], sgemm=1e9))) == (noise > 0)


@pytest.mark.slow
def test_normals_that_point_inward_are_counted(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def spoilt(cloud: PointCloud, config: FitConfig) -> OrientedCloud:
        good = prepare(cloud, config)
        return replace(good, normals=np.where(np.arange(len(good))[:, None] % 3, good.normals, -good.normals))

    monkeypatch.setattr(module, "prepare", spoilt)
    (row,) = SignsBench(shapes=[ball], config=CONFIG).rows(tmp_path / "out")
    assert row.before == pytest.approx(1 / 3, abs=1 / row.points)
    assert row.after == 0.0


def test_points_that_smoothing_drops_do_not_mix_up_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every point has another normal here, so that one that is taken for its neighbour shows."""
    points = unit_rows(np.random.default_rng(0).normal(size=(500, 3)))
    clean = PointCloud(points, points.astype(np.float32), None, "ball")
    still = prepare(clean, CONFIG)
    left = np.arange(500) % 50 > 0
    moved = (still.points + 0.01 * np.random.default_rng(1).normal(size=(500, 3))).astype(np.float32)[left]
    report = replace(still.report, smoothed_noise=1.0)
    smoothed = replace(still, points=moved, normals=still.normals[left], report=report)
    monkeypatch.setattr(module, "prepare", lambda *_: still)
    exact = module._exact_normals(clean, clean, smoothed, CONFIG)
    assert (exact == clean.normals[left]).mean() > 0.99  # but for two that lie closer together than they were moved
