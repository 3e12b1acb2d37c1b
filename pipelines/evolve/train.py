"""``evolve``: from static shapes to one surface that moves, level by level, in space-time."""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...neural_fields import InputError, MultiscaleSDF, SpaceTimeSDF
from ..fit.level import LEVEL, new_level
from ..fit.samples import delta_of
from ..training.folder import VELOCITY_FILE, RunFolder, digest_of, load_motion
from ..training.progress import Report, counted, reported, silent
from ..training.result import Run
from ..training.scaffold import BUDGET, Budget, Training
from ..training.settings import EvolveConfig
from ..training.trainer import (
    Interrupted,
    StopFlag,
    Trainer,
    load_compiler,
    parameter_count,
    restore_frozen,
    stop_on_signals,
)
from .checks import check_evolution, frame_figures
from .objective import LONGEST_GRADIENT, EvolveObjective, learn_start
from .problem import Problem, build_problem
from .shapes import StaticShape, read_landmarks, read_shape

# Of a time budget, what the start and the checks may take.
STARTING_SHARE, CHECKING_SHARE = 0.2, 0.25
# Frames that are checked in any case; and how many frames the check of an end costs, by its finer mesh.
FEWEST_FRAMES, END_FRAMES = 3, 3


@dataclass(frozen=True)
class Evolution(Run[SpaceTimeSDF]):
    """A finished evolution; its coordinates are those of the first shape."""


