"""Works that are noted down, recorded and replayed: with what the host knows by then, and without asking it."""

from collections.abc import Callable, Mapping
from typing import NoReturn

import torch
from mplicits.neural_fields.backend.devices import Supply, handed, is_supplied
from mplicits.pipelines.training.replay import Again, CudaGraphs, Recorder, Replays
from torch import Tensor


def recorder(device: torch.device) -> Recorder:
    return CudaGraphs() if device.type == "cuda" else Again()


def test_what_is_handed_over_is_made_anew_in_the_same_order(device: torch.device) -> None:
    random, told, supply = torch.Generator().manual_seed(0), [0], Supply(device)

    def work() -> list[Tensor]:
        assert is_supplied()
        draws = handed(lambda: torch.rand(3, 2, generator=random), device)
        number = handed(lambda: torch.tensor(told[0]), device)
        rows = handed(lambda: torch.randint(100, (4,), generator=random), device)
        return [draws, number, rows]

    with supply.noting():
        found = [[part.cpu().clone() for part in work()]]
    places = set()
    for told[0] in (1, 2):
        supply.renew()
        with supply.supplied():
            parts = work()
        places.add(tuple(part.data_ptr() for part in parts))
        found.append([part.cpu().clone() for part in parts])
    assert len(places) == 1  # where they are does not change
    assert not is_supplied()
    random.manual_seed(0)
    for step, (draws, number, rows) in enumerate(found):
        assert torch.equal(draws, torch.rand(3, 2, generator=random))
        assert int(number) == step
        assert torch.equal(rows, torch.randint(100, (4,), generator=random))


def test_replays_are_the_work_itself(accelerator: torch.device) -> None:
    replays, told = Replays(accelerator, recorder(accelerator)), [0.0]
    total = torch.zeros(2, device=accelerator)

    def work(factor: float) -> dict[str, Tensor]:
        number = handed(lambda: torch.tensor(told[0]), accelerator)
        total.add_(factor * number)
        return {"total": total + 0, "double": 2 * number}

    expected = 0.0
    for step in range(8):
        told[0], factor = float(step), 1.0 if step % 2 else 10.0
        found = replays.do(factor, lambda factor=factor: work(factor))
        expected += factor * step
        assert found["total"].tolist() == [expected] * 2
        assert float(found["double"]) == 2 * step
    assert replays.recorded == 2


def test_kinds_that_were_not_used_for_long_are_forgotten() -> None:
    replays = Replays(torch.device("cpu"), Again(), kept=2)
    for kind in (0, 1, 1, 0, 2, 0, 1):  # 1 is forgotten for 2, and is done as if it were new
        replays.do(kind, lambda kind=kind: {"kind": torch.tensor(kind)})
    assert replays.recorded == 2
    assert int(replays.do(1, lambda: {"kind": torch.tensor(5)})["kind"]) == 5
    assert replays.recorded == 3


def test_where_recording_fails_works_are_done_as_they_are() -> None:
    class Refusing(Recorder):
        def record(self, work: Callable[[], Mapping[str, Tensor]]) -> NoReturn:
            work()
            raise RuntimeError("operation not permitted\nmore about it")

    replays, told, done = Replays(torch.device("cpu"), Refusing()), [0], []

    def work() -> dict[str, Tensor]:
        done.append(told[0])
        return {"told": handed(lambda: torch.tensor(told[0]), torch.device("cpu")).clone()}

    for told[0] in range(5):
        assert int(replays.do("kind", work)["told"]) == told[0]
    assert replays.refused == "operation not permitted"
    assert replays.recorded == 0
    assert done == [0, 1, 1, 2, 3, 4]  # it was tried once
