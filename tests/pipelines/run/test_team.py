"""Several processes train as one does."""

import os
import socket
from pathlib import Path

import pytest
import torch
import torch.multiprocessing as multiprocessing
from mplicits.neural_fields import Siren
from mplicits.pipelines.fit.level import LevelObjective
from mplicits.pipelines.fit.samples import Samples, Source
from mplicits.pipelines.run.team import agreed, average_gradients, is_leader, my_share, team, whole_batch
from mplicits.pipelines.run.trainer import Trainer

STEPS = 12


def trained() -> tuple[dict[str, torch.Tensor], int]:
    """A sphere, by a batch that two can share → weights, and rows of a batch that this process looked at."""
    torch.manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(500, 3), dim=1) * 0.5
    samples = Samples(points, distance=torch.zeros(500), normal=2 * points)
    network = Siren(16, 1, omega=15.0)
    sources = [Source("surface", samples, 64, 1e3, 100.0, 50.0)]
    objective = LevelObjective(network, sources, learning_rate=1e-3, generator=torch.Generator().manual_seed(1))
    assert Trainer(objective, stage="", steps=STEPS).run()
    return network.state_dict(), len(objective._draw(sources[0]))


def worker(rank: int, port: int, folder: str) -> None:
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "RANK": str(rank)}
    torch.set_num_threads(1)
    with team(device="cpu") as leads:
        assert leads == is_leader() == (rank == 0)
        assert whole_batch(5) == 6
        assert my_share(torch.arange(6)).tolist() == [rank, rank + 2, rank + 4]
        # One is asked to stop, the other is slower: both hear of it.
        assert agreed(rank == 1, 2.0 + rank, torch.device("cpu")) == (True, 3.0)
        weights, rows = trained()
        assert rows == 32
        torch.save(weights, Path(folder) / f"{rank}.pt")
    assert is_leader()


def test_two_processes_train_as_one_does(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    multiprocessing.spawn(worker, (port, str(tmp_path)), nprocs=2)  # pyright: ignore[reportPrivateImportUsage]
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    alone, rows = trained()
    assert rows == 64
    torch.manual_seed(0)
    begun = Siren(16, 1, omega=15.0).state_dict()
    for name, expected in alone.items():
        assert torch.equal(first[name], second[name])
        moved = float((expected - begun[name]).abs().max())
        assert float((first[name] - expected).abs().max()) < 1e-3 * moved, name


def test_alone_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with team() as leads:
        assert leads
        assert whole_batch(5) == 5
        assert my_share(torch.arange(3)).tolist() == [0, 1, 2]
        assert agreed(False, 1.5, torch.device("cpu")) == (False, 1.5)
        parameter = torch.ones(2, requires_grad=True)
        parameter.sum().backward()
        average_gradients([parameter])
        assert parameter.grad is not None
        assert parameter.grad.tolist() == [1.0, 1.0]
