"""Training of a scene under observation: seconds of every step, and FLOPs of its networks.

Rows are counted while they are evaluated: points with a value alone (to place the samples), points whose jet is
trained, and colours. The cost of one row comes from torch's counter of FLOPs on the same module, in matrix products
alone (a product of (a, b) and (b, c) is 2 abc FLOPs; sines and the like are not counted):

- A value is one pass, about 2 FLOPs per weight.
- A jet that is trained is one pass forward and one sweep back. Each of these two has a product for the cotangent of the
  weights and one for that of the activations. That makes six passes, about 12 FLOPs per weight.
- A colour that is trained is forward and its two cotangents: three passes, about 6 FLOPs per weight.

"About", because the points themselves are not trained, and because outputs that are features are not swept back.
"""

from __future__ import annotations

import copy
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from mplicits.neural_fields import Field, Jet
from mplicits.neural_fields.networks.colors import BackgroundField, ColorNetwork
from mplicits.neural_fields.networks.multiscale import levels_of
from mplicits.pipelines.reconstruct.consistency import GreyPictures
from mplicits.pipelines.reconstruct.model import RayPool, SceneModel
from mplicits.pipelines.reconstruct.objective import GraphTrainer, SceneObjective, scene_trainer
from mplicits.pipelines.training.cuda_graphs import Recorder, Results, Work
from mplicits.pipelines.training.settings import ReconstructConfig
from mplicits.pipelines.training.trainer import Progress, StopFlag, Trainer
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from ..costs.speed import Counted, counted
from .reconstruct_rows import StepParts

PROBE = 64  # rows on which the FLOPs of one are counted
ENDLESS = 10**9  # steps that no training comes to the end of
REPORT_EVERY = 20  # steps; a GPU is looked at no more often
HALF = 0.5  # of the training, after which rows count as late


@dataclass(frozen=True)
class LateRows:
    """Rows of the second half of a training, when the surface is known and rays cost what they will go on to cost.

    Attributes:
        steps: in which they were evaluated.
        values: of each level, without gradient.
        jets: of each level, with gradient.
        colors: of the colour network.
    """

    steps: int
    values: tuple[int, ...]
    jets: tuple[int, ...]
    colors: int


@dataclass(frozen=True)
class Watched:
    """A training that has ended.

    Attributes:
        trainer: with its model.
        finished: False if it was stopped.
        step_seconds: median of the steps.
        values: rows of each level without gradient.
        jets: rows of each level with gradient.
        colors: rows of the colour network.
        late: the rows of the second half of the training; None where it has fewer than two steps.
        parts: the seconds of its steps; None on a GPU too, which works while Python goes on.
        finest_share: rows of the finest level over those of the coarsest, in the steps in which it was switched on.
        geometry_flops: of the whole training.
        color_flops: the same of colours and of what is outside.
    """

    trainer: Trainer[SceneObjective]
    finished: bool
    step_seconds: float
    values: tuple[int, ...]
    jets: tuple[int, ...]
    colors: int
    late: LateRows | None
    parts: StepParts | None
    finest_share: float | None
    geometry_flops: float
    color_flops: float


