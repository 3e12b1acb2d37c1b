"""The bench of pictures on a device: on the CPU it compares a picture with itself."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fields import solve_sphere
from mplicits.datasets.cameras import look_at
from mplicits.neural_fields import MultiscaleSDF, save_field
from mplicits.pipelines.render.trace import pixel_size, trace_view

from benchmarks.cli import main
from benchmarks.costs.pictures import PicturesBench, SamplesBench, differences


@pytest.fixture
def run(tmp_path: Path) -> Path:
    field = MultiscaleSDF.from_widths([(16, 2), (16, 1)], omegas=[8, 8], residual_gain=0.01)
    solve_sphere(field.base, radius=0.5)
    save_field(tmp_path / "field.safetensors", field)
    return tmp_path


def test_a_picture_is_the_cpus(run: Path, tmp_path: Path) -> None:
    bench = PicturesBench(run_file=str(run), sizes=((24, 18),), repeats=2, device="cpu")
    rows = bench.rows(tmp_path / "out")
    assert [row.level for row in rows] == [0, 1]
    for row in rows:
        assert row.pixels > 50
        assert row.best >= row.median > 0
        assert (row.unlike, row.depth, row.normal, row.depths, row.normals) == (0, 0, 0, 0, 0)


def test_differences_are_noticed(run: Path) -> None:
    view = look_at((1.6, 0.9, 2.0), (0.0, 0.0, 0.0), fov=40.0, width=24, height=18)
    field = MultiscaleSDF.from_widths([(16, 2)], omegas=[8])
    solve_sphere(field.base, radius=0.5)
    one = trace_view(field, view)
    size = pixel_size(view)
    tilted = torch.nn.functional.normalize(one.normal + 1e-3 * one.normal.roll(1, dims=1), dim=-1)
    kept = {name: getattr(one, name)[1:] for name in ("pixel", "position", "direction")}
    other = replace(one, **kept, depth=one.depth[1:] + size, normal=tilted[1:])
    off, turned, unlike = differences(other, one, size)
    assert unlike == 1
    assert bool(((off - 1).abs() < 1e-3).all())
    assert 0 < float(turned.max()) < 0.1  # degrees: a thousandth of a radian at most


def test_samples(tmp_path: Path) -> None:
    (row,) = SamplesBench(sizes=((16, 2),), points=300, repeats=2, device="cpu").rows(tmp_path / "out")
    assert min(row.jet, row.value) > 0
    assert row.jet_rate * row.jet > row.value_rate * row.value  # operations; times depend on who else is at work
    assert row.value_rate == pytest.approx(2 * (16 * 16 + 4 * 16) / row.value / 1e3)


@pytest.mark.slow
def test_the_command(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(f"pictures {run} --device cpu --sizes 24 18 --repeats 2 --points 300".split()) == 0
    assert "24×18, level 1" in capsys.readouterr().out
