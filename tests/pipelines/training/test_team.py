"""Several processes train as one does."""

import os
import socket
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
import torch.multiprocessing as multiprocessing
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.neural_fields import Siren
from mplicits.neural_fields.networks.sphere_init import fit_sphere
from mplicits.pipelines.fit.level import LevelObjective
from mplicits.pipelines.fit.samples import Samples, Source
from mplicits.pipelines.reconstruct.model import model as scene_model
from mplicits.pipelines.reconstruct.model import objective as scene_objective
from mplicits.pipelines.reconstruct.model.model import RayPool, build_scene
from mplicits.pipelines.reconstruct.model.replayed import scene_trainer
from mplicits.pipelines.training.settings import ReconstructConfig
from mplicits.pipelines.training.team import (
    agreed,
    apart,
    as_the_leader,
    average_gradients,
    gathered,
    is_alone,
    is_leader,
    mean_of_all,
    my_share,
    own_generator,
    team,
    whole_batch,
)
from mplicits.pipelines.training.trainer import Trainer
from reconstructions import TINY_SCENE

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


# How many random numbers a step takes is decided by the light that gets outside.
SCENE = replace(TINY_SCENE, steps=6, background="outside")


def scene_gradients() -> dict[str, torch.Tensor]:
    """Of one step of a reconstruction, all sections evaluated and none jittered."""
    before, scene_objective.own_generator = scene_objective.own_generator, lambda _: None  # type: ignore[assignment]
    try:
        trainer = scene_trainer_of(replace(SCENE, skip=0.0))
        trainer.objective.losses(0, 0.0)[1].backward()
        average_gradients(trainer.trained)
    finally:
        scene_objective.own_generator = before
    named = trainer.objective.network.named_parameters()
    return {name: parameter.grad for name, parameter in named if parameter.grad is not None}


def scene_trained() -> dict[str, torch.Tensor]:
    """A few steps of a reconstruction, as users have them → all that a later step depends on."""
    trainer = scene_trainer_of(SCENE)
    assert trainer.run()
    state = trainer.state()
    return {name: value for name, value in state.items() if name != "progress"}


def scene_trainer_of(config: ReconstructConfig) -> Trainer[scene_objective.SceneObjective]:
    images = render_scene(SCENES["painted-sphere"](), views=4, size=16, samples=1)
    scene_model.fit_sphere = partial(fit_sphere, steps=20, batch=256)  # a rough one will do
    try:
        model = build_scene(config, has_masks=False)
    finally:
        scene_model.fit_sphere = fit_sphere
    return scene_trainer(model, RayPool(images.views, images.similarity, torch.device("cpu"), whole=True), config)


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
        shared = torch.Generator().manual_seed(0)
        mine = torch.rand((), generator=own_generator(shared))
        assert gathered(mine[None]).unique().numel() == 2  # each has its own numbers, and all share the rest
        assert gathered(torch.rand(1, generator=shared)).unique().numel() == 1
        assert float(mean_of_all(torch.tensor(float(rank)))) == 0.5
        as_the_leader([mine])
        assert gathered(mine[None]).unique().numel() == 1
        of_one, of_none = (torch.ones(2, requires_grad=True) for _ in range(2))
        if rank:
            of_one.sum().backward()
        average_gradients([of_one, of_none])
        assert of_one.grad is not None
        assert of_one.grad.tolist() == [0.5, 0.5]
        assert of_none.grad is None
        torch.save(scene_gradients(), Path(folder) / f"gradients_{rank}.pt")
        torch.save(scene_trained(), Path(folder) / f"scene_{rank}.pt")
        if leads:
            with apart():  # the other one is not there
                assert is_alone()
                assert gathered(mine[None]).tolist() == [float(mine)]
                assert scene_gradients()
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
    alone = scene_gradients()
    first, second = (torch.load(tmp_path / f"gradients_{rank}.pt") for rank in range(2))
    assert set(alone) == set(first)
    for name, expected in alone.items():
        assert torch.equal(first[name], second[name])
        assert torch.allclose(first[name], expected, rtol=0, atol=1e-4 * float(expected.abs().max())), name
    first, second = (torch.load(tmp_path / f"scene_{rank}.pt") for rank in range(2))
    for name, of_first in first.items():
        assert torch.equal(of_first, second[name]), name


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
