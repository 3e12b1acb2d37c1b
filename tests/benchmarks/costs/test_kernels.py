"""The bench of the fused kernels: errors within their bounds, and bytes that are counted by hand."""

import json
import os
from pathlib import Path

import pytest
import torch
from mplicits.neural_fields import Siren

from benchmarks.cli import main
from benchmarks.costs.kernel_levels import LevelsBench
from benchmarks.costs.kernels import KernelsBench, staged_bytes
from benchmarks.costs.traffic import traffic_of
from benchmarks.harness.report import as_text

pytest.importorskip("triton", reason="Triton is not installed: pip install 'mplicits[kernels]' on Linux")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLICITS_KERNELS", "auto" if DEVICE == "cuda" else "interpret")


@pytest.mark.usefixtures("_interpreted")
def test_a_network_is_as_exact_as_it_has_to_be(tmp_path: Path) -> None:
    bench = KernelsBench(sizes=((16, 2), (16, 1)), points=20, device=DEVICE)
    rows = bench.rows(tmp_path / "out")
    for row in rows:
        assert 0 < row.value_error < row.value_bound
        assert 0 < row.gradient_error < row.gradient_bound
        assert row.share < 1
        assert row.pytorch_value_error < row.value_bound
        assert row.fused_bytes == 28  # a point, a value and a gradient of four bytes a number
    assert [row.staged_bytes for row in rows] == [0, 0]  # two layers stay in registers
    (table,) = bench.tables(rows, sgemm=1.0)
    assert "(16,2)" in as_text(table)


@pytest.mark.usefixtures("_interpreted")
def test_levels_are_as_exact_as_they_have_to_be(tmp_path: Path) -> None:
    bench = LevelsBench(fields=(((8, 1), (16, 1)),), points=40, device=DEVICE)
    rows = bench.rows(tmp_path / "out")
    assert [row.taper for row in rows] == [0.0, 0.5]
    for row in rows:
        assert row.inside == (0.5,)
        assert 0 < row.value_error < 1e-5
        assert row.share < 1
        # A point and a jet for all; for half of them a place on the list, the point again, and the jet there and back.
        assert row.fused_bytes == 28 + (16 + 28 + 16) / 2
        assert row.staged_bytes == 0  # one layer is never put aside
        assert row.unfused_launches > 20
        assert row.unfused_waits == 1
    (table,) = bench.tables(rows, sgemm=1.0)
    assert "(8,1)▷(16,1), taper 0.5" in as_text(table)


def test_bytes_of_the_papers_coarse_network() -> None:
    """At least a hundred times fewer than PyTorch's operations: nothing is put aside."""
    x = torch.rand(4096, 3)
    network = Siren(128, 2).requires_grad_(False)
    unfused = traffic_of(lambda: network.jet(x)).moved / len(x)
    assert staged_bytes(128, 2) == 0
    assert unfused >= 100 * 28
    # 400 units are made 128 at a time, in four blocks. Each block reads the whole layer below: 512 with its rest.
    assert staged_bytes(400, 2) == 4 * (512 + 4 * 512 + 512 + 4 * 512)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLICITS_KERNELS", "auto")  # put back afterwards
    monkeypatch.setenv("TRITON_INTERPRET", os.environ.get("TRITON_INTERPRET", "0"))
    figures = tmp_path / "kernels.json"
    assert main(f"kernels --widths 16 --depths 1 --points 5 --json {figures}".split()) == 0
    assert len(json.loads(figures.read_text())["records"]) > 0
