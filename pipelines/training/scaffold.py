"""What every training shares: its time budget, its checkpoints, and how it is resumed and recorded."""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import math
import os
import platform
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from ...neural_fields import Field, Similarity
from ...neural_fields.backend.devices import choose_device
from .folder import RunFolder
from .progress import Report
from .settings import TrainingSettings
from .trainer import StopFlag, Trainer, checkpoint_of, without_prefix

C = TypeVar("C", bound=TrainingSettings)
F = TypeVar("F", bound=nn.Module)


@dataclass(frozen=True)
class BudgetOptions:
    """Numbers by which a time budget is shared out."""

    fewest_steps: int = 60  # a level is not worth fewer, or fewer than a quarter of its own: its rate is hardly warm
    fewest_samples: int = 5_000  # of each kind
    sampling_share: float = 1 / 3  # of the time, for samples, where it is too short for all
    least_seconds: float = 0.5  # of training where a budget leaves none
    timed: int = 4  # steps; the fastest counts
    timing_share: float = 0.02  # of the time left that timed steps may take


BUDGET = BudgetOptions()


class Budget:
    """A time budget in seconds (None: no limit) from ``started`` (`time.monotonic`; None: now), and its effects.

    Attributes:
        before: seconds that interrupted processes spent on what they kept.
        left_out: levels that are not trained.
        notes: sentences on what has changed, for the user.
    """

    def __init__(self, seconds: float | None, *, started: float | None = None) -> None:
        self.seconds = seconds
        self.started = time.monotonic() if started is None else started
        self.before = 0.0
        self.left_out: list[int] = []
        self.notes: list[str] = []

    def left(self) -> float | None:
        """Seconds left, at least 0; None without a limit."""
        if self.seconds is None:
            return None
        return max(self.seconds - self.before - (time.monotonic() - self.started), 0.0)

    def share(
        self,
        seconds: float,
        level: int,
        steps: Sequence[int],
        cost: Callable[[int], float],
        *,
        training: float = 1.0,
        begun: bool = False,
    ) -> float | None:
        """Seconds for the next level: ``seconds`` times its part of the work that is left, ``steps`` times ``cost``.

        The finest levels are left out while the levels before them would get less than `fewest_steps`, or than a
        quarter of their steps. None means that the level is not worth beginning; one that has ``begun``, as level 0
        always has, is finished. ``training`` is the share of a level's time that is spent on steps.
        """
        levels, work = list[int](), list[float]()
        for each in range(level, len(steps)):
            work.append(steps[each] * cost(each))
            if work[-1] * least_share(steps[each]) > training * seconds:
                work.pop()
                break
            levels.append(each)
        while levels and training * seconds < math.fsum(work) * max(least_share(steps[each]) for each in levels):
            del levels[-1], work[-1]
        if levels:
            return seconds * work[0] / math.fsum(work)
        return seconds if begun or level == 0 else None

    def leave_out(self, first: int, levels: int, why: str = "") -> None:
        """Record that the levels from ``first`` up to ``levels`` are not trained, and why."""
        self.left_out = list(range(first, levels))
        names = f"level {first} is" if len(self.left_out) == 1 else f"levels {first} to {levels - 1} are"
        self.notes.append(f"{names} left out: {why or f'too little time for {BUDGET.fewest_steps} steps'}")

    def record(self) -> dict[str, Any]:
        """For ``run.json``."""
        about = {"seconds": self.seconds, "left_out": self.left_out, "notes": self.notes}
        return {"budget": about} if self.seconds is not None or self.notes else {}


def least_share(steps: int) -> float:
    """The smallest share of a level's steps that is worth beginning, see `BudgetOptions.fewest_steps`."""
    return min(BUDGET.fewest_steps / steps, 0.25) if steps else 0.0


def step_seconds(step: Callable[[], Tensor], left: float) -> float:
    """Measured seconds of a training step, which computes a loss: the fastest of a few.

    They take a small share of the ``left`` seconds of the budget.
    """
    least, begun = math.inf, time.monotonic()
    for _ in range(BUDGET.timed):
        started = time.monotonic()
        loss = step()
        loss.backward()
        float(loss.detach())  # waits for a GPU
        now = time.monotonic()
        least = min(least, now - started)
        if now - begun > BUDGET.timing_share * left:
            break
    return least


