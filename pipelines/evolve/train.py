"""``evolve``: from static shapes to one surface that moves, level by level, in space-time."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...neural_fields import InputError, MultiscaleSDF, Similarity, SpaceTimeSDF
from ..fit.level import new_level
from ..fit.samples import delta_of
from ..run.folder import RunFolder, digest_of
from ..run.machine import choose_device, environment
from ..run.settings import EvolveConfig
from ..run.trainer import (
    Interrupted,
    Progress,
    Report,
    StopFlag,
    Trainer,
    checkpoint_of,
    parameter_count,
    restore_frozen,
    stop_on_signals,
    without_prefix,
)
from .checks import check_evolution
from .objective import LONGEST_GRADIENT, EvolveObjective, learn_start
from .problem import Problem, build_problem
from .shapes import StaticShape, read_shape

__all__ = ["Evolution", "evolve", "train_evolution"]


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
    folder = RunFolder(out, resume=resume)
    config = folder.config(EvolveConfig, config)
    choose_device(config.device)
    report, count, shapes = progress or (lambda _: None), len(config.shapes) + 1, []
    for index, text in enumerate(config.shapes):
        report(Progress("shapes", index, count, index / count, {}))
        shapes.append(read_shape(text))
    report(Progress("shapes", count - 1, count, 1 - 1 / count, {}))
    problem = build_problem(shapes, config)
    return train_evolution(problem, config, shapes=shapes, out=out, resume=resume, progress=progress)


def train_evolution(
    problem: Problem,
    config: EvolveConfig,
    *,
    shapes: list[StaticShape] | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Report | None = None,
) -> Evolution:
    """`evolve` for a problem that was put together by hand; see there."""
    names, folder = [shape.name for shape in shapes or []], RunFolder(out, resume=resume)
    training = _Evolving(problem, names, config, choose_device(config.device), folder, progress or (lambda _: None))
    with folder.writing(), stop_on_signals() as flag:
        if resume:
            training.restore()
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
        progress: Report,
    ) -> None:
        self.problem, self.names, self.config, self.device = problem, names, config, device
        self.folder, self.progress = folder, progress
        self.fingerprint = digest_of(part.numpy() for part in vars(problem.known).values())
        self.frozen: SpaceTimeSDF | None = None
        self.stages: list[dict[str, Any]] = []
        self.trainer_state: dict[str, Tensor] = {}

    def run(self, flag: StopFlag) -> Evolution:
        self.folder.begin(self.record(finished=False))
        for level in range(len(self.stages), self.config.num_levels):
            self.train_level(level, flag)
        assert self.frozen is not None
        field = self.frozen.cpu()
        record = self.record(finished=True)

        def count(done: int, total: int) -> None:
            self.progress(Progress("checks", done, total, done / total, {}))

        record["checks"] = check_evolution(
            field, self.problem.ends, frames=self.config.frames, resolution=self.config.resolution, count=count
        )
        self.folder.finish(field, self.problem.similarity, record)
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
        seconds, steps = self.seconds_for(level, beginning_seconds), config.steps[level]
        trainer = Trainer(objective, stage=f"level {level}", steps=steps, seconds=seconds, clip=LONGEST_GRADIENT)
        if self.trainer_state:
            trainer.restore(self.trainer_state)
            self.trainer_state = {}
        if not trainer.run(flag, report=self.progress, save=lambda: self.save(field, trainer)):
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
            return learn_start(self.problem.known.to(self.device), config, generator, self.progress).to(self.device)
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

    def seconds_for(self, level: int, beginning: float) -> float | None:
        """How long this level may train within the time budget: by the work that its steps are."""
        config = self.config
        if config.time_budget is None:
            return None
        spent = sum(stage["beginning_seconds"] + stage["training_seconds"] for stage in self.stages)
        work = [
            steps * width**2 * depth
            for steps, width, depth in zip(config.steps, config.widths, config.depths, strict=True)
        ]
        return max(config.time_budget - spent - beginning, 1e-3) * work[level] / math.fsum(work[level:])

    def save(self, field: SpaceTimeSDF, trainer: Trainer[EvolveObjective] | None) -> None:
        """Write a usable field and all that `restore` needs."""
        tensors = checkpoint_of(self.frozen, trainer)
        progress = {"fingerprint": self.fingerprint, "stages": self.stages}
        self.folder.save(field, self.problem.similarity, self.record(finished=False), tensors, progress)

    def restore(self) -> None:
        """Take up an interrupted run; see `RunFolder.restore`."""
        names = ", ".join(self.names)
        mismatch = f"{names}: not the shapes that {self.folder.path} was trained on; bring those back"
        tensors, progress = self.folder.restore(self.fingerprint, mismatch)
        self.stages = progress["stages"]
        if self.stages:
            self.frozen = restore_frozen(self.empty(len(self.stages)).to(self.device), tensors)
        self.trainer_state = without_prefix("trainer.", tensors)

    def record(self, *, finished: bool) -> dict[str, Any]:
        """What ``run.json`` holds."""
        seconds = sum(stage["beginning_seconds"] + stage["training_seconds"] for stage in self.stages)
        return {
            "finished": finished,
            "kind": self.config.kind,
            "shapes": self.names,
            "align": self.config.align,
            "placements": [placement.as_dict() for placement in self.problem.placements],
            "ends": [{"name": end.name, "time": end.time} for end in self.problem.ends],
            "similarity": dataclasses.asdict(self.problem.similarity),
            "config": dataclasses.asdict(self.config),
            "stages": self.stages,
            "parameters": sum(stage["parameters"] for stage in self.stages),
            "deltas": [stage["delta"] for stage in self.stages if stage["delta"] is not None],
            "training_seconds": round(seconds, 3),
            "environment": environment(self.device),
        }
