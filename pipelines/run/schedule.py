"""How far a work of several stages is, and how long it will still take: plain arithmetic on clock times.

Every stage comes with the seconds that it should take on this machine, by its work and the machine's measured speed
(:mod:`.costs`). What finished stages really took corrects the kinds of work that are still to come, and what is done
of the stage under way corrects that stage:

    T = (w P + e) / (w + f)

of a stage predicted to take P, of which a fraction f took e seconds; the prediction counts as w = 3 % of the stage.
The time left of the whole is the sum of what is left of its stages. Under a time budget it is no more than the budget.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

__all__ = ["Progress", "Report", "Schedule", "Stage"]

# The prediction of a stage counts as much as this share of it, measured.
PRIOR_SHARE = 0.03
# Predictions of a kind of work count as much as so many predicted seconds of it, measured.
PRIOR_SECONDS = 0.5
# A stage that is longer under way than it should be in all, and silent, is thought to need this share of that again.
OVERDUE = 0.1


@dataclass(frozen=True)
class Progress:
    """What a progress display is told.

    Attributes:
        stage: name of the stage.
        step: steps done.
        steps: steps planned.
        fraction: of the stage, in [0, 1]; not step / steps when a time budget may end it earlier.
        losses: unweighted loss terms of the last reported step.
        whole: fraction of the whole work, by time, in [0, 1]; None where nobody keeps a `Schedule`.
        left: seconds that the whole work will still take; None where that is not known.
        elapsed: seconds that it took so far; None where nobody keeps a `Schedule`.
    """

    stage: str
    step: int
    steps: int
    fraction: float
    losses: Mapping[str, float]
    whole: float | None = None
    left: float | None = None
    elapsed: float | None = None


Report = Callable[[Progress], None]


@dataclass(frozen=True)
class Stage:
    """A part of the work.

    Attributes:
        name: what `Progress.stage` calls it.
        kind: of work: stages of one kind are wrongly predicted by one factor, "steps" or "samples".
        seconds: that it should take on this machine.
    """

    name: str
    kind: str
    seconds: float


@dataclass
class _Under:
    """The stage under way: when it began, how much was done by then, and what was last said of it."""

    stage: Stage
    begun: float
    before: float  # fraction: a resumed stage begins further on
    worked_before: float
    fraction: float
    worked: float  # share of its work; less than the fraction where a time budget ends it earlier
    elapsed: float = 0.0  # when that was said


class Schedule:
    """A `Report` that knows what is still to come, and says so in what it hands on.

    Args:
        report: told every `Progress`, with `Progress.whole`, `Progress.left` and `Progress.elapsed`.
        clock: seconds, from any origin.

    Example:
        >>> now = [0.0]
        >>> schedule = Schedule(clock=lambda: now[0])
        >>> schedule.plan([Stage("a", "steps", 10), Stage("b", "steps", 30)])
        >>> schedule(Progress("a", 0, 100, 0.0, {}))
        >>> schedule.left()
        40.0
        >>> now[0] = 20.0  # twice as slow as was thought
        >>> schedule(Progress("a", 100, 100, 1.0, {}))
        >>> round(schedule.left())
        59
    """

    def __init__(self, report: Report | None = None, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.report, self.clock = report or (lambda _: None), clock
        self.begun = clock()
        self._ahead: list[Stage] = []
        self._after: list[Stage] = []
        self._under: _Under | None = None
        self._deadline: float | None = None
        self._known: dict[str, tuple[float, float]] = {}  # by kind: seconds predicted, and measured
        self._whole = 0.0

    @classmethod
    def of(cls, report: Report | None) -> Schedule:
        """``report`` itself, if it keeps a schedule; else a new one that hands on to it."""
        return report if isinstance(report, Schedule) else cls(report)

    def plan(self, stages: Iterable[Stage], *, budget: float | None = None) -> None:
        """Say what is still to come, instead of what was said before; what `follow` said stays.

        Args:
            stages: in order; the one under way may be the first.
            budget: seconds from now in which they will be done in any case.
        """
        self._ahead = list(stages)
        self._deadline = None if budget is None else self.clock() + budget
        if self._under is not None and self._ahead and self._ahead[0].name == self._under.stage.name:
            self._under.stage = self._ahead.pop(0)

    def follow(self, stages: Iterable[Stage]) -> None:
        """Say what will be done by others after all that is planned, now or later."""
        self._after = list(stages)

    def __call__(self, progress: Progress, /) -> None:
        """Take up a message, and hand it on with the time left."""
        now = self.clock()
        worked = progress.step / progress.steps if progress.steps else progress.fraction
        under = self._under
        if under is None or under.stage.name != progress.stage:
            if under is not None:
                under.elapsed, under.worked = now - under.begun, max(under.worked, under.fraction)
                self._finish(under)
            under = _Under(self._next(progress.stage), now, *(progress.fraction, worked) * 2)
            self._under = under
        under.fraction, under.worked, under.elapsed = progress.fraction, worked, now - under.begun
        left = self.left()
        if under.fraction >= 1:
            self._finish(under)
            left = self.left()
        self._whole = max(self._whole, self.fraction())
        self.report(replace(progress, whole=self._whole, left=left, elapsed=now - self.begun))

    def left(self) -> float | None:
        """Seconds that the whole will still take, as far as is known now; None if nothing is known."""
        now = self.clock()
        planned = 0.0 if self._under is None else self._rest(self._under, now)
        if planned is None or (self._under is None and not self._known and not self._ahead and not self._after):
            return None
        planned += math.fsum(self.predicted(stage) for stage in self._ahead)
        if self._deadline is not None:
            planned = min(planned, max(self._deadline - now, 0.0))
        return planned + math.fsum(self.predicted(stage) for stage in self._after)

    def fraction(self) -> float:
        """How much of the whole is done, by time, in [0, 1]."""
        left, elapsed = self.left(), self.clock() - self.begun
        return 0.0 if left is None else 1.0 if elapsed + left == 0 else elapsed / (elapsed + left)

    def predicted(self, stage: Stage) -> float:
        """Seconds that a stage to come will take, by what its kind of work took so far."""
        return stage.seconds * self.slowness(stage.kind)

    def slowness(self, kind: str) -> float:
        """Seconds that this kind of work takes for one predicted; of kinds not met yet by the others, cautiously.

        Of others it is the mean of their logarithms and of one that says that the predictions are right.
        """
        measured = dict(self._known)
        under = self._under
        if under is not None and under.worked > under.worked_before and under.stage.seconds:
            measured[under.stage.kind] = self._with(under)
        return _slowness(kind, measured)

    def learn(self, kind: str, expected: float, seconds: float) -> None:
        """A measurement from elsewhere: work of a kind that should take ``expected`` seconds took ``seconds``."""
        before = self._known.get(kind, (0.0, 0.0))
        self._known[kind] = (before[0] + expected, before[1] + seconds)

    def _next(self, name: str) -> Stage:
        """The planned stage of that name, taken out with all before it; else one that nothing is known of."""
        for stages in (self._ahead, self._after):
            names = [stage.name for stage in stages]
            if name in names:
                if stages is self._after:
                    self._ahead, self._deadline = [], None
                stage = stages[names.index(name)]
                del stages[: names.index(name) + 1]
                return stage
        return Stage(name, "", 0.0)

    def _with(self, under: _Under) -> tuple[float, float]:
        """What is known of the kind of the stage under way, that stage included."""
        expected, seconds = self._known.get(under.stage.kind, (0.0, 0.0))
        return expected + under.stage.seconds * (under.worked - under.worked_before), seconds + under.elapsed

    def _finish(self, under: _Under) -> None:
        if under.stage.seconds and under.worked > under.worked_before:
            self._known[under.stage.kind] = self._with(under)
        self._under = None

    def _rest(self, under: _Under, now: float) -> float | None:
        """Seconds left of the stage under way, which is predicted by what is finished and what is done of it."""
        elapsed, done = now - under.begun, under.fraction - under.before
        prior = under.stage.seconds * _slowness(under.stage.kind, self._known)
        if not done and not under.stage.kind:
            return None
        weight = PRIOR_SHARE if under.stage.kind else 0.0
        total = (weight * prior + under.elapsed) / (weight + done) if done else prior
        return max(total * (1 - under.before) - elapsed, OVERDUE * (1 - under.fraction) * elapsed)


def _slowness(kind: str, measured: Mapping[str, tuple[float, float]]) -> float:
    """See `Schedule.slowness`; of each kind the seconds predicted and measured are given."""
    logs = total = 0.0
    for expected, seconds in measured.values():
        weight = expected / (expected + PRIOR_SECONDS)
        logs += weight * math.log((PRIOR_SECONDS + seconds) / (PRIOR_SECONDS + expected))
        total += weight
    expected, seconds = measured.get(kind, (0.0, 0.0))
    return (PRIOR_SECONDS * math.exp(logs / (1 + total)) + seconds) / (PRIOR_SECONDS + expected)
