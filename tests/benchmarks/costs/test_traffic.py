import torch
from mplicits.neural_fields import Siren

from benchmarks.costs.traffic import traffic_of


def test_bytes_launches_and_waits() -> None:
    x = torch.rand(10)
    assert traffic_of(lambda: x + x) == (1, 0, 3 * 40)
    assert traffic_of(lambda: x.view(2, 5)) == (0, 0, 0)
    mask = torch.ones(10, dtype=torch.bool)
    launches, waits, moved = traffic_of(lambda: x[mask])
    assert (launches, waits) == (1, 1)
    assert moved == 40 + 10 + 40


def test_blocks_are_those_of_a_gpu() -> None:
    """Eight times the points take as many operations: the threads of a CPU would get blocks."""
    network = Siren(400, 2).requires_grad_(False)
    few, many = (torch.rand(count, 3) for count in (1000, 8000))
    assert traffic_of(lambda: network.value(few)).launches == traffic_of(lambda: network.value(many)).launches
