"""Geometries with the same colour network: what is equal, whose rate counts, and the intervals."""

import dataclasses

import pytest
import torch
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.pipelines.reconstruct.model import build_scene
from mplicits.pipelines.training.settings import ReconstructConfig
from mplicits.pipelines.training.trainer import parameter_count
from reconstructions import small_reconstructions

from benchmarks.cli.scenes import GEOMETRIES as OFFERED
from benchmarks.harness.jobs import Context, Registry, make_folder
from benchmarks.harness.run import run_pending
from benchmarks.scenes import geometries
from benchmarks.scenes.geometries import GEOMETRIES, SINGLE, GeometryBench, best_trainings
from benchmarks.scenes.reconstruct import read_scene
from benchmarks.scenes.reconstruct_rows import MULTISCALE, NEUS, SurfaceFigures

TINY = ReconstructConfig(
    widths=(16, 24), depths=(1, 1), omegas=(5.0, 10.0), features=4, color_width=16, color_depth=1, color_grid=8,
    steps=2, rays=8, uniform=4, importance=4, march_grid=4, test_every=3, start="sphere", device="cpu",
)  # fmt: skip


@pytest.fixture(autouse=True)
def _small_reconstructions(monkeypatch: pytest.MonkeyPatch) -> None:
    small_reconstructions(monkeypatch)


@pytest.fixture(scope="module")
def bench() -> GeometryBench:
    scene = read_scene("painted-sphere", views=4, size=8)
    return GeometryBench(scenes=[scene], config=TINY, rates=(3e-4, 1e-3), seeds=2, resolution=16, samples=500)


@pytest.mark.parametrize(("widths", "depths"), [((128, 256), (4, 5)), ((32, 48), (2, 2)), ((16, 24), (1, 1))])
def test_one_siren_is_as_large_as_all_levels(widths, depths):
    config = dataclasses.replace(ReconstructConfig(), widths=widths, depths=depths)
    single = geometries.single_siren(config)
    levels, one, wider = (
        parameter_count(build_scene(each, has_masks=True).geometry)
        for each in (config, single, dataclasses.replace(single, widths=(single.widths[0] + 1,)))
    )
    # Whole neurons: no other width comes nearer.
    assert abs(one - levels) <= (wider - one) / 2 + single.widths[0]
    assert single.omegas == (config.omegas[-1],)


def test_colours_begin_alike_and_learn_at_one_rate(bench):
    weights, rates = [], set()
    for geometry in GEOMETRIES:
        for rate in bench.rates:
            training = bench._training(bench.scenes[0], geometry, rate, seed=1)
            config = training.config_of(geometry)
            model = training.build(config, has_masks=True, views=3)
            weights.append(torch.cat([p.detach().flatten() for p in model.color.parameters()]))
            rates.add(round(config.learning_rate * config.color_rate, 12))
            rates.add(round(config.learning_rate * config.sharpening, 12))
            assert isinstance(model.geometry, NeusSDF) == (geometry == NEUS)
            assert len(model.geometry.deltas) == (geometry == MULTISCALE)
    assert all(torch.equal(weights[0], other) for other in weights)
    assert rates == {round(TINY.learning_rate * factor, 12) for factor in (TINY.color_rate, TINY.sharpening)}


def test_the_choice_of_geometries_changes_no_key(bench):
    assert set(OFFERED) == set(GEOMETRIES)
    some = dataclasses.replace(bench, geometries=(NEUS, MULTISCALE))
    chosen = [job for job in bench.jobs() if job.parameters["geometry"] != SINGLE]
    keys, before = ({Registry([one]).key(job) for job in chosen} for one in (some, bench))
    assert {Registry([some]).key(job) for job in some.jobs()} == keys == before


