"""Steps of a scene as CUDA graphs: the results of eager steps, with capacities that follow the counts of samples."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import partial

import fake_accelerator
import pytest
import torch
from mplicits.datasets.views.images import PosedImages
from mplicits.neural_fields.backend.devices import GraphInputs
from mplicits.neural_fields.networks.multiscale import fit_sphere
from mplicits.pipelines.reconstruct import model as scene_model
from mplicits.pipelines.reconstruct.objective import GraphTrainer, SceneObjective
from mplicits.pipelines.training.cuda_graphs import (
    CudaGraphRecorder,
    GraphCache,
    Recorder,
    Results,
    Work,
)
from mplicits.pipelines.training.trainer import Trainer
from reconstructions import QUICK, SMALL_PATCHES, TINY_SCENE, painted_sphere, scene_parts, weights, without
from recorders import EagerRecorder
from torch import Tensor

TINY = replace(TINY_SCENE, steps=34, jets=400, **QUICK)
KINDS = {
    "masks": TINY,
    "outside": replace(TINY, background="outside"),
    "neus": replace(TINY, geometry="neus", steps=20, march_grid=0),
    "cameras": replace(TINY, exposure="affine", cameras="refined"),
    "depths": TINY,
    "consistency": replace(TINY, consistency=0.5, cameras="refined"),
}


@pytest.fixture(autouse=True)
def _short_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Starts from a rough sphere."""
    monkeypatch.setattr(scene_model, "fit_sphere", partial(fit_sphere, steps=40, batch=256))
    monkeypatch.setattr(SceneObjective, "patches", SMALL_PATCHES)


@pytest.fixture(scope="module")
def images() -> PosedImages:
    return painted_sphere(4, 16, depths=True)


def scene(images: PosedImages, name: str, device: torch.device) -> SceneObjective:
    images = images if name != "outside" else without(images, "mask")
    parts, others = scene_parts(images, KINDS[name], depths=name == "depths", device=device)
    assert others["measured"] is None or len(others["measured"])
    return SceneObjective(*parts, **others)


def replaying(images: PosedImages, name: str, device: torch.device) -> GraphTrainer:
    objective = scene(images, name, device)
    recorder = CudaGraphRecorder() if device.type == "cuda" else EagerRecorder()
    return GraphTrainer(objective, recorder=recorder, stage="reconstruct", steps=objective.config.steps)


def never(self: GraphCache, kind: Hashable, work: Callable[[], Mapping[str, Tensor]]) -> Mapping[str, Tensor]:
    """Replaces `GraphCache.run`: every run is eager, as the first one."""
    with GraphInputs(self.device).recording():
        return work()


@pytest.mark.parametrize("name", KINDS)
def test_replayed_steps_are_the_same(name: str, images: PosedImages, monkeypatch: pytest.MonkeyPatch) -> None:
    trainers = [replaying(images, name, torch.device("cpu")) for _ in range(2)]
    assert trainers[0].run()
    recorded = trainers[0].graphs.recorded
    assert 2 <= recorded < TINY.steps / 2
    assert trainers[0].facts() == {"recorded": recorded, "not_taken": trainers[0].not_taken}
    with monkeypatch.context() as patch:
        patch.setattr(GraphCache, "run", never)
        assert trainers[1].run()
    torch.testing.assert_close(weights(trainers[1]), weights(trainers[0]), rtol=0, atol=0)


# Which have all terms between them.
@pytest.mark.parametrize("name", ["outside", pytest.param("cameras", marks=pytest.mark.slow), "depths", "consistency"])
def test_the_host_never_waits_for_a_replayed_step(name: str, images: PosedImages, accelerator: torch.device) -> None:
    here, there = (replaying(images, name, device) for device in (torch.device("cpu"), accelerator))
    assert here.run()
    if accelerator.type == "cuda":
        assert there.run()
        assert all(bool(tensor.isfinite().all()) for tensor in weights(there).values())
        return
    for step in range(there.steps):
        recorded = there.graphs.recorded
        with fake_accelerator.counted() as book:
            there._step()
        if step % 16 not in (0, 15) and there.graphs.recorded == recorded:
            assert book.synchronisations == 0 or step < 2, (step, book.report())
    torch.testing.assert_close(weights(there), weights(here), rtol=0, atol=0)


