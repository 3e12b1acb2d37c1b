"""The reconstruction benchmark: what is counted, the rows of a tiny scene end to end, and what is kept."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from evolutions import fails
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.neural_fields import Siren, Sphere, Union, extract_mesh
from mplicits.neural_fields.networks.colors import BackgroundField, ColorNetwork
from mplicits.neural_fields.networks.neus_mlp import NeusSDF
from mplicits.pipelines.reconstruct.consistency import GreyPictures
from mplicits.pipelines.reconstruct.model import RayPool, SceneModel, build_scene
from mplicits.pipelines.reconstruct.objective import GraphTrainer, SceneObjective, scene_trainer
from mplicits.pipelines.training.settings import ReconstructConfig
from mplicits.pipelines.training.trainer import StopFlag
from reconstructions import small_reconstructions
from recorders import EagerRecorder
from refusals import refused

from benchmarks.cli import main
from benchmarks.harness.jobs import Registry, record_file
from benchmarks.harness.report import as_text
from benchmarks.scenes import flops
from benchmarks.scenes import reconstruct as module
from benchmarks.scenes.reconstruct import BenchScene, ReconstructBench, read_scene, surface_figures
from benchmarks.scenes.reconstruct_rows import EQUAL_TIME, MULTISCALE, NEUS, ReconstructRow, comparisons

TINY = ReconstructConfig(
    widths=(16, 24), depths=(1, 1), omegas=(5.0, 10.0), starts=(0.0, 0.5), features=4, color_width=16, color_depth=1,
    color_grid=8, steps=4, rays=8, uniform=4, importance=4, skip=0.0, march_grid=0, test_every=3, device="cpu",
)  # fmt: skip
FLAGS = "--widths 16 24 --depths 1 1 --omegas 5 10 --starts 0 0.5 --features 4 --color-width 16 --color-depth 1"
FLAGS += " --color-grid 8 --steps 4 --rays 8 --uniform 4 --importance 4 --march-grid 4 --test-every 3 --device cpu"
FLAGS += " --views 6 --size 8 --resolution 16 --eval-samples 2000"


@pytest.fixture(autouse=True)
def _small_reconstructions(monkeypatch: pytest.MonkeyPatch) -> None:
    small_reconstructions(monkeypatch)


@pytest.fixture(scope="module")
def scene() -> BenchScene:
    return read_scene("painted-sphere", views=6, size=8)


def test_flops_of_one_row():
    level = Siren(16, 2, num_features=4)
    assert flops.value_flops(level) == 2 * (3 * 16 + 16 * 16 + 16)  # the value alone needs no features
    # Six products with every weight, but the points have no cotangent, and features are not swept back.
    assert flops.jet_flops(level) == 2 * (5 * 3 * 16 + 6 * 16 * 16 + 3 * 16 * 5)
    color = ColorNetwork(4, width=16, depth=2)
    assert flops.color_flops(color) == 6 * ((3 + 27 + 3 + 4) * 16 + 16 * 16 + 16 * 3)
    outside = BackgroundField(width=16, depth=1, point_frequencies=2, view_frequencies=1)
    weights = 20 * 16 + 16 * 17 + (16 + 9) * 8 + 8 * 3
    assert flops.outside_flops(outside) == 6 * weights - 2 * 20 * 16  # no cotangent of the points in the first layer
    neus = NeusSDF()
    weights = sum(layer.in_features * layer.out_features for layer in neus.layers)
    assert flops.value_flops(neus) == 2 * weights
    assert 10 * weights < flops.jet_flops(neus) < 12 * weights


@pytest.mark.parametrize("geometry", ["multiscale", "neus"])
def test_counted_flops_are_those_of_a_training(scene: BenchScene, geometry: str):
    config = dataclasses.replace(TINY, geometry=geometry, widths=(48, 64), features=16, color_width=64)
    pool = RayPool(scene.images.views, scene.images.similarity, torch.device("cpu"))
    watched = flops.train_watched(build_scene(config, has_masks=True), pool, config, StopFlag())
    trainer = scene_trainer(build_scene(config, has_masks=True), pool, config)
    with flops.product_counter() as counter:
        trainer.run()
    assert watched.finished
    assert watched.trainer.losses == trainer.losses  # watching changes nothing
    assert watched.geometry_flops + watched.color_flops == pytest.approx(counter.get_total_flops(), rel=0.02)


def with_graphs(
    model: SceneModel, pool: RayPool, config: ReconstructConfig, *, pictures: GreyPictures | None, seconds: float | None
) -> GraphTrainer:
    objective = SceneObjective(model, pool, config, pictures=pictures)
    return GraphTrainer(objective, recorder=EagerRecorder(), stage="reconstruct", steps=config.steps, seconds=seconds)


def test_replayed_steps_are_watched_too(scene: BenchScene, monkeypatch: pytest.MonkeyPatch):
    pool = RayPool(scene.images.views, scene.images.similarity, torch.device("cpu"))
    config = dataclasses.replace(TINY, steps=12)
    watched = []
    for replayed in (False, True):
        if replayed:
            monkeypatch.setattr(flops, "scene_trainer", with_graphs)
        watched.append(flops.train_watched(build_scene(config, has_masks=True), pool, config, StopFlag()))
    usual, fixed = watched
    assert fixed.finished
    assert fixed.trainer.graphs.recorded > 0
    # Fixed shapes have capacity for all samples, and so for all levels and colours.
    for replayed, plain in zip((*fixed.jets, fixed.colors), (*usual.jets, usual.colors), strict=True):
        assert replayed >= plain > 0
    assert fixed.late.steps == 6


def test_a_training_that_is_asked_to_stop_has_not_finished(scene: BenchScene):
    (flag := StopFlag()).requested = True
    pool = RayPool(scene.images.views, scene.images.similarity, torch.device("cpu"))
    model = build_scene(TINY, has_masks=True)
    geometry = model.geometry
    watched = flops.train_watched(model, pool, TINY, flag)
    assert not watched.finished
    assert watched.finest_share is None
    assert model.geometry is geometry


@pytest.fixture(scope="module")
def bench(scene, tmp_path_factory) -> tuple[Path, ReconstructBench, list[ReconstructRow], list[torch.Tensor]]:
    """Folder, options, rows, and the directions of the rays that were drawn."""
    out = tmp_path_factory.mktemp("bench") / "out"
    few = {"test_views": 1, "resolution": 16, "samples": 2000}
    ours = ReconstructBench(scenes=[scene], config=TINY, neus_learning_rate=3e-4, **few)
    drawn: list[torch.Tensor] = []
    draw = RayPool.draw

    def spy(self, count, generator, sampler=None):
        rays = draw(self, count, generator, sampler)
        drawn.append(rays.directions)
        return rays

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RayPool, "draw", spy)
        return out, ours, ours.rows(out), drawn


def test_rows(bench):
    neus, ours, timed = bench[2]
    assert [row.kind for row in bench[2]] == [NEUS, MULTISCALE, EQUAL_TIME]
    assert (neus.network, ours.network) == ("NeuS (256,8)", "(16,1)▷(24,1)")
    assert neus.steps == ours.steps == 4
    assert timed.steps > 0  # as many as there is time for: usually more than four, but not on a machine that is busy
    assert timed.seconds >= neus.seconds
    assert neus.parameters == 529_076
    assert ours.parameters == timed.parameters == (4 * 16 + 17 * 5) + (4 * 24 + 25 * 5)
    # NeuS's colours are its own (256, 4) and see 256 features and the bare position. Ours see 4, four octaves of the
    # position, and the hash encoding: twelve grids that are no finer than the coarsest here, two numbers in each entry.
    assert neus.color_parameters == (3 + 27 + 3 + 256 + 1) * 256 + 3 * 257 * 256 + 257 * 3
    assert ours.color_parameters == (27 + 24 + 27 + 3 + 4 + 1) * 16 + 17 * 3 + 12 * 9**3 * 2
    for row in bench[2]:
        # Four rounds of one more sample; after the last one no values are needed there.
        assert (row.values_per_ray[0], row.jets_per_ray[0]) == (4 + 3, 4 + 4 + 1)
        assert 0 < row.colors_per_ray <= 9
        if row is not timed:  # on a busy machine it ends before its late steps
            assert (row.late.values[0], row.late.jets[0]) == (4 + 3, 4 + 4 + 1)
            assert 0 < row.late.colors <= 9
        parts = (row.parts.march, row.parts.jets, row.parts.colors, row.parts.backward)
        assert min(parts) > 0
        assert sum(parts) < row.seconds
        assert (row.views, row.outside_parameters) == (1, 0)
        assert all(0 < quality < 40 for quality in (row.psnr, row.psnr_object))
        assert -1 <= row.ssim <= 1
    assert neus.finest_share == 1
    assert neus.geometry_flops == 7 * flops.value_flops(NeusSDF()) + 9 * flops.jet_flops(NeusSDF())
    # The second level was on in two of the four steps.
    assert 0 < ours.finest_share < 1
    assert ours.jets_per_ray[1] == pytest.approx(ours.finest_share * 9 / 2)
    assert ours.values_per_ray[1] == 0
    # In the second half the second level was on throughout.
    assert 0 < ours.late.jets[1] == pytest.approx(2 * ours.jets_per_ray[1])


def test_all_rows_see_the_same_rays(bench):
    drawn = torch.stack(bench[3][:12]).unflatten(0, (3, 4))
    assert torch.equal(drawn, drawn[:1].expand_as(drawn))
    assert not torch.equal(drawn[0, 0], drawn[0, 1])


def test_surfaces_are_held_against_the_exact_one(bench):
    truth = extract_mesh(Sphere(radius=0.6), resolution=48)
    ball = surface_figures(extract_mesh(Sphere(radius=0.5), resolution=48), truth, samples=5000, columns=48)
    # In units of the exact sphere, all distances are a sixth.
    assert ball.chamfer == pytest.approx(2 / 36, rel=0.03)
    assert ball.largest_chamfer == ball.chamfer
    assert ball.iou == pytest.approx((5 / 6) ** 3, rel=0.03)
    astray = Union(Sphere(radius=0.5), Sphere(radius=0.1, center=(0.9, 0.0, 0.0)))
    two = surface_figures(extract_mesh(astray, resolution=48), truth, samples=5000, columns=48)
    assert (ball.components, two.components) == (1, 2)
    assert two.chamfer > 1.05 * two.largest_chamfer
    assert two.largest_chamfer == pytest.approx(ball.chamfer, rel=0.03)
    assert two.floor == ball.floor < 2e-3
    for row in bench[2]:
        # They have begun as spheres of radius 0.5; one that trains for a time, not for steps, gets as far as it gets.
        assert row.exact
        least = 0.0 if row.kind == "equal-time" else 0.3 * ball.chamfer
        assert least < row.surface.chamfer < 1.5 * ball.chamfer


def test_finished_rows_are_used_again(bench):
    out, ours, rows, _ = bench
    files = {part.parameters["kind"]: record_file(out, Registry([ours]).key(part)) for part in ours.jobs()}
    before = {kind: file.stat().st_mtime_ns for kind, file in files.items()}
    assert ours.rows(out) == rows
    assert {kind: file.stat().st_mtime_ns for kind, file in files.items()} == before
    # The row of equal time belongs to the time of NeuS.
    files[NEUS].unlink()
    again = ours.rows(out)
    assert again[1] == rows[1]
    assert again[2].seconds >= again[0].seconds
    changed = {kind for kind, file in files.items() if file.stat().st_mtime_ns != before[kind]}
    assert changed == {NEUS, EQUAL_TIME}


def test_rows_of_other_settings_are_other_rows(bench, scene):
    ours = bench[1]
    repainted = dataclasses.replace(scene, images=render_scene(SCENES["painted-sphere"](), 6, 8, seed=1))
    keys = {Registry([ours]).key(part) for part in ours.jobs()}
    for other, apart in (
        (dataclasses.replace(ours, config=dataclasses.replace(TINY, steps=5)), 3),
        (dataclasses.replace(ours, scenes=[repainted]), 3),
        (dataclasses.replace(ours, resolution=17), 3),
        (dataclasses.replace(ours, neus_learning_rate=1e-3), 1),
        (dataclasses.replace(ours, config=dataclasses.replace(TINY, texture_steps=5)), 0),
    ):
        assert len({Registry([other]).key(part) for part in other.jobs()} - keys) == apart


def test_what_cannot_be_measured_is_refused(scene, tmp_path):
    for scenes, every, message in (([scene], 0, "no picture is held out"), ([scene, scene], 3, "two of the scenes")):
        bench = ReconstructBench(scenes=scenes, config=dataclasses.replace(TINY, test_every=every))
        with refused("painted-sphere", message):
            bench.rows(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_ratios_of_rows_and_their_means_over_scenes(bench):
    neus, ours, timed = bench[2]
    neus = dataclasses.replace(neus, psnr=25.0, step_seconds=0.3, steps=10, seconds=4.0, geometry_flops=5e6)
    neus = dataclasses.replace(neus, color_flops=1e6, parameters=1000)
    ours = dataclasses.replace(ours, psnr=26.5, step_seconds=0.1, steps=10, seconds=1.0, geometry_flops=1.5e6)
    ours = dataclasses.replace(ours, color_flops=0.5e6, parameters=620, finest_share=0.125)
    timed = dataclasses.replace(timed, psnr=28.0)
    second = [dataclasses.replace(row, scene="figure", psnr=row.psnr - 2, surface=None) for row in (neus, ours)]
    second[1] = dataclasses.replace(second[1], step_seconds=0.2, psnr=24.0)
    first, other, mean = comparisons([neus, ours, timed, *second])
    assert (first.neus, first.ours, first.equal_time) == (25.0, 26.5, 28.0)
    assert (first.fewer, first.step, first.mean_step, first.flops) == pytest.approx((0.38, 3.0, 4.0, 3.0))
    assert first.chamfer == pytest.approx(neus.surface.largest_chamfer / ours.surface.largest_chamfer)
    assert (other.step, other.equal_time, other.chamfer) == (pytest.approx(1.5), None, None)
    assert (mean.neus, mean.ours, mean.step) == pytest.approx((24.0, 25.25, 4.5**0.5))
    assert (mean.equal_time, mean.chamfer) == (None, None)
    # NeuS: 6 MFLOP a ray, 8 rays, 10 steps, 4 seconds.
    assert neus.flops_per_second == pytest.approx(1.2e8)
    table, evaluations, parts, against = bench[1].tables([neus, ours, timed, *second], sgemm=50e9)
    assert evaluations.rows[0].values[4:6] == (7.0, 9.0)
    assert parts.rows[0].values[0] == pytest.approx(1e3 * neus.parts.march)
    assert table.rows[0].values[-1] == pytest.approx(1.2e8 / 50e9)
    lines = "\n".join(" ".join(line.split()) for line in as_text(against).splitlines())
    assert "paper, DTU scan 24 28.20 31.50 +3.30 – – -37%" in lines
    assert "mean of 2 scenes" in lines
    assert "no surface" in as_text(table)
    assert len(bench[1].tables([neus], sgemm=50e9)) == 3


def run(*arguments: object) -> int:
    return main(["reconstruct", *map(str, arguments)])


def test_the_command_goes_on_after_an_interruption(tmp_path, capsys, monkeypatch):
    train, calls = module.train_watched, []

    def stops_at_the_second(*arguments, **keywords):
        calls.append(keywords)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return train(*arguments, **keywords)

    monkeypatch.setattr(module, "train_watched", stops_at_the_second)
    figures = tmp_path / "rows.json"
    command = ["painted-sphere", *FLAGS.split(), "--no-equal-time", "-o", tmp_path / "out", "--json", figures]
    for code, kinds in ((130, [NEUS]), (0, [NEUS, MULTISCALE])):
        assert run(*command) == code
        rows = [row for record in json.loads(figures.read_text())["records"] for row in record["outputs"]]
        assert [row["kind"] for row in rows] == kinds
    output, error = capsys.readouterr()
    assert "interrupted" in error
    assert "painted-sphere (16,1)▷(24,1)" in output
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("painted-shpere", "painted-shpere: no such data set, and no scene of that name; did you mean"),
        ("figure --geometry neus", "--geometry: the benchmark trains both"),
        ("figure --jets 9", "--jets: rows see the same rays"),
        ("figure --geometry-only --neus-learning-rate 1e-3", "--neus-learning-rate: --geometry-only tries"),
        ("figure --geometries neus", "--geometries: without --geometry-only all rows are trained"),
        ("figure --views 2 --size 8 --test-every 0", "figure: no picture is held out"),
    ],
)
def test_mistakes_are_one_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, f"reconstruct {words}", main)
    assert list(tmp_path.iterdir()) == []