def test_the_best_rate_of_each_counts_and_gains_are_paired(bench, tmp_path, monkeypatch):
    first = bench.run(bench.jobs()[0], Context(tmp_path, "one"))
    row = bench.read([{"outputs": list(first.outputs)}])[0]
    assert (row.geometry, row.rate, row.seed, row.result.steps) == (MULTISCALE, 3e-4, 0, 2)

    def scored(geometry: str, rate: float, seed: int, psnr: float) -> geometries.GeometryRow:
        surface = SurfaceFigures(3e-3, 1e-4, 2e-3, 0.9, 0.5, 2)
        result = dataclasses.replace(row.result, psnr=psnr, kind=geometry, surface=surface)
        return geometries.GeometryRow(geometry, rate, seed, result)

    rows = [scored(MULTISCALE, rate, seed, 20 + seed) for rate in (3e-4,) for seed in (0, 1)]
    rows += [scored(NEUS, 3e-4, 0, 10), scored(NEUS, 1e-3, 0, 18), scored(NEUS, 1e-3, 1, 19)]
    rows += [scored(SINGLE, 3e-4, seed, 19 + 3 * seed) for seed in (0, 1)]
    rows += [scored(SINGLE, 1e-3, 0, 18.9), scored(SINGLE, 1e-3, 1, 40)]  # the first seed chooses, not the best of all
    best = best_trainings(rows)
    assert [best["painted-sphere", geometry][0].rate for geometry in GEOMETRIES] == [3e-4, 1e-3, 3e-4]
    table, gains = bench.tables(rows, sgemm=1.0)
    assert table.rows[0].values[4] == "20.50 ± 6.35"  # t is 12.7062 with one degree of freedom
    assert table.rows[0].values[6:8] == ("2.00 ± 0.00", "60.00 ± 0.00")  # thousandths, and arccos 0.5
    assert [line.values for line in gains.rows] == [(2, "+2.00 ± 0.00", "2 better"), (2, "+0.00 ± 12.71", "1 better")]


def test_other_seeds_have_the_rate_of_the_first(bench, tmp_path, monkeypatch):
    trained: list[tuple[float, int]] = []
    real = geometries._Training.trained

    def watched(self, *arguments):
        trained.append((self.config.learning_rate, self.config.seed))
        row = real(self, *arguments)
        return dataclasses.replace(row, psnr={3e-4: 20.0, 1e-3: 21.0, 3e-3: 19.0}[self.config.learning_rate])

    monkeypatch.setattr(geometries._Training, "trained", watched)
    some = dataclasses.replace(bench, geometries=(MULTISCALE,))
    rows = some.rows(tmp_path)
    assert trained == [(3e-4, 0), (1e-3, 0), (1e-3, 1)] == [(row.rate, row.seed) for row in rows]
    assert [row.rate for row in best_trainings(rows)["painted-sphere", MULTISCALE]] == [1e-3, 1e-3]
    # With one more rate, that alone is trained, and the same one is still the best.
    more = dataclasses.replace(some, rates=(*some.rates, 3e-3)).rows(tmp_path)
    assert trained[3:] == [(3e-3, 0)]
    assert (more[-1].rate, more[-1].seed) == (1e-3, 1)


@pytest.mark.slow
def test_several_trainings_at_a_time_find_what_one_after_the_other_does(bench, tmp_path):
    tables = []
    for streams in (1, 2):
        some = dataclasses.replace(bench, geometries=(NEUS,), streams=streams)
        make_folder(tmp_path / str(streams))
        jobs, out = some.jobs(), tmp_path / str(streams)
        ran = run_pending(jobs, out, Registry([some]), streams=streams, say=lambda _: None)
        assert (list(ran.records), ran.failures) == (jobs, {})
        rows = some.read(list(ran.records.values()))
        tables.append([(row.geometry, row.rate, row.seed, row.result.psnr, row.result.surface) for row in rows])
    assert tables[0] == tables[1]
    # A job for each rate, the second seed's, and that under its own rate, each done once.
    assert len(list((tmp_path / "2" / "cells").iterdir())) == 2 + 1 + 1
