"""The clock of a fit: what its progress display is told of stages, and what a time budget leaves of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ...datasets import PointCloud
from ..run.costs import Speed, reading_seconds
from ..run.machine import speed
from ..run.schedule import Progress, Report, Schedule, Stage
from ..run.settings import FitConfig
from ..run.team import agreed
from .cloud import CloudDistance
from .level import new_level
from .plan import FEWEST_STEPS, FitPlan, Share
from .samples import DOMAIN

__all__ = ["SamplingWork", "Timing"]

# Of a cloud that is not read yet.
USUAL_POINTS = 100_000
# Where nobody asks how long it takes.
UNKNOWN_SPEED = Speed(1e11, 1e11, 1e-3)
# How many signed distances tell how fast samples are made, and for how many of those that counts.
PROBE, PROBED = 2048, 20
PROBE_STEPS = 4
TELL_EVERY = 0.25  # seconds
ALMOST = 0.99  # of samples of which more had to be tried than was thought


class Timing:
    """Stages, and shares of the budget, of one fit.

    Args:
        config: its settings.
        progress: told how far it is, or None.
        device: that trains.

    Attributes:
        schedule: to be told of all progress.
        started: when the fit began, by `time.monotonic`.
        notes: sentences on what the budget changed.
    """

    def __init__(self, config: FitConfig, progress: Report | None, device: torch.device) -> None:
        self.started = time.monotonic()
        self.config, self.device, self.schedule = config, device, Schedule.of(progress)
        unwatched = progress is None and config.time_budget is None
        self.plan = FitPlan(config, USUAL_POINTS, UNKNOWN_SPEED if unwatched else speed(device))
        self.before = 0.0  # seconds that earlier processes spent on what they kept
        self.left_out: list[int] = []
        self.notes: list[str] = []
        self._probed = False

    def begin(self, cloud: PointCloud | str | Path) -> None:
        """Say what is to come, and that the cloud is read now."""
        reading = Stage("reading the cloud", "reading", reading_seconds(_size(cloud)))
        self._tell([reading, self.plan.preparing(), *self._signs(), *self.plan.levels()], self.config.time_budget)
        self._at("reading the cloud", 0.0)

    def has_read(self, points: int) -> None:
        """The cloud has so many points, and is prepared now."""
        self._at("reading the cloud", 1.0)
        self.plan = FitPlan(self.config, points, self.plan.speed)
        self._tell([self.plan.preparing(), *self._signs(), *self.plan.levels()], self._left())
        self._at("preparing the cloud", 0.0)

    def has_prepared(self) -> None:
        """The cloud is prepared."""
        self._at("preparing the cloud", 1.0)

    def finds_signs(self) -> None:
        """Level 0 is asked for the signs of normals now, whether that was known before or the cloud has shown it."""
        stages = self.plan.signs()
        self._tell([*stages, *self.plan.levels()], self._left())
        self._at(stages[0].name, 0.0)

    def first_samples(self) -> int:
        """How many samples a level may have, before anything is measured; without a budget all."""
        left = self._left()
        return self.config.samples if left is None else self.plan.shares(0, max(left, 0.0))[0].samples

    def share(self, level: int, index: Callable[[], CloudDistance], *, begun: bool = False) -> Share | None:
        """What the budget leaves for a level; None where that is not worth training. Then the rest is left out.

        Args:
            level: the next.
            index: makes that of the cloud, on which a probe shows how fast samples are made.
            begun: whether the level was begun before the fit was interrupted: it comes to its end then.
        """
        left = self._left()
        if left is None:
            self._tell(self.plan.levels(level), None)
            return Share(math.inf, self.config.samples)
        if not self._probed:
            self._probe(index())
            self._probed = True
            left = self._left()
        assert left is not None
        shares = self.plan.shares(level, max(left, 0.0), self.schedule.slowness)
        if begun and not shares:
            shares = [Share(0.0, self.config.samples)]
        # A team agrees: all of it make as many samples, and take as many steps.
        count, seconds, samples = (
            agreed(False, value, self.device)[1]
            for value in (len(shares), *((shares[0].seconds, shares[0].samples) if shares else (0.0, 0)))
        )
        if not count:
            self._leave_out(level)
            return None
        share = Share(seconds, int(samples))
        self._tell([self.plan.sampling(level, share.samples), *self.plan.levels(level, level + int(count))[1:]], left)
        full = self.config.samples
        if share.samples < full:
            self.notes.append(f"level {level} learns from {share.samples:,} samples of each kind instead of {full:,}")
        if left < self.least_seconds(level):
            self.notes.append(f"the time was up before level {level}, which is trained briefly all the same")
        return share

    def least_seconds(self, level: int) -> float:
        """Training of level 0 below which there would be no surface."""
        return self.plan.least_seconds(level, self.schedule.slowness)

    def sampling(self, level: int, samples: int) -> SamplingWork:
        """A count of the work on the samples of a level, which begins now."""
        return SamplingWork(self.plan, level, samples, self.schedule)

    def record(self) -> dict[str, Any]:
        """For ``run.json``."""
        if self.config.time_budget is None:
            return {}
        return {"budget": {"seconds": self.config.time_budget, "left_out": self.left_out, "notes": self.notes}}

    def _leave_out(self, first: int) -> None:
        self.left_out = list(range(first, self.config.num_levels))
        names = f"level {first} is" if len(self.left_out) == 1 else f"levels {first} to {self.left_out[-1]} are"
        self.notes.append(f"{names} left out: too little time for samples and {FEWEST_STEPS} steps")

    def _signs(self) -> list[Stage]:
        """The stages of signs, where it is known that there will be some."""
        return self.plan.signs() if self.config.normals == "none" else []

    def _left(self) -> float | None:
        """Seconds left of the budget."""
        if self.config.time_budget is None:
            return None
        return self.config.time_budget - self.before - (time.monotonic() - self.started)

    def _probe(self, index: CloudDistance) -> None:
        """Measure how fast samples are made on this cloud, and steps are taken: how many levels there is time for."""
        points = (2 * torch.rand(PROBE, 3, generator=torch.Generator().manual_seed(0)) - 1) * DOMAIN
        work: list[float] = []
        index.watch = work.append
        started = time.monotonic()
        index.signed(points)
        self.schedule.learn(
            "samples", self.plan.speed.points(math.fsum(work)) * PROBED, PROBED * (time.monotonic() - started)
        )

        siren = new_level(self.config, 0, residual=False).to(self.device)
        batch = points.repeat(-(-self.config.batch // PROBE), 1)[: self.config.batch].to(self.device)
        started = time.monotonic()
        for _ in range(PROBE_STEPS):
            jet = siren.jet(batch)
            loss = jet.value.square().mean() + jet.gradient.square().mean()
            float(loss.detach())  # a GPU is waited for
            loss.backward()
        expected = PROBE_STEPS * self.plan.step_seconds(0)
        self.schedule.learn("steps", PROBED * expected, PROBED * (time.monotonic() - started))

    def _tell(self, stages: list[Stage], budget: float | None) -> None:
        self.schedule.plan(stages, budget=budget)

    def _at(self, stage: str, fraction: float) -> None:
        self.schedule(Progress(stage, 0, 0, fraction, {}))


class SamplingWork:
    """How much of the samples of a level is made.

    Args:
        plan: of the fit.
        level: whose samples.
        samples: how many of each kind.
        schedule: told of it.
    """

    def __init__(self, plan: FitPlan, level: int, samples: int, schedule: Schedule) -> None:
        self.plan, self.level, self.samples, self.schedule = plan, level, samples, schedule
        self.stage = plan.sampling(level, samples)
        self.seconds, self.told = 0.0, -math.inf
        self.points(0.0)

    def indexed(self) -> None:
        """The index is made, of the first level."""
        if self.level == 0:
            self._done(self.plan.index_seconds(self.samples))

    def points(self, work: float) -> None:
        """More work on points is done, in the units of :mod:`..run.costs`."""
        self._done(self.plan.speed.points(work))

    def looked(self, points: int) -> None:
        """The levels before were evaluated at so many points."""
        self._done(self.plan.looking_seconds(self.level, points))

    def end(self) -> None:
        """All is made."""
        self.schedule(Progress(self.stage.name, 0, 0, 1.0, {}))

    def _done(self, seconds: float) -> None:
        self.seconds += seconds
        now = time.monotonic()
        if now - self.told > TELL_EVERY:
            self.told = now
            self.schedule(Progress(self.stage.name, 0, 0, min(self.seconds / self.stage.seconds, ALMOST), {}))


def _size(cloud: PointCloud | str | Path) -> int:
    return Path(cloud).stat().st_size if isinstance(cloud, str | Path) and Path(cloud).is_file() else 0