def train_watched(
    model: SceneModel,
    pool: RayPool,
    config: ReconstructConfig,
    flag: StopFlag,
    *,
    pictures: GreyPictures | None = None,
    seconds: float | None = None,
    report: Callable[[Progress], None] | None = None,
) -> Watched:
    """Train to the end of the schedule, or until ``flag`` asks to stop.

    On a GPU steps are replayed in fixed shapes, and the rows that are counted include unused capacity.

    Args:
        model: on the pool's device.
        pool: the pixels.
        config: settings.
        flag: see `stop_on_signals`.
        pictures: for the term of consistency.
        seconds: end the schedule after so long, and not after ``config.steps``.
        report: called now and then.
    """
    plain = model.geometry
    costs = [(value_flops(level), jet_flops(level)) for level in levels_of(plain)]
    color_cost, outside_cost = color_flops(model.color), 0.0 if model.outside is None else outside_flops(model.outside)
    model.geometry, levels = counted(plain)
    colors, outsides = _RowCounter(model.color), _RowCounter(model.outside)
    config = replace(config, steps=config.steps if seconds is None else ENDLESS)
    trainer = scene_trainer(model, pool, config, pictures=pictures, seconds=seconds)
    if isinstance(trainer, GraphTrainer):
        trainer.graphs.recorder = Tallied(trainer.graphs.recorder, [*levels, colors, outsides])
    clocks, every = None, REPORT_EVERY
    if pool.device.type == "cpu":
        every = 1
        clocks = (_Clock(trainer.objective, "losses"), _Clock(model.geometry, "jet"), _Clock(model.color, "forward"))
    watch = _Watch(trainer, levels, colors, report, clocks)
    try:
        finished = trainer.run(flag, report=watch, report_every=every)
    finally:
        colors.remove()
        outsides.remove()
        for clock in clocks or ():
            clock.remove()
        plain.deltas.copy_(model.geometry.deltas)
        model.geometry = plain
    geometry = sum(v * level.values + j * level.jets for (v, j), level in zip(costs, levels, strict=True))
    return Watched(
        trainer=trainer,
        finished=finished,
        step_seconds=statistics.median(watch.times) if watch.times else 0.0,
        values=tuple(level.values for level in levels),
        jets=tuple(level.jets for level in levels),
        colors=colors.rows,
        late=watch.late(),
        parts=watch.parts(),
        finest_share=levels[-1].jets / watch.samples if watch.samples else None,
        geometry_flops=geometry,
        color_flops=color_cost * colors.rows + outside_cost * outsides.rows,
    )


class _Watch:
    """What the trainer reports to after every step: takes the time, and counts the samples that are rendered."""

    def __init__(
        self,
        trainer: Trainer[SceneObjective],
        levels: Sequence[Counted],
        colors: _RowCounter,
        report: Callable[[Progress], None] | None,
        clocks: tuple[_Clock, _Clock, _Clock] | None,
    ) -> None:
        self.trainer, self.levels, self.colors, self.report, self.clocks = trainer, levels, colors, report, clocks
        self.half: LateRows | None = None  # the rows requested in the first half
        self.half_times: tuple[float, ...] = ()
        self.times: list[float] = []  # of a step, from one report to the next
        self.spent = 0.0
        self.samples = self.before = self.step = 0
        self.level, self.started = trainer.objective.level_at(trainer.fraction), time.perf_counter()

    def __call__(self, progress: Progress) -> None:
        steps, spent = self.trainer.step - self.step, time.perf_counter() - self.started
        self.spent += spent
        if steps:
            self.times.append(spent / steps)
        if self.level == len(self.levels) - 1:  # the level of the step that has just been made
            self.samples += self.levels[0].jets - self.before
        if self.half is None and progress.fraction >= HALF:
            self.half, self.half_times = self._rows(), self._seconds()
        if self.report is not None and (progress.step % REPORT_EVERY == 0 or progress.fraction >= 1):
            self.report(progress)
        self.before, self.level = self.levels[0].jets, self.trainer.objective.level_at(progress.fraction)
        self.step, self.started = self.trainer.step, time.perf_counter()

    def _rows(self) -> LateRows:
        """Those of all steps so far."""
        values, jets = (tuple(getattr(level, kind) for level in self.levels) for kind in ("values", "jets"))
        return LateRows(self.trainer.step, values, jets, self.colors.rows)

    def _seconds(self) -> tuple[float, ...]:
        """Of all steps so far: whole, forward, jets, colours."""
        return (self.spent, *(clock.seconds for clock in self.clocks or ()))

    def parts(self) -> StepParts | None:
        """See `Watched`."""
        half = self.half
        if half is None or self.clocks is None or self.trainer.step == half.steps:
            return None
        now, steps = self._seconds(), self.trainer.step - half.steps
        whole, forward, jets, colors = ((b - a) / steps for a, b in zip(self.half_times, now, strict=True))
        return StepParts(march=forward - jets - colors, jets=jets, colors=colors, backward=whole - forward)

    def late(self) -> LateRows | None:
        """See `Watched`."""
        now, half = self._rows(), self.half
        if half is None or now.steps == half.steps:
            return None
        values, jets = (
            tuple(b - a for a, b in zip(before, after, strict=True))
            for before, after in ((half.values, now.values), (half.jets, now.jets))
        )
        return LateRows(now.steps - half.steps, values, jets, now.colors - half.colors)


