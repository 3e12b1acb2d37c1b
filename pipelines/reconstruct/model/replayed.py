"""The training of a scene on a GPU: each kind of step is recorded once, in fixed shapes, and then replayed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ....neural_fields.backend.devices import handed
from ....neural_fields.backend.fixed_shapes import FixedShapes, fixed_shapes
from ...training.replay import CudaGraphs, Recorder, Replays
from ...training.settings import ReconstructConfig
from ...training.trainer import Trainer
from ..data.measured import MeasuredDepths
from .model import RayPool, SceneModel
from .objective import Kind, SceneObjective

CHOICES = ("sections", "colors", "outside")


@dataclass(frozen=True)
class Capacity:
    """How many rows a recorded step has room for: for n requested, ``spare`` n + ``more``, in multiples of ``step``."""

    spare: float = 1.25
    more: int = 64
    step: int = 256
    full: float = 0.95  # share of the capacity that may be requested before it is enlarged
    empty: float = 0.5  # share of the capacity below which a new one has to lie to replace it
    ray_counts: int = 8  # numbers of rays are multiples of this share of the most, 1 / ``ray_counts``

    def of(self, need: float) -> int:
        """Rows to reserve."""
        return self.step * math.ceil((self.spare * need + self.more) / self.step)

    def suits(self, room: int, need: float) -> bool:
        """Whether reserved rows are neither too few for what is requested now, nor far too many."""
        return need <= self.full * room and self.of(need) >= self.empty * room


# How many rows each of the CHOICES of a step has room for, and then each band; None for all.
Rooms = tuple[int, ...] | None


class ReplayedTrainer(Trainer[SceneObjective]):
    """A `Trainer` of a scene whose steps are replayed.

    How many sections of rays are evaluated, lie in bands, and get colours differs from step to step, and a recorded
    step has room for given numbers. They follow, every sixteen steps, from the most that was asked for in the last
    sixteen. A step in which a room was too small is not taken: its gradient would leave something out.

    Args:
        objective: of a scene.
        recorder: how steps are recorded; None for CUDA's graphs.
        others: of `Trainer`.
    """

    capacity = Capacity()

    def __init__(self, objective: SceneObjective, *, recorder: Recorder | None = None, **others: Any) -> None:
        super().__init__(objective, **others)
        device = self.trained[0].device
        self.replays = Replays(device, recorder or CudaGraphs())
        for group in self.adam.param_groups:
            group["capturable"] = device.type == "cuda"
        # What rows were asked for, of CHOICES and residual levels, the most of late; and steps that were not taken.
        self.peaks = torch.zeros(len(CHOICES) + len(objective.model.geometry.deltas) + 1, device=device)
        self.rooms: dict[Kind, tuple[int, ...]] = {}
        self.asked: dict[int, list[float]] = {}  # by the level that is on: what a ray asked for, at most
        self.left_out = 0

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """See `Trainer.restore`; what was recorded is forgotten, because it is about other memory."""
        super().restore(state)
        self.replays = Replays(self.replays.device, self.replays.recorder)

    def facts(self) -> dict[str, Any]:
        """Kinds of steps that were recorded, steps that were not taken, and why nothing is recorded, if so."""
        refused = {"refused": self.replays.refused} if self.replays.refused else {}
        return {"recorded": self.replays.recorded, "not_taken": self.left_out, **refused}

    def _step(self) -> dict[str, Tensor]:
        kind = self.objective.ahead(self.step, self.fraction)
        part = math.ceil(self.objective.config.rays / self.capacity.ray_counts)
        kind = kind._replace(rays=math.ceil(kind.rays / part) * part)
        rooms = self._rooms(kind)
        found = dict(self.replays.do((kind, rooms), lambda: self._work(kind, rooms)))
        # A replay changes parameters behind PyTorch's back; the fused kernels pack them again by their versions.
        torch.autograd.graph.increment_version(self.trained)
        sections = found.pop("sections")
        self.objective.behind(self.step, sections)
        self.step += 1
        if self.step % self.objective.schedule.near_every == 0:
            self._learn(kind)
        return found

    def _work(self, kind: Kind, rooms: Rooms) -> dict[str, Tensor]:
        """A step as the device does it."""
        objective = self.objective
        rates = handed(
            lambda: torch.tensor([rate(objective.done) for _, rate in objective.groups]), self.trained[0].device
        )
        for group, rate in zip(self.adam.param_groups, rates.unbind(), strict=True):
            group["lr"] = rate
        given = rooms or ()
        with fixed_shapes(given[len(CHOICES) :], rooms=dict(zip(CHOICES, given, strict=False))) as shapes:
            outcome = objective.evaluate(kind)
        with torch.no_grad():
            asked = self._asked(shapes)
            over = [asked[row] > room for row, room in enumerate(given)]
            lost = torch.stack(over).any().float() if over else asked.new_zeros(())
            self.peaks[: len(asked)] = torch.maximum(self.peaks[: len(asked)], asked)
            self.peaks[-1] += lost
        self.adam.found_inf = lost  # pyright: ignore[reportAttributeAccessIssue]  of a step that is not taken it is 1
        self.descend(outcome.total)
        terms = {name: term.detach() for name, term in outcome.terms.items()}
        return terms | {"sections": outcome.sections}

    def _asked(self, shapes: FixedShapes) -> Tensor:
        """How many rows were to be chosen, of `CHOICES` and in each band."""
        none = self.peaks.new_zeros(())
        bands = [*shapes.demand, *[none] * (len(self.peaks) - 1 - len(CHOICES) - len(shapes.demand))]
        return torch.stack([part.to(none) for part in [shapes.asked.get(name, none) for name in CHOICES] + bands])

    def _rooms(self, kind: Kind) -> Rooms:
        """The rooms of a kind of step: those that it has, as long as they suit what was asked for."""
        old, asked = self.rooms.get(kind), self.asked.get(kind.level)
        if asked is None:
            return old
        wanted = [kind.rays * each for each in asked]
        if old is None or not all(map(self.capacity.suits, old, wanted)):
            self.rooms[kind] = tuple(map(self.capacity.of, wanted))
        return self.rooms[kind]

    def _learn(self, kind: Kind) -> None:
        """Look at what was asked for in the last steps."""
        *peaks, lost = self.peaks.tolist()
        self.asked[kind.level] = [peak / kind.rays for peak in peaks]
        self.left_out += int(lost)
        self.peaks.zero_()


def scene_trainer(
    model: SceneModel,
    pool: RayPool,
    config: ReconstructConfig,
    *,
    measured: MeasuredDepths | None = None,
    seconds: float | None = None,
) -> Trainer[SceneObjective]:
    """The training of a scene; see `SceneObjective` and `Trainer`. On a GPU, it is replayed."""
    objective = SceneObjective(model, pool, config, measured)
    kind = ReplayedTrainer if config.graphs and pool.device.type == "cuda" else Trainer
    return kind(objective, stage="reconstruct", steps=config.steps, seconds=seconds, network_name="model")
