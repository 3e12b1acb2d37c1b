"""The clock of ``--time-budget``: how long each level may train, by the measured time of a few of its steps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class BudgetOptions:
    """Numbers by which a time budget is shared out."""

    # A level is not worth fewer steps, or fewer than a quarter of its own: its learning rate would hardly be warm.
    fewest_steps: int = 60
    # Samples of each kind that there are at least, and what they may take of the time where that is too short for
    # all.
    fewest_samples: int = 5_000
    sampling_share: float = 1 / 3
    # Seconds of training where a budget leaves none.
    least_seconds: float = 0.5
    # Timed steps, of which the fastest counts; and the share of the time left that they may take.
    timed: int = 4
    timing_share: float = 0.02


BUDGET = BudgetOptions()


class Budget:
    """A time budget, and what it has changed.

    Args:
        seconds: for the whole work; None for no limit.
        started: beginning of the work, by `time.monotonic`; None is now.
        options: numbers of the algorithm.

    Attributes:
        before: seconds that interrupted processes spent on what they kept.
        left_out: levels that are not trained.
        notes: sentences on what has changed.
    """

    def __init__(self, seconds: float | None, *, started: float | None = None, options: BudgetOptions = BUDGET) -> None:
        self.options = options
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
        quarter of their steps.

        Args:
            seconds: for all levels from ``level`` on.
            level: the next one.
            steps: of each level.
            cost: measured seconds of a step of a level.
            training: share of a level's time that is spent on steps.
            begun: whether the level is under way, and is finished in any case. Level 0 always is.

        Returns:
            Seconds; None where the level is not worth beginning.
        """
        levels, work = list[int](), list[float]()
        for each in range(level, len(steps)):
            work.append(steps[each] * cost(each))
            if work[-1] * least_share(steps[each], options=self.options) > training * seconds:
                work.pop()
                break
            levels.append(each)
        while levels and training * seconds < math.fsum(work) * max(
            least_share(steps[each], options=self.options) for each in levels
        ):
            del levels[-1], work[-1]
        if levels:
            return seconds * work[0] / math.fsum(work)
        return seconds if begun or level == 0 else None

    def leave_out(self, first: int, levels: int) -> None:
        """Record that the levels from ``first`` up to ``levels`` are not trained."""
        self.left_out = list(range(first, levels))
        names = f"level {first} is" if len(self.left_out) == 1 else f"levels {first} to {levels - 1} are"
        self.notes.append(f"{names} left out: too little time for {self.options.fewest_steps} steps")

    def record(self) -> dict[str, Any]:
        """For ``run.json``."""
        if self.seconds is None:
            return {}
        return {"budget": {"seconds": self.seconds, "left_out": self.left_out, "notes": self.notes}}


def least_share(steps: int, options: BudgetOptions = BUDGET) -> float:
    """The smallest share of a level's steps that is worth beginning, see `fewest_steps`."""
    return min(options.fewest_steps / steps, 0.25) if steps else 0.0


def step_seconds(step: Callable[[], torch.Tensor], left: float, options: BudgetOptions = BUDGET) -> float:
    """Measured seconds of a training step: the fastest of a few.

    Args:
        step: computes a loss.
        left: seconds of the budget; a small share of them is spent on this.
        options: numbers of the algorithm.
    """
    least, begun = math.inf, time.monotonic()
    for _ in range(options.timed):
        started = time.monotonic()
        loss = step()
        loss.backward()
        float(loss.detach())  # waits for a GPU
        now = time.monotonic()
        least = min(least, now - started)
        if now - begun > options.timing_share * left:
            break
    return least


def affordable(
    make: Callable[[int], object],
    count: int,
    seconds: float,
    *,
    fewest: int = BUDGET.fewest_samples,
    options: BudgetOptions = BUDGET,
) -> int:
    """How many samples can be made in so many seconds: from ``fewest`` to ``count``.

    A half and twice the ``fewest`` are made and timed; samples beyond those cost the difference.

    Args:
        make: makes so many samples, which are dropped.
        count: that are wanted.
        seconds: for them.
        fewest: that are made in any case.
        options: numbers of the algorithm.
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
