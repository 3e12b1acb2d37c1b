"""Work that is recorded and replayed, with new inputs from the host."""

from collections.abc import Callable, Mapping
from typing import NoReturn

import torch
from mplicits.neural_fields.backend.devices import GraphInputs, graph_input, has_graph_inputs
from mplicits.pipelines.training.cuda_graphs import CudaGraphRecorder, GraphCache, Recorder
from recorders import EagerRecorder
from torch import Tensor


def recorder(device: torch.device) -> Recorder:
    return CudaGraphRecorder() if device.type == "cuda" else EagerRecorder()


def test_graph_inputs_are_made_again_in_the_same_order(device: torch.device) -> None:
    random, current, inputs = torch.Generator().manual_seed(0), [0], GraphInputs(device)

    def work() -> list[Tensor]:
        assert has_graph_inputs()
        draws = graph_input(lambda: torch.rand(3, 2, generator=random), device)
        number = graph_input(lambda: torch.tensor(current[0]), device)
        rows = graph_input(lambda: torch.randint(100, (4,), generator=random), device)
        return [draws, number, rows]

    with inputs.recording():
        found = [[part.cpu().clone() for part in work()]]
    places = set()
    for current[0] in (1, 2):
        inputs.update()
        with inputs.static():
            parts = work()
        places.add(tuple(part.data_ptr() for part in parts))
        found.append([part.cpu().clone() for part in parts])
    assert len(places) == 1  # the memory is the same
    assert not has_graph_inputs()
    random.manual_seed(0)
    for step, (draws, number, rows) in enumerate(found):
        assert torch.equal(draws, torch.rand(3, 2, generator=random))
        assert int(number) == step
        assert torch.equal(rows, torch.randint(100, (4,), generator=random))


def test_replays_equal_the_work(accelerator: torch.device) -> None:
    cache, current = GraphCache(accelerator, recorder(accelerator)), [0.0]
    total = torch.zeros(2, device=accelerator)

    def work(factor: float) -> dict[str, Tensor]:
        number = graph_input(lambda: torch.tensor(current[0]), accelerator)
        total.add_(factor * number)
        return {"total": total + 0, "double": 2 * number}

    expected = 0.0
    for step in range(8):
        current[0], factor = float(step), 1.0 if step % 2 else 10.0
        found = cache.run(factor, lambda factor=factor: work(factor))
        expected += factor * step
        assert found["total"].tolist() == [expected] * 2
        assert float(found["double"]) == 2 * step
    assert cache.recorded == 2


def test_the_least_recently_used_graph_is_dropped() -> None:
    cache = GraphCache(torch.device("cpu"), EagerRecorder(), kept=2)
    for kind in (0, 1, 1, 0, 2, 0, 1):  # 1 is dropped for 2, and then runs as a new kind
        cache.run(kind, lambda kind=kind: {"kind": torch.tensor(kind)})
    assert cache.recorded == 2
    assert int(cache.run(1, lambda: {"kind": torch.tensor(5)})["kind"]) == 5
    assert cache.recorded == 3


def test_work_runs_eagerly_where_recording_fails() -> None:
    class Refusing(Recorder):
        def record(self, work: Callable[[], Mapping[str, Tensor]]) -> NoReturn:
            work()
            raise RuntimeError("operation not permitted\nmore about it")

    cache, current, done = GraphCache(torch.device("cpu"), Refusing()), [0], []

    def work() -> dict[str, Tensor]:
        done.append(current[0])
        return {"current": graph_input(lambda: torch.tensor(current[0]), torch.device("cpu")).clone()}

    for current[0] in range(5):
        assert int(cache.run("kind", work)["current"]) == current[0]
    assert cache.refused == "operation not permitted"
    assert cache.recorded == 0
    assert done == [0, 1, 1, 2, 3, 4]  # it was tried once
