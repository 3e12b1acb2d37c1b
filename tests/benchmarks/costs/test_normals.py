"""The peers of the jet benchmark compute the same thing; the table says what was measured."""

import multiprocessing
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from mplicits.neural_fields import Siren
from torch import Tensor

from benchmarks.costs.speed import NormalsBench, printed_jet, tangent_jet
from benchmarks.harness.report import as_text


@pytest.mark.parametrize("method", [printed_jet, tangent_jet])
@pytest.mark.parametrize("depth", [1, 2, 3])
def test_algorithm_1_is_the_jet(depth: int, method: Callable[[Siren, Tensor], tuple[Tensor, Tensor]]) -> None:
    network = Siren(48, depth, omega=6.0).double().requires_grad_(False)
    x = torch.rand(6000, 3, dtype=torch.float64)
    value, gradient = method(network, x)
    jet = network.jet(x)
    torch.testing.assert_close(value, jet.value)
    torch.testing.assert_close(gradient, jet.gradient)


@pytest.mark.slow
def test_rows_and_table(tmp_path: Path) -> None:
    bench = NormalsBench(points=3000, sizes=((16, 2), (24, 3)), repeats=1, busy=1)
    rows = bench.rows(tmp_path)
    assert [(row.width, row.depth) for row in rows] == [(16, 2), (24, 3)]
    assert not multiprocessing.active_children(), "the busy process outlived its rows"
    for row in rows:
        assert min(row.value, row.jet, row.printed, row.tangents, row.autograd, row.gemm) > 0
        assert min(row.value_split, row.jet_split, row.value_one, row.jet_one) > 0
        assert row.largest_difference < 1e-3
    costs, threads = map(as_text, bench.tables(rows, sgemm=1e9))
    assert f"{rows[0].jet / rows[0].value:.2f}" in costs
    assert f"{rows[1].jet_split / rows[1].jet:.2f}" in threads
    assert f"{rows[1].jet_one / (rows[1].threads * rows[1].jet):.0%}" in threads