def test_the_first_steps_equal_eager_ones(images: PosedImages) -> None:
    usual = Trainer(scene(images, "masks", torch.device("cpu")), stage="reconstruct", steps=TINY.steps)
    trainer = replaying(images, "masks", torch.device("cpu"))
    for _ in range(6):  # as long as there is no other number of rays
        losses = usual._step(), trainer._step()
        for one, other in zip(losses[0].values(), losses[1].values(), strict=True):
            assert float(other) == pytest.approx(float(one), rel=1e-4)


class Unnoticed(Recorder):
    """Like a CUDA graph, its replay does not change the versions of tensors; here it does nothing at all."""

    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        return lambda: None, work()


def test_a_replay_counts_as_a_change_of_the_weights(images: PosedImages) -> None:
    """The fused kernels pack the weights again when their versions change."""
    trainer = replaying(images, "masks", torch.device("cpu"))
    trainer.graphs.recorder = Unnoticed()
    for _ in range(3):
        before = [parameter._version for parameter in trainer.trained]
        trainer._step()
        assert all(new._version > old for new, old in zip(trainer.trained, before, strict=True))
    assert trainer.graphs.recorded > 0


def test_a_step_that_exceeds_its_capacity_is_not_taken_and_the_capacity_grows(images: PosedImages) -> None:
    trainer = replaying(images, "masks", torch.device("cpu"))
    for _ in range(16):
        trainer._step()
    kind = trainer.objective.before_step(trainer.step, trainer.fraction)._replace(rays=32)
    trainer.capacities = {kind: (1, 1, 1, 1)}
    trainer.requested = {}  # so that they are not found too small
    before = weights(trainer)
    moments = {name: tensor.clone() for name, tensor in trainer.state().items() if name.startswith(("adam.", "muon."))}
    trainer.objective.before_step = lambda step, done: kind  # pyright: ignore[reportAttributeAccessIssue]
    trainer._step()
    for name, tensor in weights(trainer).items():
        assert name == "geometry.deltas" or torch.equal(tensor, before[name]), name
    assert all(torch.equal(tensor, trainer.state()[name]) for name, tensor in moments.items())
    for _ in range(15):
        trainer._step()
    assert trainer.not_taken == 16
    trainer._step()
    assert all(new >= 256 for new in trainer.capacities[kind])
    assert any(not torch.equal(tensor, before[name]) for name, tensor in weights(trainer).items())


def test_a_resumed_run_records_again_and_goes_on(images: PosedImages) -> None:
    trainer, other = (replaying(images, "masks", torch.device("cpu")) for _ in range(2))
    for _ in range(8):
        trainer._step()
    state = {name: tensor.clone() for name, tensor in trainer.state().items()}
    for _ in range(3):
        trainer._step()
    assert trainer.graphs.recorded > 0
    for one in (trainer, other):
        one.restore({name: tensor.clone() for name, tensor in state.items()})  # the trainer changes them in place
        assert one.graphs.recorded == 0
        for _ in range(4):
            one._step()
    torch.testing.assert_close(weights(trainer), weights(other), rtol=0, atol=0)


def test_capacities_follow_the_requested_rows_and_stay_while_they_suit(images: PosedImages) -> None:
    trainer = replaying(images, "masks", torch.device("cpu"))
    kind = trainer.objective.before_step(0, 0.0)._replace(rays=100)
    assert trainer._capacities(kind) is None  # before anything is known all rows have a place
    # 1.25 times as many and 64, in whole 256s; changed where more than 95 % are requested, or less than half would do.
    for requested, capacity in ((10.0, 1536), (14.0, 1536), (15.0, 2048), (6.0, 2048), (5.0, 768)):
        trainer.requested[kind.level] = [requested, 5.0, 0.0, 2.0]
        assert trainer._capacities(kind) == (capacity, 768, 256, 512)