class Tallied(Recorder):
    """A recorder whose replays are counted: as many rows each time as at the recording.

    Args:
        recorder: records and replays.
        counters: objects whose attributes ``values``, ``jets`` and ``rows``, those that they have, count.
    """

    def __init__(self, recorder: Recorder, counters: Sequence[object]) -> None:
        self.recorder = recorder
        self._counts = [(c, name) for c in counters for name in ("values", "jets", "rows") if hasattr(c, name)]

    def record(self, work: Work) -> tuple[Callable[[], None], Results]:
        """See `Recorder.record`; recording itself counts nothing."""
        before = self._read()
        try:
            replay, results = self.recorder.record(work)
            rows = [now - then for now, then in zip(self._read(), before, strict=True)]
        finally:
            self._write(before)

        def counted_replay() -> None:
            replay()
            self._write([now + more for now, more in zip(self._read(), rows, strict=True)])

        return counted_replay, results

    def _read(self) -> list[int]:
        return [getattr(counter, name) for counter, name in self._counts]

    def _write(self, counts: Sequence[int]) -> None:
        for (counter, name), count in zip(self._counts, counts, strict=True):
            setattr(counter, name, count)


class _RowCounter:
    """Counts the rows that a network is called with."""

    def __init__(self, module: nn.Module | None) -> None:
        self.rows = 0
        self.hook = None if module is None else module.register_forward_pre_hook(self._count)

    def _count(self, _module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        self.rows += inputs[0].shape[:-1].numel()

    def remove(self) -> None:
        """Stop counting."""
        if self.hook is not None:
            self.hook.remove()


class _Clock:
    """Adds up the seconds that calls of one method of an object take."""

    def __init__(self, owner: Any, method: str) -> None:
        self.owner, self.method, self.seconds = owner, method, 0.0
        evaluate = getattr(owner, method)

        def timed(*args: Any, **options: Any) -> Any:
            begun = time.perf_counter()
            try:
                return evaluate(*args, **options)
            finally:
                self.seconds += time.perf_counter() - begun

        vars(owner)[method] = timed  # before the method of its class

    def remove(self) -> None:
        """Restore the method of the class."""
        del vars(self.owner)[self.method]


def value_flops(level: Field) -> float:
    """FLOPs of the matrix products of one value without a graph."""
    x = _points(level, level.in_dim)
    with torch.no_grad():
        return _flops(lambda: level.value(x))


def jet_flops(level: Field) -> float:
    """FLOPs of the matrix products of one jet that is trained, its way back included."""
    level, x = copy.deepcopy(level), _points(level, level.in_dim)
    return _flops(lambda: _go_back(level.jet(x)))


def color_flops(color: ColorNetwork) -> float:
    """The same of one colour, whose cotangent goes on to the geometry."""
    color, x = copy.deepcopy(color), _points(color, 3)
    jet = Jet(x[:, 0], x.clone().requires_grad_(), _points(color, color.num_features).requires_grad_())
    return _flops(lambda: _go_back((color(x, x, jet),)))


def outside_flops(outside: BackgroundField) -> float:
    """The same of density and colour of one point outside."""
    outside, x = copy.deepcopy(outside), _points(outside, 4)
    return _flops(lambda: _go_back(outside(x, x[:, :3])))


def _points(module: nn.Module, width: int) -> Tensor:
    return torch.full((PROBE, width), 0.5, device=next(module.parameters()).device)


def _go_back(outputs: Sequence[Tensor]) -> None:
    """From the sum of all outputs to the parameters, whose gradients are filled: these are a copy's."""
    torch.stack([part.sum() for part in outputs]).sum().backward()


def _flops(work: Callable[[], object]) -> float:
    """Per row of the probe."""
    with product_counter() as counter:
        work()
    return counter.get_total_flops() / PROBE


def product_counter() -> FlopCounterMode:
    """A context that counts the FLOPs of all matrix products, those in place and those with vectors included."""
    products = (torch.ops.aten.addmm_, torch.ops.aten.addmv, torch.ops.aten.addmv_)
    return FlopCounterMode(display=False, custom_mapping=dict.fromkeys(products, _product_flops))


def _product_flops(_sum: Sequence[int], a: Sequence[int], b: Sequence[int], **_options: object) -> int:
    """Of S + A B, from the shapes; B may be a vector."""
    return 2 * math.prod(a) * math.prod(b[1:])
