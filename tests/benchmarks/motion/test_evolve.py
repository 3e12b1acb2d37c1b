"""The benchmark of evolutions: closed forms score no error, fields that miss something do, morphs are measured."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from evolutions import QUICK, ball, few_points
from mplicits.neural_fields import Union
from mplicits.neural_fields.backend.files import write_json
from mplicits.pipelines.training.settings import FitConfig

from benchmarks.harness.report import as_text
from benchmarks.motion import evolve as bench_evolve
from benchmarks.motion.evolve import CASES, ExactBench, MorphBench, measure_exact
from benchmarks.shapes.fits import fit_home


@pytest.fixture(autouse=True)
def _few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    few_points(monkeypatch)


@pytest.mark.parametrize("name", list(CASES))
def test_the_truth_of_an_exact_case_scores_no_error(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(bench_evolve, "RESOLUTION", 32)
    row = measure_exact(name, Union(*CASES[name].truth()), CASES[name], 0.0)
    assert max(row.mean_error, row.mean_value) < 1e-4
    assert row.slopes["mean"] == pytest.approx(1, abs=1e-4)
    # Spheres that are nearer than a cell look like one.
    wrong = [found != expected for found, expected in zip(row.components, row.expected, strict=True)]
    assert sum(wrong) <= 1
    assert len(row.times) == 20


def test_a_missing_part_is_seen() -> None:
    case = CASES["two spheres, merging"]
    assert [case.components(t) for t in (0.0, 0.62, 0.63, 1.0)] == [2, 2, 1, 1]
    row = measure_exact("half of it", case.truth()[0], case, 0.0)
    assert row.components == (1,) * 20
    assert row.mean_value > 0.1


@pytest.mark.slow
def test_exact_cases_are_trained_and_printed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench_evolve, "TIMES", 3)
    monkeypatch.setattr(bench_evolve, "RESOLUTION", 24)
    (name, *_) = CASES
    bench = ExactBench(config=replace(QUICK, steps=(120,)), cases=[name])
    (row,) = bench.rows(tmp_path)
    assert row.mean_error < 0.05
    assert (row.case, row.components) == (name, (1, 1, 1))
    assert name in as_text(*bench.tables([row], sgemm=1e9))


@pytest.mark.slow
def test_a_morph_is_measured_against_meshes(tmp_path: Path) -> None:
    meshes = []
    for name, radius in (("small", 0.4), ("large", 0.6)):
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=2 * radius)
        mesh.apply_translation((5.0, 0.0, 0.0))  # the similarity of `ball`
        meshes.append(tmp_path / f"{name}.ply")
        mesh.export(meshes[-1])
        home = fit_home(tmp_path / "out", meshes[-1], FitConfig())  # where its fit is kept
        home.mkdir(parents=True)
        ball(home / "field.safetensors", radius, levels=True)
        write_json(home / "run.json", {"config": {}, "finished": True})
    config = replace(QUICK, align="none", steps=(150,), samples=4000)
    bench = MorphBench(meshes=tuple(meshes), config=config, resolution=32, samples=5000)
    (row,) = bench.rows(tmp_path / "out")
    assert row.shapes == ("small", "large")
    for end, fitted, floor in zip(row.ends, row.fits, row.floors, strict=True):
        # Nothing but the sampling, and in units of the meshes' spheres the errors of fit and morph, squared.
        assert floor < fitted < floor + 0.002
        assert floor < end < floor + 0.01
    assert row.volumes[::2] == pytest.approx([4 / 3 * math.pi * radius**3 for radius in (0.4, 0.6)], rel=0.2)
    assert row.components == (1, 1, 1)
    ends, curves = bench.tables([row], sgemm=1e9)
    assert f"{row.ends[1] / row.fits[1]:.2f}" in as_text(ends)
    assert [frame.values for frame in curves.rows] == list(zip(row.volumes, row.components, strict=True))
    assert len(list((tmp_path / "out" / "runs").glob("*/run.json"))) == 3
