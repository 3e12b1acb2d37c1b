"""The model of a picture on a GPU: exact counts of a picture that is counted by hand, and its arithmetic."""

import dataclasses

import pytest
import torch
from mplicits.neural_fields import MultiscaleSDF, Siren
from mplicits.pipelines.bench.model import (
    DEVICES,
    LAUNCH,
    SINE,
    WAIT,
    Device,
    FrameCounts,
    count_frame,
    model_table,
    predict,
)
from mplicits.pipelines.cli.bench import MODELLED

N, W = 100, 32
ROUND = Device("round numbers", 1e12, 6e12, 1e9, True, "made up")
COUNTS = FrameCounts(
    pixels=16,
    products=2e12,
    product_bytes=1e9,
    sines=1e10,
    other_bytes=3e9,
    launches=1000,
    calls=10,
    fused_bytes=5e7,
    march_bytes=1e8,
    march_launches=500,
    waits=20,
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
    assert (counts.march_launches, counts.march_bytes, counts.waits) == (0, 0, 0)
    # The least that a jet reads and writes: activations of two layers, and their cosines, once each way.
    assert counts.product_bytes + counts.other_bytes > 8 * 4 * N * W


def test_blocks_are_those_of_a_gpu() -> None:
    """Twice the points are twice the work, in as many operations."""
    network = Siren(400, 2).requires_grad_(False)
    few, many = (count_frame(network, lambda f, n=n: f.value(torch.rand(n, 3)), 1) for n in (1000, 2000))
    assert many.products == 2 * few.products
    assert many.launches == few.launches


def test_gathers_are_of_the_march_and_wait() -> None:
    field = MultiscaleSDF.from_widths([(16, 1), (16, 1)], omegas=[5, 5], deltas=[0.5]).requires_grad_(False)
    x = torch.rand(N, 3)
    counts = count_frame(field, lambda same: same.value(x), 1)
    assert counts.calls == 2
    assert counts.waits == 1  # which rows are in the band
    assert counts.march_launches > 0


def test_the_arithmetic() -> None:
    plain = predict(COUNTS, ROUND, fused=False)
    assert plain.device == pytest.approx(2 + 3 + 0.1)  # products, the bytes of sines, the march
    assert plain.host == pytest.approx(1500 * LAUNCH)
    assert plain.seconds == pytest.approx(plain.device + 20 * WAIT)
    fused = predict(COUNTS, ROUND, fused=True)
    assert fused.device == pytest.approx(2 + SINE / 100 + 0.1)
    assert fused.host == pytest.approx(510 * LAUNCH)
    assert predict(COUNTS, ROUND, fused=True, split=True).device == pytest.approx(1 + SINE / 100 + 0.1)
    assert fused.limit == "work"
    idle = dataclasses.replace(COUNTS, products=0.0, sines=0.0, fused_bytes=0.0, march_bytes=0.0)
    assert predict(idle, ROUND, fused=True).limit == "launches"
    assert predict(dataclasses.replace(idle, waits=1000), ROUND, fused=True).limit == "waits"


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
