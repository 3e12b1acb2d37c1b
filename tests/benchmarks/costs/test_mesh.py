import sys

import pytest
import torch
from mplicits.neural_fields import InputError, MultiscaleSDF, Siren, save_field

from benchmarks.costs.speed import MeshBench
from benchmarks.harness.report import as_text


def sphere_like():
    base = Siren(3, 1, omega=1.0).requires_grad_(False)
    # Σ sin(2.2 xᵢ + π/2) = Σ cos(2.2 xᵢ): convex level sets around the origin.
    base.layers[0].weight.copy_(2.2 * torch.eye(3))
    base.layers[0].bias.fill_(torch.pi / 2)
    base.output.weight.fill_(-0.6)
    base.output.bias.fill_(1.2)
    return MultiscaleSDF(base, [Siren(8, 1, omega=5.0, output_gain=0.05)], [0.1])


@pytest.mark.slow
def test_rows_ratios_and_distance(tmp_path):
    pytest.importorskip("skimage", reason="the extra mplicits[bench] is not installed")
    save_field(tmp_path / "ball.safetensors", sphere_like())
    bench = MeshBench(run_file=tmp_path / "ball.safetensors", resolutions=(64, 128), reference=64)
    rows = bench.rows(tmp_path / "out")
    assert [row.resolution for row in rows] == [64, 128, 64, 64]
    ours, large, paper, dense = rows
    assert 2.5 < sum(large.evaluations) / sum(ours.evaluations) < 4.5
    assert paper.evaluations[0] == dense.evaluations[0] == 65**3
    assert sum(ours.evaluations) < sum(paper.evaluations) / 3
    assert 0 < ours.evaluations[1] < paper.evaluations[1] < 65**3
    # scikit-image adds a vertex inside some ambiguous cells; apart from those the two agree.
    assert ours.vertices == pytest.approx(paper.vertices, rel=0.01)
    assert paper.mean_distance < 0.02
    assert paper.max_distance < 0.5
    assert all(row.peak is None or 2**27 < row.peak < 2**31 for row in rows)
    assert dense.share == pytest.approx(3 / 65)
    assert "4.6% of the slabs, extrapolated" in as_text(*bench.tables(rows, sgemm=1e9))


def test_a_missing_peer_is_an_input_error_before_any_work(tmp_path, monkeypatch):
    save_field(tmp_path / "ball.safetensors", Siren(8, 1))
    for name in ("skimage", "skimage.measure"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"scikit-image's; pip install 'mplicits\[bench\]'"):
        MeshBench(run_file=tmp_path / "ball.safetensors").jobs()
