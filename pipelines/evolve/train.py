"""``evolve``: from static shapes to one surface that moves, level by level, in space-time."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...neural_fields import InputError, MultiscaleSDF, Similarity, Siren, SpaceTimeSDF, save_field
from ..fit.samples import delta_of
from ..fit.train import RESIDUAL_GAIN
from ..run.config import load_config
from ..run.folder import (
    FIELD_FILE,
    STATE_FILE,
    digest_of,
    forget_run,
    load_state,
    read_record,
    save_state,
    write_record,
)
from ..run.machine import choose_device, environment
from ..run.settings import EvolveConfig
from ..run.trainer import Interrupted, Progress, StopFlag, stop_on_signals
from .checks import check_evolution
from .problem import Problem, build_problem
from .shapes import Shape, read_shape
from .trainer import EvolveTrainer, learn_start

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
    progress: Callable[[Progress], None] | None = None,
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
    directory = None if out is None else Path(out)
    if resume:
        if directory is None:
            raise InputError("resume: needs the run directory (out=...)")
        config = load_config(EvolveConfig, None, read_record(directory)["config"], thing="evolve")
    choose_device(config.device)
    report, count = progress or (lambda _: None), len(config.shapes) + 1
    shapes = []
    for index, text in enumerate(config.shapes):
        report(Progress("shapes", index, count, index / count, {}))
        shapes.append(read_shape(text))
    report(Progress("shapes", count - 1, count, 1 - 1 / count, {}))
    problem = build_problem(shapes, config)
    return train_evolution(problem, config, shapes=shapes, out=directory, resume=resume, progress=progress)


def train_evolution(
    problem: Problem,
    config: EvolveConfig,
    *,
    shapes: list[Shape] | None = None,
    out: Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Evolution:
    """`evolve` for a problem that was put together by hand; see there."""
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    names = [shape.name for shape in shapes or []]
    training = _Evolving(problem, names, config, choose_device(config.device), out, progress or (lambda _: None))
    if resume:
        training.restore()
    elif out is not None:
        forget_run(out)
    with stop_on_signals() as flag:
        return training.run(flag)


class _Evolving:
    """One evolution under way: the frozen levels, and the records of their stages."""

    def __init__(
        self,
        problem: Problem,
        names: list[str],
        config: EvolveConfig,
        device: torch.device,
        directory: Path | None,
        progress: Callable[[Progress], None],
    ) -> None:
        self.problem, self.names, self.config, self.device = problem, names, config, device
        self.directory, self.progress = directory, progress
        self.fingerprint = digest_of(part.numpy() for part in vars(problem.known).values())
        self.frozen: SpaceTimeSDF | None = None
        self.stages: list[dict[str, Any]] = []
        self.trainer_state: dict[str, Tensor] = {}

    def run(self, flag: StopFlag) -> Evolution:
        if self.directory is not None:
            write_record(self.directory, self.record(finished=False))
        for level in range(len(self.stages), self.config.num_levels):
            self.train_level(level, flag)
        assert self.frozen is not None
        field = self.frozen.cpu()
        record = self.record(finished=True)

        def tell(done: int, total: int) -> None:
            self.progress(Progress("checks", done, total, done / total, {}))

        record["checks"] = check_evolution(
            field, self.problem.ends, frames=self.config.frames, resolution=self.config.resolution, progress=tell
        )
        if self.directory is not None:
            self.write_field(field, record)
            write_record(self.directory, record)
            (self.directory / STATE_FILE).unlink(missing_ok=True)
        return Evolution(field, self.problem.similarity, self.directory, record)

    def train_level(self, level: int, flag: StopFlag) -> None:
        """Begin one level, train it, freeze it."""
        config, started = self.config, time.monotonic()
        generator = torch.Generator().manual_seed(config.seed * 1009 + level)
        delta = self.next_delta() if level else None
        field = self.begun(level, delta, generator)
        beginning_seconds = time.monotonic() - started
        try:
            trainer = EvolveTrainer(
                field,
                self.problem,
                config,
                level=level,
                generator=generator,
                seconds=self.seconds_for(level, beginning_seconds),
            )
        except ValueError as error:
            raise InputError(
                f"{error}; train the level before longer (--steps), or widen the band (--epsilon)"
            ) from error
        if self.trainer_state:
            trainer.restore(self.trainer_state)
            self.trainer_state = {}

        def report(trainer: EvolveTrainer) -> None:
            self.progress(Progress(f"level {level}", trainer.step, trainer.steps, trainer.fraction, trainer.losses))

        finished = trainer.run(flag, report=report, save=self.save)
        if not finished:
            self.save(trainer)
            raise Interrupted(self.directory)
        self.frozen = field.requires_grad_(False)
        errors = self.errors_at_ends()
        self.stages.append(
            {
                "level": level,
                "parameters": sum(p.numel() for p in field.sdf.levels[level].parameters()),
                "delta": delta,
                "known": len(trainer.known),
                "beginning_seconds": round(beginning_seconds, 3),
                "training_seconds": round(trainer.elapsed, 3),
                "steps": trainer.step,
                "ended_by_time_budget": trainer.ended_early,
                "losses": trainer.losses,
                "rms_at_ends": float(errors.square().mean().sqrt()),
                "max_at_ends": float(errors.abs().max()),
            }
        )
        self.save(None)

    def begun(self, level: int, delta: float | None, generator: torch.Generator) -> SpaceTimeSDF:
        """The field with one more level, which is all that is to be trained; of a resumed run with random weights."""
        config = self.config
        if level == 0:
            if self.trainer_state:
                return self.empty(1).to(self.device)
            return learn_start(self.problem.known.to(self.device), config, generator, self.progress).to(self.device)
        assert self.frozen is not None
        assert delta is not None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed * 1009 + level)
            residual = self.siren(level)
        with torch.no_grad():
            residual.layers[0].weight[:, 3] *= config.time_gain  # pyright: ignore[reportIndexIssue]
        return self.frozen.with_level(residual.to(self.device), delta=delta).to(self.device)

    def siren(self, level: int) -> Siren:
        """An untrained level."""
        config, gain = self.config, RESIDUAL_GAIN if level else 1.0
        return Siren(config.widths[level], config.depths[level], omega=config.omegas[level], in_dim=4, output_gain=gain)

    def empty(self, levels: int) -> SpaceTimeSDF:
        """Untrained levels, to be filled from a state."""
        sirens = [self.siren(level) for level in range(levels)]
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

    def save(self, trainer: EvolveTrainer | None) -> None:
        """Write a usable field and all that `restore` needs."""
        if self.directory is None:
            return
        field = self.frozen if trainer is None else trainer.field
        assert field is not None
        record = self.record(finished=False)
        self.write_field(field, record)
        tensors = {} if trainer is None else {f"trainer.{k}": v for k, v in trainer.state().items()}
        if self.frozen is not None:
            tensors |= {f"frozen.{name}": tensor for name, tensor in self.frozen.state_dict().items()}
        save_state(self.directory, tensors, {"fingerprint": self.fingerprint, "stages": self.stages})
        write_record(self.directory, record)

    def write_field(self, field: SpaceTimeSDF, record: dict[str, Any]) -> None:
        assert self.directory is not None
        kept = {name: value for name, value in record.items() if name != "checks"}
        save_field(self.directory / FIELD_FILE, field, similarity=self.problem.similarity, metadata={"run": kept})

    def restore(self) -> None:
        """Take up an interrupted run.

        Raises:
            InputError: nothing to resume, a damaged file, or other shapes than the run began with.
        """
        assert self.directory is not None
        tensors, progress = load_state(self.directory)
        if progress.get("fingerprint") != self.fingerprint:
            raise InputError(
                f"{', '.join(self.names)}: not the shapes that {self.directory} was trained on; "
                "bring those back, or leave out --resume and choose a new -o"
            )
        self.stages = progress["stages"]
        if self.stages:
            self.frozen = self.empty(len(self.stages)).to(self.device)
            self.frozen.load_state_dict(_with_prefix(tensors, "frozen."))
            self.frozen.requires_grad_(False)
        self.trainer_state = _with_prefix(tensors, "trainer.")

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


def _with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
