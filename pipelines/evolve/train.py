"""``evolve``: from static shapes to one surface that moves, level by level, in space-time."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...neural_fields import InputError, MultiscaleSDF, Similarity, SpaceTimeSDF
from ..fit.band import delta_of
from ..fit.level import new_level
from ..run.folder import RunFolder, digest_of
from ..run.machine import choose_device, environment, speed
from ..run.motion import VELOCITY_FILE, load_motion
from ..run.schedule import Progress, Report, Schedule
from ..run.settings import EvolveConfig
from ..run.trainer import (
    Interrupted,
    StopFlag,
    Trainer,
    checkpoint_of,
    load_compiler,
    parameter_count,
    restore_frozen,
    stop_on_signals,
    without_prefix,
)
from .checks import check_evolution
from .landmarks import read_landmarks
from .objective import LONGEST_GRADIENT, EvolveObjective, learn_start
from .plan import FEWEST_STEPS, EvolvePlan, within
from .problem import Problem, build_problem
from .shapes import StaticShape, read_shape

__all__ = ["Evolution", "evolve", "train_evolution"]

# Of a time budget, what the start may take; and what is left for a level where all is spent.
STARTING_SHARE, LEAST_SECONDS = 0.2, 0.5


@dataclass(frozen=True)
class Evolution:
    """A finished evolution.

    Attributes:
        field: trained, in unit-sphere coordinates, on the CPU.
        similarity: the way back to the input coordinates of the first shape.
        directory: where it was written, or None.
        record: what ``run.json`` holds.
    """

    field: SpaceTimeSDF
    similarity: Similarity
    directory: Path | None
    record: dict[str, Any]


def evolve(
    config: EvolveConfig,
    *,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Report | None = None,
) -> Evolution:
    """Train a field of space-time.

    Args:
        config: what shall happen to which shapes, and how it is trained.
        out: run directory for the field, the checkpoints and ``run.json``; None writes nothing.
        resume: continue the interrupted run in ``out`` with its own settings; ``config`` is then ignored.
        progress: called now and then with how far the training is.

    Raises:
        InputError: a shape cannot be read or used, or there is nothing to resume.
        Interrupted: Ctrl-C or SIGTERM; ``out`` then holds a checkpoint and a usable field.

    Example:
        >>> from mplicits.pipelines.run.settings import EvolveConfig
        >>> run = evolve(EvolveConfig(shapes=("runs/spot", "runs/bob")), out="runs/morph")  # doctest: +SKIP
        >>> run.record["checks"]["warnings"]  # doctest: +SKIP
    """
    started, folder = time.monotonic(), RunFolder(out, resume=resume)
    config = folder.config(EvolveConfig, config)
    device, schedule = choose_device(config.device), Schedule.of(progress)
    machine, notes = speed(device), list[str]()
    plan, count, shapes = EvolvePlan(config, machine), len(config.shapes), []
    schedule.plan([plan.shapes(), *plan.moving(resume), plan.known(), *plan.stages()], budget=config.time_budget)
    for path in config.landmarks:
        read_landmarks(path)  # before the shapes, which take their time
    for index, text in enumerate(config.shapes):
        schedule(Progress("shapes", index, count, index / count, {}))
        shapes.append(read_shape(text))
    schedule(Progress("shapes", count, count, 1.0, {}))
    load_compiler()
    if config.time_budget is not None and not resume:  # what is resumed has its settings
        config, notes = within(config, machine, max(config.time_budget - (time.monotonic() - started), 0.0))
    motion = load_motion(folder.path) if resume and folder.path else None
    schedule(Progress("known samples", 0, 0, 0.0, {}))
    problem = build_problem(shapes, config, motion=motion, progress=schedule)
    schedule(Progress("known samples", 0, 0, 1.0, {}))
    return train_evolution(
        problem, config, shapes=shapes, out=out, resume=resume, progress=schedule, started=started, notes=notes
    )


def train_evolution(
    problem: Problem,
    config: EvolveConfig,
    *,
    shapes: list[StaticShape] | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Report | None = None,
    started: float | None = None,
    notes: Sequence[str] = (),
) -> Evolution:
    """`evolve` for a problem that was put together by hand; see there.

    The time budget counts from ``started``, by `time.monotonic`, or from now; ``notes`` say what it has changed so far.
    """
    names, folder = [shape.name for shape in shapes or []], RunFolder(out, resume=resume)
    device, schedule = choose_device(config.device), Schedule.of(progress)
    training = _Evolving(problem, names, config, device, folder, schedule)
    training.started = time.monotonic() if started is None else started
    training.notes = list(notes)
    with folder.writing(VELOCITY_FILE), stop_on_signals() as flag:
        if resume:
            training.restore()
        elif problem.motion is not None:
            folder.keep_tensors(VELOCITY_FILE, problem.motion.state_dict())
        return training.run(flag)


class _Evolving:
    """One evolution under way: the frozen levels, and the records of their stages."""

    def __init__(
        self,
        problem: Problem,
        names: list[str],
        config: EvolveConfig,
        device: torch.device,
        folder: RunFolder,
        schedule: Schedule,
    ) -> None:
        self.problem, self.names, self.config, self.device = problem, names, config, device
        self.folder, self.schedule = folder, schedule
        self.plan, self.started, self.before = EvolvePlan(config, speed(device)), time.monotonic(), 0.0
        self.notes: list[str] = []  # what the time budget changed
        self.left_out: list[int] = []
        self.fingerprint = digest_of(part.numpy() for part in vars(problem.known).values())
        self.frozen: SpaceTimeSDF | None = None
        self.stages: list[dict[str, Any]] = []
        self.trainer_state: dict[str, Tensor] = {}

    def run(self, flag: StopFlag) -> Evolution:
        for level in range(len(self.stages), self.config.num_levels):
            self.schedule.plan(self.plan.stages(level, begun=bool(self.trainer_state)), budget=self.left())
            if not self.trainer_state and not self.is_worth(level):
                self.leave_out(level)
                break
            self.train_level(level, flag)
        self.schedule.plan([self.plan.checking()])
        assert self.frozen is not None
        field = self.frozen.cpu()
        record = self.record(finished=True)

        def count(done: int, total: int) -> None:
            self.schedule(Progress("checks", done, total, done / total, {}))

        count(0, 1)
        frames, resolution = self.config.frames, self.config.resolution
        record["checks"] = check_evolution(
            field, self.problem.ends, self.problem.similarity, frames=frames, resolution=resolution, count=count
        )
        record = self.folder.finish(field, self.problem.similarity, record)
        return Evolution(field, self.problem.similarity, self.folder.out, record)

    def train_level(self, level: int, flag: StopFlag) -> None:
        """Begin one level, train it, freeze it."""
        config, started = self.config, time.monotonic()
        generator = torch.Generator().manual_seed(config.seed * 1009 + level)
        delta = self.next_delta() if level else None
        field = self.begun(level, delta, generator)
        beginning_seconds = time.monotonic() - started
        try:
            objective = EvolveObjective(field, self.problem, config, level=level, generator=generator)
        except ValueError as error:
            raise InputError(
                f"{error}; train the level before longer (--steps), or widen the band (--epsilon)"
            ) from error
        seconds, steps = self.seconds_for(level), config.steps[level]
        trainer = Trainer(objective, stage=f"level {level}", steps=steps, seconds=seconds, clip=LONGEST_GRADIENT)
        if self.trainer_state:
            trainer.restore(self.trainer_state)
            self.trainer_state = {}
        if not trainer.run(flag, report=self.schedule, save=lambda: self.save(field, trainer)):
            raise Interrupted(self.folder.out)
        self.frozen = field.requires_grad_(False)
        errors = self.errors_at_ends()
        self.stages.append(
            {
                "level": level,
                "parameters": parameter_count(field.sdf.levels[level]),
                "delta": delta,
                "known": len(objective.known),
                "beginning_seconds": round(beginning_seconds, 3),
                "training_seconds": round(trainer.elapsed, 3),
                "steps": trainer.step,
                "ended_by_time_budget": trainer.ended_early,
                "losses": trainer.losses,
                "rms_at_ends": float(errors.square().mean().sqrt()),
                "max_at_ends": float(errors.abs().max()),
            }
        )
        self.save(field, None)

    def begun(self, level: int, delta: float | None, generator: torch.Generator) -> SpaceTimeSDF:
        """The field with one more level, which is all that is to be trained; of a resumed run with random weights."""
        config = self.config
        if level == 0:
            if self.trainer_state:
                return self.empty(1).to(self.device)
            left = self.left()
            seconds = None if left is None else max(STARTING_SHARE * left, LEAST_SECONDS)
            known = self.problem.known.to(self.device)
            return learn_start(known, config, generator, self.schedule, seconds=seconds).to(self.device)
        assert self.frozen is not None
        assert delta is not None
        residual = new_level(config, level, residual=True, in_dim=4)
        with torch.no_grad():
            residual.layers[0].weight[:, 3] *= config.time_gain  # pyright: ignore[reportIndexIssue]
        return self.frozen.with_level(residual.to(self.device), delta=delta).to(self.device)

    def empty(self, levels: int) -> SpaceTimeSDF:
        """Untrained levels, to be filled from a state."""
        sirens = [new_level(self.config, level, residual=False, in_dim=4) for level in range(levels)]
        return SpaceTimeSDF(MultiscaleSDF(sirens[0], sirens[1:], [1.0] * (levels - 1)))

    def next_delta(self) -> float:
        """Half-width of the band around the last frozen level (Eq. 5)."""
        delta = delta_of(self.errors_at_ends(), epsilon=self.config.epsilon, quantile=None)
        return max(delta, self.config.least_delta)

    @torch.no_grad()
    def errors_at_ends(self) -> Tensor:
        """Values of the finest frozen level on the surfaces that shall be met → ``(n,)`` on the CPU."""
        assert self.frozen is not None
        rows = [torch.nn.functional.pad(end.points, (0, 1), value=end.time) for end in self.problem.ends]
        return torch.cat([self.frozen.value(part.to(self.device)).cpu() for part in torch.cat(rows).split(1 << 16)])

    def left(self) -> float | None:
        """Seconds of the time budget that are left for levels: all but the checks at the end."""
        budget = self.config.time_budget
        if budget is None:
            return None
        left = budget - self.before - (time.monotonic() - self.started)
        return max(left - min(self.schedule.predicted(self.plan.checking()), left / 2), LEAST_SECONDS)

    def seconds_for(self, level: int) -> float | None:
        """How long this level may train within the time budget: by the work that its steps are, if it is too little."""
        left = self.left()
        if left is None:
            return None
        work = [self.plan.level(each).seconds for each in range(level, self.config.num_levels)]
        while len(work) > 1 and left * work[-1] / sum(work) < self.least_seconds(level + len(work) - 1):
            work.pop()  # it will be left out
        took = float(self.trainer_state["progress"][1]) if self.trainer_state else 0.0
        return left * work[0] / math.fsum(work) + took

    def least_seconds(self, level: int) -> float:
        """Training that makes a level worth beginning."""
        steps = min(FEWEST_STEPS, -(-self.config.steps[level] // 4))
        return steps * self.plan.step_seconds(level) * self.schedule.slowness("steps")

    def is_worth(self, level: int) -> bool:
        """Whether a level is to be trained; level 0 is in any case."""
        left = self.left()
        return left is None or level == 0 or left >= self.least_seconds(level)

    def leave_out(self, first: int) -> None:
        """Say that levels are not trained."""
        self.left_out = list(range(first, self.config.num_levels))
        names = f"level {first} is" if len(self.left_out) == 1 else f"levels {first} to {self.left_out[-1]} are"
        self.notes.append(f"{names} left out: too little time for {FEWEST_STEPS} steps")

    def save(self, field: SpaceTimeSDF, trainer: Trainer[EvolveObjective] | None) -> None:
        """Write a usable field and all that `restore` needs."""
        tensors = checkpoint_of(self.frozen, trainer)
        progress = {"fingerprint": self.fingerprint, "stages": self.stages, "notes": self.notes}
        self.folder.save(field, self.problem.similarity, self.record(finished=False), tensors, progress)

    def restore(self) -> None:
        """Take up an interrupted run; see `RunFolder.restore`."""
        names = ", ".join(self.names)
        mismatch = f"{names}: not the shapes that {self.folder.path} was trained on; bring those back"
        tensors, progress = self.folder.restore(self.fingerprint, mismatch)
        self.stages, self.notes = progress["stages"], progress.get("notes", [])
        if self.stages:
            self.frozen = restore_frozen(self.empty(len(self.stages)).to(self.device), tensors)
        self.trainer_state = without_prefix("trainer.", tensors)
        took = sum(stage["beginning_seconds"] + stage["training_seconds"] for stage in self.stages)
        self.before = took + (float(self.trainer_state["progress"][1]) if self.trainer_state else 0.0)

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""
        seconds = sum(stage["beginning_seconds"] + stage["training_seconds"] for stage in self.stages)
        limit = self.config.time_budget
        budget = {"seconds": limit, "left_out": self.left_out, "notes": self.notes}
        return {
            "finished": finished,
            "kind": self.config.kind,
            "shapes": self.names,
            "align": self.config.align,
            "placements": [placement.as_dict() for placement in self.problem.placements],
            "ends": [{"name": end.name, "time": end.time} for end in self.problem.ends],
            **({"motion": list(map(dict, self.problem.motion_figures))} if self.problem.motion is not None else {}),
            "similarity": dataclasses.asdict(self.problem.similarity),
            "config": dataclasses.asdict(self.config),
            "stages": self.stages,
            "parameters": sum(stage["parameters"] for stage in self.stages),
            "deltas": [stage["delta"] for stage in self.stages if stage["delta"] is not None],
            "training_seconds": round(seconds, 3),
            **({} if limit is None else {"budget": budget}),
            "environment": environment(self.device),
        }