def affordable(
    make: Callable[[int], object], count: int, seconds: float, *, fewest: int = BUDGET.fewest_samples
) -> int:
    """How many samples can be made within ``seconds``: from ``fewest`` to ``count``.

    ``make`` makes a half and twice the ``fewest``, which are timed and dropped. More cost the difference.
    """
    if count <= fewest:
        return count
    took = list[float]()
    for few in (max(fewest // 8, 1), max(fewest // 2, 1), 2 * fewest):  # the first fills caches
        started = time.monotonic()
        make(min(few, count))
        took.append(time.monotonic() - started)
        if took[-1] > seconds:
            return fewest
    each = max(took[2] - took[1], 0.1 * took[2]) / (1.5 * fewest)
    return max(fewest, min(count, int(2 * fewest + (seconds - took[2]) / each)))


class Training(ABC, Generic[C, F]):
    """A training under way, in levels or all at once: settings, run folder, time budget, and what is done.

    A subclass sets ``similarity`` and ``fingerprint`` (a digest of what it learns from), trains with `take_steps`, says
    by `record` what ``run.json`` holds, and calls `restored` to go on. A training of levels sets `frozen`, appends to
    `stages` (each with its seconds under names that end in ``_seconds``) and calls `save` when a level is done.

    Attributes:
        frozen: the levels that are done.
        stages: a record of each of them.
        trainer_state: of the level that was interrupted; empty otherwise.
        costs: measured seconds of a step, by level.
    """

    similarity: Similarity
    fingerprint: str

    def __init__(self, config: C, folder: RunFolder, budget: Budget, report: Report) -> None:
        self.config, self.folder, self.budget, self.report = config, folder, budget, report
        self.device = choose_device(config.device)
        self.frozen: F | None = None
        self.stages: list[dict[str, Any]] = []
        self.trainer_state: dict[str, Tensor] = {}
        self.costs: dict[int, float] = {}

    @abstractmethod
    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""

    def kept(self) -> Mapping[str, Any]:
        """What a resumed run needs beside the stages, as JSON."""
        return {}

    def kept_tensors(self) -> Mapping[str, Tensor]:
        """The tensors that a resumed run needs beside the levels and the trainer's state."""
        return {}

    def common_record(self, *, finished: bool) -> dict[str, Any]:
        """What the records of all trainings hold."""
        return {
            "finished": finished,
            "similarity": dataclasses.asdict(self.similarity),
            "config": dataclasses.asdict(self.config),
            **self.budget.record(),
            "environment": environment(self.device),
        }

    def stages_record(self) -> dict[str, Any]:
        """What the records of trainings in levels hold beside that."""
        return {
            "stages": self.stages,
            "parameters": sum(stage["parameters"] for stage in self.stages),
            "deltas": [stage["delta"] for stage in self.stages if stage["delta"] is not None],
            "training_seconds": round(self._stage_seconds(), 3),
        }

    def take_steps(
        self, trainer: Trainer[Any], flag: StopFlag, field: Callable[[], Field], report: Report | None = None
    ) -> bool:
        """Train, from where the run was interrupted, and keep checkpoints of ``field`` → whether it came to its end."""
        if self.trainer_state:
            trainer.restore(self.trainer_state)
            self.trainer_state = {}
        return trainer.run(flag, report=report or self.report, save=lambda: self.save(field(), trainer))

    def save(self, field: Field, trainer: Trainer[Any] | None) -> None:
        """Write a usable field and all that `restored` needs."""
        tensors = {**checkpoint_of(self.frozen, trainer), **self.kept_tensors()}
        progress = {"fingerprint": self.fingerprint, "stages": self.stages, "notes": self.budget.notes, **self.kept()}
        self.folder.save(field, self.similarity, self.record(finished=False), tensors, progress)

    def restored(self, mismatch: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Take up the stages, the state of the trainer and the seconds of an interrupted run; see `RunFolder.restore`.

        Returns:
            All tensors and the progress that `save` has kept, for what a subclass has added.
        """
        tensors, progress = self.folder.restore(self.fingerprint, mismatch)
        self.stages, self.budget.notes = progress.get("stages", []), progress.get("notes", [])
        self.trainer_state = without_prefix("trainer.", tensors)
        if not self.trainer_state and "progress" in tensors:  # of older versions, where there are no levels
            self.trainer_state = tensors
        self.budget.before = self._stage_seconds() + self.elapsed
        return tensors, progress

    @property
    def elapsed(self) -> float:
        """Seconds that the interrupted level was trained before; 0 if none was interrupted."""
        return float(self.trainer_state["progress"][1]) if self.trainer_state else 0.0

    def _stage_seconds(self) -> float:
        return sum(stage[name] for stage in self.stages for name in stage if name.endswith("_seconds"))

    def share(self, level: int, steps: Sequence[int], left: float | None, **options: float) -> float | None:
        """`Budget.share` of ``left`` seconds by `cost`; infinite without a budget, None if not worth beginning."""
        if left is None:
            return math.inf
        return self.budget.share(left, level, steps, self.cost, begun=bool(self.trainer_state), **options)

    def cost(self, level: int) -> float:
        """Measured seconds of a training step of a level."""
        if level not in self.costs:
            self.costs[level] = step_seconds(self.timed_step(level), self.budget.left() or 0.0)
        return self.costs[level]

    def timed_step(self, level: int) -> Callable[[], Tensor]:
        """The loss of a level in a training step, on networks that are not trained."""
        raise NotImplementedError(f"{type(self).__name__} has no levels")


_version = functools.cache(importlib.metadata.version)  # it reads files, and every checkpoint has a record


def environment(device: torch.device) -> dict[str, Any]:
    """What the figures of a run depend on: versions, threads, machine."""
    return {
        "versions": {name: _version(name) for name in ("mplicits", "torch", "numpy", "scipy", "safetensors")},
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "cpu_count": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
    }
