"""The model of a picture on a GPU: exact counts of a picture that is counted by hand, and its arithmetic."""

import dataclasses

import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, Siren, sphere_trace
from mplicits.pipelines.bench.model import (
    DEVICES,
    LAUNCH,
    SINE,
    STANDS,
    TILE,
    WAIT,
    Device,
    FrameCounts,
    count_frame,
    model_table,
    predict,
)
from mplicits.pipelines.cli.bench_costs import MODELLED

N, W = 100, 32
ROUND = Device("round numbers", 1e12, 6e12, 1e9, 10, True, "made up")
COUNTS = FrameCounts(
    pixels=16,
    products=2e12,
    product_bytes=1e9,
    sines=1e10,
    other_bytes=3e9,
    launches=1000,
    around_bytes=3e8,
    around_launches=500,
    around_waits=15,
    rest_bytes=1e8,
    rest_launches=50,
    rest_waits=5,
    calls=10,
    fused_bytes=5e7,
    chain=1e10,
    chain_sines=1e8,
)


def test_counts_of_a_value_and_a_jet() -> None:
    """A network (32, 2): products 3 × 32, 32 × 32 and 32 × 1, there; and all of them back, for a jet."""
    network = Siren(W, 2).requires_grad_(False)
    x = torch.rand(N, 3)

    def draw(field: torch.nn.Module) -> None:
        field.value(x)  # type: ignore[operator]
        field.jet(x)  # type: ignore[operator]

    counts = count_frame(network, draw, 10)
    there = 2 * N * (3 * W + W * W + W)
    assert counts.products == there + there + 2 * N * (W * W + 3 * W)
    assert counts.sines == 2 * N * W + 4 * N * W
    assert counts.calls == 2
    assert counts.fused_bytes == N * (16 + 28)
    assert (counts.rest_launches, counts.rest_bytes, counts.rest_waits) == (0, 0, 0)
    assert (counts.around_launches, counts.around_waits, counts.chain) == (0, 0, 0)
    # The least that a jet reads and writes: activations of two layers, and their cosines, once each way.
    assert counts.product_bytes + counts.other_bytes > 8 * 4 * N * W


def test_blocks_are_those_of_a_gpu() -> None:
    """Eight times the points are as many times the work, in as many operations, where a CPU's threads get blocks."""
    network = Siren(400, 2).requires_grad_(False)
    few, many = (count_frame(network, lambda f, n=n: f.value(torch.rand(n, 3)), 1) for n in (1000, 8000))
    assert many.products == 8 * few.products
    assert many.launches == few.launches


def test_gathers_are_around_the_networks_and_wait() -> None:
    field = MultiscaleSDF.from_widths([(16, 1), (16, 1)], omegas=[5, 5], deltas=[0.5]).requires_grad_(False)
    x = torch.rand(N, 3)
    inside = int((field.value(x, level=0).abs() < 0.5).sum())
    counts = count_frame(field, lambda same: same.value(x), 1)
    assert counts.calls == 1  # one launch has both levels
    assert (counts.around_waits, counts.rest_waits) == (1, 0)  # which rows are in the band
    assert counts.around_launches > 0
    assert counts.fused_bytes == N * 16 + inside * (16 + 16 + 4)


def test_a_march_is_one_launch_and_its_longest_ray_a_chain() -> None:
    """A network whose rays all take the same four steps: as many tiles, one after the other."""
    network = Siren(16, 1).requires_grad_(False)
    origins = torch.tensor([0.0, 0.0, -2.0]).expand(N, 3)

    def draw(field: torch.nn.Module) -> None:
        hits = sphere_trace(field, origins, -origins / 2, max_steps=4, radius=None)  # type: ignore[arg-type]
        steps.append(int(hits.steps.max()))

    steps: list[int] = []
    counts = count_frame(network, draw, 1)
    assert 0 < steps[0] <= 4
    assert counts.calls == 1
    assert counts.chain == steps[0] * TILE * 2 * (3 * 16 + 16)
    assert counts.chain_sines == steps[0] * TILE * 16
    assert counts.fused_bytes == steps[0] * STANDS * N
    assert 0 < counts.rest_launches < 150


def test_the_arithmetic() -> None:
    plain = predict(COUNTS, ROUND, fused=False)
    assert plain.device == pytest.approx(2 + 3 + 0.3 + 0.1)  # products, the bytes of sines, around them, the rest
    assert plain.host == pytest.approx(1550 * LAUNCH)
    assert plain.seconds == pytest.approx(plain.device + 20 * WAIT)
    fused = predict(COUNTS, ROUND, fused=True)
    assert fused.device == pytest.approx(2 + SINE / 100 + 0.1)
    assert fused.host == pytest.approx(60 * LAUNCH)
    assert predict(COUNTS, ROUND, fused=True, split=True).device == pytest.approx(1 + SINE / 100 + 0.1)
    assert fused.limit == "work"
    assert fused.waits == pytest.approx(5 * WAIT)
    # One multiprocessor has a tenth of the rates.
    chained = predict(dataclasses.replace(COUNTS, chain=1e12), ROUND, fused=True)
    assert chained.device == pytest.approx(10 * (1 + SINE / 1e4) + 0.1)
    assert chained.limit == "longest ray"
    idle = dataclasses.replace(
        COUNTS, products=0.0, sines=0.0, fused_bytes=0.0, rest_bytes=0.0, chain=0.0, chain_sines=0.0
    )
    assert predict(idle, ROUND, fused=True).limit == "launches"
    assert predict(dataclasses.replace(idle, rest_waits=1000), ROUND, fused=True).limit == "waits"


def test_what_a_device_cannot_do() -> None:
    with pytest.raises(ValueError, match="no fused kernels"):
        predict(COUNTS, DEVICES["m2"], fused=True)
    with pytest.raises(ValueError, match="no tensor cores"):
        predict(COUNTS, DEVICES["m2"], fused=False, split=True)


def test_the_table() -> None:
    table = model_table([("ball (32,2)", 0.5, COUNTS)], ["h100", "m2"])
    (row,) = table.rows
    assert row.values[0] == 2.0
    found = dict(zip([column.name for column in table.columns], row.values, strict=True))
    assert found["h100: fps"] == pytest.approx(1 / predict(COUNTS, DEVICES["h100"], fused=False).seconds)
    assert row.values[-3:-1] == (None, "work")  # an M2 has no tensor cores
    assert "A model, not a measurement" in table.notes[0]
    assert any("Apple" in note for note in table.notes)
    assert set(MODELLED) == set(DEVICES)