def evolve(
    config: EvolveConfig, *, out: str | Path | None = None, resume: bool = False, progress: Report | None = None
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
        >>> from mplicits.pipelines.training.settings import EvolveConfig
        >>> run = evolve(EvolveConfig(shapes=("runs/spot", "runs/bob")), out="runs/morph")  # doctest: +SKIP
        >>> run.record["checks"]["warnings"]  # doctest: +SKIP
    """
    started, folder = time.monotonic(), RunFolder(out, resume=resume)
    config, report = folder.config(EvolveConfig, config), progress or silent
    budget = Budget(config.time_budget, started=started)
    count, shapes, tell = len(config.shapes), [], counted(report, "shapes")
    for path in config.landmarks:
        read_landmarks(path)  # before the shapes, which take their time
    for index, text in enumerate(config.shapes):
        tell(index, count)
        shapes.append(read_shape(text))
    tell(count, count)
    load_compiler()
    motion = load_motion(folder.path) if resume and folder.path else None
    # A resumed run has the number of samples that its budget allowed in its settings.
    limit = None if resume else budget
    with reported(report, "known samples"):
        problem = build_problem(shapes, config, motion=motion, progress=report, budget=limit)
    config = dataclasses.replace(config, samples=problem.samples or config.samples)
    return train_evolution(problem, config, shapes=shapes, out=out, resume=resume, progress=report, budget=budget)


def train_evolution(
    problem: Problem,
    config: EvolveConfig,
    *,
    shapes: list[StaticShape] | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Report | None = None,
    budget: Budget | None = None,
) -> Evolution:
    """`evolve` for a problem that was put together by hand; see there.

    The ``budget`` is that of the settings where it began earlier; by default it begins now.
    """
    names, folder = [shape.name for shape in shapes or []], RunFolder(out, resume=resume)
    budget = budget or Budget(config.time_budget)
    training = _Evolving(problem, names, config, folder, progress or silent, budget)
    with folder.writing(VELOCITY_FILE), stop_on_signals() as flag:
        if resume:
            training.restore()
        elif problem.motion is not None:
            folder.keep_tensors(VELOCITY_FILE, problem.motion.state_dict())
        return training.run(flag)


class _Evolving(Training[EvolveConfig, SpaceTimeSDF]):
    """One evolution under way."""

    def __init__(
        self,
        problem: Problem,
        names: list[str],
        config: EvolveConfig,
        folder: RunFolder,
        report: Report,
        budget: Budget,
    ) -> None:
        super().__init__(config, folder, budget, report)
        self.problem, self.names, self.similarity = problem, names, problem.similarity
        self.frame_seconds = 0.0  # to check a frame
        self.fingerprint = digest_of(part.numpy() for part in vars(problem.known).values())

    def run(self, flag: StopFlag) -> Evolution:
        for level in range(len(self.stages), self.config.num_levels):
            if level and self.level_share(level) is None:
                self.budget.leave_out(level, self.config.num_levels)
                break
            self.train_level(level, flag)
        assert self.frozen is not None
        field = self.frozen.cpu()
        frames = self.affordable_frames()
        record = self.record(finished=True)

        count = counted(self.report, "checks")
        count(0, 1)
        left = self.budget.left()
        record["checks"] = check_evolution(
            field,
            self.problem.ends,
            frames=frames,
            resolution=self.config.resolution,
            count=count,
            until=math.inf if left is None else time.monotonic() + left,
        )
        record = self.folder.finish(field, self.similarity, record)
        return Evolution(field, self.similarity, self.folder.out, record)

    def train_level(self, level: int, flag: StopFlag) -> None:
        """Begin one level, train it, freeze it."""
        config, started = self.config, time.monotonic()
        generator = torch.Generator().manual_seed(config.seed * 1009 + level)
        delta = None
        if level:  # half-width of the band around the last frozen level (Eq. 5)
            delta = max(delta_of(self.errors_at_ends(), epsilon=config.epsilon, quantile=None), config.least_delta)
        field = self.begun(level, delta, generator)
        beginning_seconds = time.monotonic() - started
        try:
            objective = EvolveObjective(field, self.problem, config, level=level, generator=generator)
        except ValueError as error:
            raise InputError(
                f"{error}; train the level before longer (--steps), or widen the band (--epsilon)"
            ) from error
        seconds, steps = self.seconds_for(level, field), config.steps[level]
        trainer = Trainer(objective, stage=f"level {level}", steps=steps, seconds=seconds, clip=LONGEST_GRADIENT)
        if not self.take_steps(trainer, flag, lambda: field):
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
            left = self.budget.left()
            seconds = None if left is None else max(STARTING_SHARE * left, BUDGET.least_seconds)
            known = self.problem.known.to(self.device)
            return learn_start(known, config, generator, self.report, seconds=seconds).to(self.device)
        assert self.frozen is not None
        assert delta is not None
        residual = new_level(config, level, residual=True, in_dim=4, gain=LEVEL.moving_gain)
        with torch.no_grad():
            residual.layers[0].weight[:, 3] *= config.time_gain  # pyright: ignore[reportIndexIssue]
        return self.frozen.with_level(residual.to(self.device), delta=delta).to(self.device)

    def empty(self, levels: int) -> SpaceTimeSDF:
        """Untrained levels, to be filled from a state."""
        sirens = [new_level(self.config, level, residual=False, in_dim=4) for level in range(levels)]
        return SpaceTimeSDF(MultiscaleSDF(sirens[0], sirens[1:], [1.0] * (levels - 1)))

    @torch.no_grad()
    def errors_at_ends(self) -> Tensor:
        """Values of the finest frozen level on the surfaces that shall be met → ``(n,)`` on the CPU."""
        assert self.frozen is not None
        rows = [torch.nn.functional.pad(end.points, (0, 1), value=end.time) for end in self.problem.ends]
        return torch.cat([self.frozen.value(part.to(self.device)).cpu() for part in torch.cat(rows).split(1 << 16)])

    def level_share(self, level: int) -> float | None:
        """Seconds for the training of a level, see `Training.share`."""
        if (left := self.budget.left()) is not None:
            left = max(left - min(self.checking_seconds(), CHECKING_SHARE * left), BUDGET.least_seconds)
        return self.share(level, self.config.steps[: self.config.num_levels], left)

    def timed_step(self, level: int) -> Callable[[], Tensor]:
        """See `Training.timed_step`."""
        field = self.empty(level + 1).to(self.device).requires_grad_(False)
        field.sdf.levels[level].requires_grad_(True)
        generator = torch.Generator().manual_seed(0)
        objective = EvolveObjective(field, self.problem, self.config, level=level, generator=generator)
        steps = itertools.count()
        return lambda: objective.losses(next(steps), 0.0)[1]

    def seconds_for(self, level: int, field: SpaceTimeSDF) -> float | None:
        """How long a level may train that begins as ``field``; None without a budget."""
        if self.budget.left() is None:
            return None
        begun, shown = time.monotonic(), copy.deepcopy(field).cpu()
        frame_figures(shown, 0.0, self.config.resolution)
        self.frame_seconds = time.monotonic() - begun
        return max(self.level_share(level) or 0.0, BUDGET.least_seconds) + self.elapsed

    def checking_seconds(self) -> float:
        """Seconds for all checks at the end, at what a frame took when the last level began."""
        return self.frame_seconds * (self.config.frames + END_FRAMES * len(self.problem.ends))

    def affordable_frames(self) -> int:
        """How many frames there is time to check."""
        left, frames = self.budget.left(), self.config.frames
        if left is None or left >= self.checking_seconds():
            return frames
        count = int(left / self.frame_seconds) - END_FRAMES * len(self.problem.ends)
        count = min(max(count, FEWEST_FRAMES), frames)
        if count < frames:
            self.budget.notes.append(f"{count} frames are checked instead of {frames}")
        return count

    def restore(self) -> None:
        """Take up an interrupted run."""
        names = ", ".join(self.names)
        tensors, _ = self.restored(f"{names}: not the shapes that {self.folder.path} was trained on; bring those back")
        if self.stages:
            self.frozen = restore_frozen(self.empty(len(self.stages)).to(self.device), tensors)

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""
        motion = self.problem.motion_figures if self.problem.motion is not None else None
        return {
            "kind": self.config.kind,
            "shapes": self.names,
            "align": self.config.align,
            "placements": [placement.as_dict() for placement in self.problem.placements],
            "ends": [{"name": end.name, "time": end.time} for end in self.problem.ends],
            **({} if motion is None else {"motion": list(map(dict, motion))}),
            **self.common_record(finished=finished),
            **self.stages_record(),
        }
