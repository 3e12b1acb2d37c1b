"""The benchmark of motions: the truth scores no error, what stands still does, stretches are singular values."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evolutions import QUICK, few_points
from mplicits.neural_fields import TimeSlice
from mplicits.neural_fields.spacetime.flow import Solver
from mplicits.neural_fields.spacetime.moving import Keyframes
from mplicits.pipelines.training.settings import FitConfig
from torch import Tensor

from benchmarks.harness.report import as_text
from benchmarks.motion import motion as bench_motion
from benchmarks.motion.figures import twisting_bar
from benchmarks.motion.motion import BLEND, MotionBench, measure_motion, triangle_stretch

RESOLUTION = 32


@pytest.fixture(autouse=True)
def _few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    few_points(monkeypatch)
    monkeypatch.setattr(bench_motion, "SAMPLES", 500)


def no_velocity(x: Tensor, t: Tensor) -> Tensor:
    return torch.zeros_like(x)


def test_the_truth_scores_no_error():
    truth = twisting_bar()

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        return truth.motion.velocity(truth.motion.inverse(x, t), t)

    row = measure_motion("bar", "truth", truth, truth, (0.4, 1.0), velocity=velocity, resolution=RESOLUTION)
    # Meshes leave the surface by the square of a cell (1/16) over eight radii of curvature (1/16 at the edges): 1 %
    # of a length, of a diagonal of 1.5, at the worst place, and much less on average.
    assert max(row.errors) < 0.7
    assert row.components == (1, 1)
    # A Runge-Kutta step of 0.02, h⁴ / 120 and 50 of them: 1e-9; the rest is float32, over 50 steps.
    assert max(row.correspondence) < 1e-2
    assert (*row.volumes, *row.areas) == pytest.approx([1] * 4, abs=0.05)
    assert row.calm == 1.0  # the twist shears by 1.5 × 0.4 at most


def test_a_figure_that_stands_still_is_off_by_its_way():
    truth = twisting_bar()
    still = Keyframes([0.0, 1.0], [TimeSlice(truth, 0.0), TimeSlice(truth, 0.0)])
    row = measure_motion("bar", "still", still, truth, (0.5, 1.0), velocity=no_velocity, resolution=RESOLUTION)
    middle, end = row.correspondence
    assert 1 < middle < end
    assert row.errors[1] > 1
    rest = bench_motion._rest(truth, RESOLUTION).vertices
    way = truth.motion.forward(torch.from_numpy(rest), 1.0).numpy() - rest
    diagonal = np.linalg.norm(np.ptp(rest, axis=0))
    assert end == pytest.approx(100 * np.linalg.norm(way, axis=1).mean() / diagonal, rel=1e-5)  # float32


def test_a_moment_without_a_surface_is_none():
    truth = twisting_bar()

    class Empty(Keyframes):
        def value(self, x: Tensor, *, level: int = -1) -> Tensor:
            return torch.ones_like(x[..., 0])

    empty = Empty([0.0, 1.0], [TimeSlice(truth, 0.0), TimeSlice(truth, 0.0)])
    row = measure_motion("bar", "none", empty, truth, (0.5,), velocity=no_velocity, resolution=RESOLUTION)
    assert (row.errors, row.volumes, row.areas, row.components) == ((None,), (None,), (None,), (0,))


def test_stretches_are_the_larger_singular_values():
    random = np.random.default_rng(0)
    before = random.standard_normal((30, 3))
    faces = np.arange(30).reshape(10, 3)
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    assert np.allclose(triangle_stretch(before, before @ turn, faces), 1)
    assert np.allclose(triangle_stretch(before, 2.5 * before @ turn, faces), 2.5)
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, 1.0, 0.0]])
    sheared = flat @ np.array([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    # The shear by 1 has the golden ratio for its larger singular value.
    assert triangle_stretch(flat, sheared, np.array([[0, 1, 2]])) == pytest.approx((1 + math.sqrt(5)) / 2)
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    assert triangle_stretch(line, 3 * line, np.array([[0, 1, 2]])) == pytest.approx(3)


@pytest.mark.parametrize(("keys", "moments"), [(5, 20), (3, 1), (2, 3)])
def test_no_held_out_moment_is_a_key(keys: int, moments: int):
    bench = MotionBench(config=QUICK, kinds=(), keys=keys, moments=moments)
    held = np.array(bench.held_out())
    assert len(held) == moments
    assert (np.diff(held, prepend=0, append=1) > 0).all()
    assert np.abs(held[:, None] - np.linspace(0, 1, keys)).min() > 0.005 / moments


def test_figures_are_trained_and_printed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(bench_motion, "CARRY", Solver(method="rk4", step=0.25))
    config = replace(QUICK, steps=(5,), samples=200, start_steps=5, batch=64, frames=2, resolution=16)
    bench = MotionBench(config=config, kinds=("morph",), figures=("bar",), keys=2, moments=2, resolution=24)
    rows = bench.rows(tmp_path)
    assert [row.method for row in rows] == [BLEND, "morph"]
    assert rows[1].seconds > rows[0].seconds == 0
    text = "\n".join(as_text(table) for table in bench.tables(rows, sgemm=1e9))
    for part in ("bar, morph", f"bar, {BLEND}", "stretch < 4, %", "0.250"):
        assert part in text
    assert bench.rows(tmp_path) == rows  # kept, not measured again


@pytest.mark.slow
def test_scans_of_the_keys_are_fitted_and_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(bench_motion, "SCAN_RESOLUTION", 40)
    one = {"widths": (24,), "depths": (2,), "omegas": (6.0,), "steps": (120,), "learning_rates": (1e-2,)}
    few = {"keys": 2, "moments": 1, "resolution": 24, "fits": FitConfig(**one, batch=256, samples=2000)}
    bench = MotionBench(config=QUICK, kinds=(), figures=("bar",), noise=0.005, **few)
    monkeypatch.setattr(bench_motion, "CARRY", Solver(method="rk4", step=0.25))
    (row,) = bench.rows(tmp_path)
    assert len(list((tmp_path / "scans").glob("bar-0.005-*.ply"))) == 2
    assert len(list((tmp_path / "runs").glob("*/field.safetensors"))) == 2
    # In place and in size: a blend that is somewhere else, or twice as large, is off by much more.
    assert row.errors[0] < 10
    assert row.volumes[0] == pytest.approx(1, abs=0.5)
    assert "2 key scans with noise of 0.5 %" in as_text(bench.tables([row], sgemm=1e9)[0])
