import dataclasses
import math
from pathlib import Path

import pytest
import torch
from evolutions import fails
from mplicits.datasets import look_at, sample_sphere, write_cloud_ply
from mplicits.neural_fields import Sphere, load_field
from mplicits.pipelines.render.trace import trace_view
from mplicits.pipelines.training.settings import FitConfig

from benchmarks.cli import main
from benchmarks.costs.render import RenderBench, RenderRow, naive_view
from benchmarks.costs.render_truth import Truth

SMALL = {
    "400x4": ((24, 2, 8.0, 300, 5e-3),),
    "128x2_256x2_400x2": ((24, 2, 8.0, 300, 5e-3), (24, 1, 12.0, 60, 1e-3), (24, 1, 16.0, 40, 1e-3)),
    "128x2_400x2": ((24, 2, 8.0, 300, 5e-3), (24, 1, 16.0, 60, 1e-3)),
}
CONFIG = FitConfig(batch=1024, samples=4000, between=False, device="cpu")


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> tuple[list[RenderRow], list[str], Path]:
    directory = tmp_path_factory.mktemp("bench")
    write_cloud_ply(directory / "ball.ply", sample_sphere(500, radius=0.7))
    said: list[str] = []
    ours = RenderBench(shapes=[directory / "ball.ply"], config=CONFIG, repeats=1, networks=SMALL)
    rows = dataclasses.replace(ours, size=40, views=2, mesh_resolution=96).rows(directory / "out", say=said.append)
    fields = sorted((directory / "out" / "runs").glob("ball-*/field.safetensors"))
    assert len(fields) == len(SMALL)
    stamps = [file.stat().st_mtime_ns for file in fields]
    # Other pictures of the same fits.
    again = dataclasses.replace(ours, size=24, views=1, naive=False, mesh_resolution=48).rows(directory / "out")
    assert len(again) == 16
    assert stamps == [file.stat().st_mtime_ns for file in fields]
    return rows, said, directory


@pytest.mark.slow
def test_rows_of_table_4_in_each_mode(bench):
    rows, said, _ = bench
    assert [row.model for row in rows[:2]] == ["(400,4)", "(128,2)"]
    assert [row.mode for row in rows] == ["adaptive"] * 8 + ["budget"] * 8 + ["naive"] * 2
    assert any("converged trace of 128x2_400x2, level 1" in text for text in said)
    for row in rows:
        assert row.agreement.silhouette > 100
        assert row.agreement.image_error < 0.3
        if row.mode == "adaptive":
            assert (row.agreement.holes, row.agreement.false_hits) == (0, 0)
            # Mapped normals are those of a finer level at points of a coarser one.
            assert row.agreement.image_error < (0.05 if row.model.endswith("NM") else 0.01)
            assert row.agreement.depth_error < 1e-3
            assert row.agreement.mesh_depth_error < 1e-3


@pytest.mark.slow
def test_coarse_levels_carry_the_trace(bench):
    rows, *_ = bench
    full = next(row for row in rows if row.model.endswith("▷(400,2)") and len(row.evaluations) == 3)
    assert full.evaluations[0] > 1.5 * full.evaluations[2] > 0
    naive = rows[-1]
    assert naive.evaluations == pytest.approx((30, 30, 30), abs=1)
    assert naive.flops > 5 * full.flops
    # Normal mapping adds one jet of the finer level at each hit, and nothing else.
    coarse, mapped = rows[1], rows[2]
    assert mapped.evaluations[0] == coarse.evaluations[0]
    assert mapped.evaluations[1] == pytest.approx(math.pi / 4 * 0.8, abs=0.25)


@pytest.mark.slow
def test_the_naive_tracer_sees_the_same(bench):
    files = (bench[2] / "out" / "runs").glob("ball-*/field.safetensors")
    field = next(one for file in files if (one := load_field(file).field).num_levels == 3)
    camera = look_at((0.5, 0.3, 3.0), (0, 0, 0), width=32, height=32, fov=30)
    ours, naive = trace_view(field, camera), naive_view(field, camera, steps=200)
    shared = torch.isin(ours.pixel, naive.pixel)
    assert len(ours.pixel) > 50
    assert float(shared.double().mean()) > 0.95
    theirs = naive.depth[torch.isin(naive.pixel, ours.pixel)]
    assert float((ours.depth[shared] - theirs).abs().median()) < 1e-3


def test_judging_notices_holes_and_false_hits():
    field, camera = Sphere(radius=0.6), look_at((0.0, 0.0, 3.0), (0, 0, 0), width=48, height=48, fov=30)
    truth = Truth({"ball": field}, report=lambda _: None)
    seen = trace_view(field, camera)
    fine = truth.judge("ball", 0, 0, [camera], [seen])
    assert (fine.holes, fine.false_hits) == (0, 0)
    assert fine.image_error < 1e-4
    assert fine.depth_error < 1e-5
    keep = torch.arange(len(seen.pixel)) % 10 != 0
    rows = {name: getattr(seen, name)[keep] for name in ("pixel", "depth", "position", "normal", "direction")}
    holed = truth.judge("ball", 0, 0, [camera], [dataclasses.replace(seen, **rows)])
    assert holed.holes == int((~keep).sum())
    assert holed.image_error > 0.05
    larger = trace_view(Sphere(radius=0.65), camera)
    grown = truth.judge("ball", 0, 0, [camera], [larger])
    assert grown.false_hits == pytest.approx(len(larger.pixel) - len(seen.pixel), abs=2)
    assert grown.depth_error > 0.05


def test_mistakes_are_one_line_and_leave_nothing(tmp_path, capsys):
    assert "no.ply: no such file" in fails(capsys, f"render {tmp_path / 'no.ply'} -o {tmp_path / 'bench'}", main)
    assert not (tmp_path / "bench").exists()
