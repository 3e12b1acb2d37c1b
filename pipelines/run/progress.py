"""What is seen of a work under way: one bar for the whole with the time left, and its stages below; or lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.progress import BarColumn, ProgressColumn, Task, TaskID, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bars
from rich.text import Text

from .schedule import Progress, Schedule

__all__ = ["Lines", "counter_bar", "progress_bars", "time_words"]

# Seconds between two lines about a stage, where there is no terminal.
SILENCE = 30.0


@contextmanager
def progress_bars(*, whole: bool = True, clock: Callable[[], float] = time.monotonic) -> Iterator[Schedule]:
    """Show bars on stderr; where that is no terminal, a line for each finished stage, and now and then one between.

    Args:
        whole: whether there is a bar for the whole; without a plan it would be that of the stage under way.
        clock: seconds, from any origin.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Schedule(Lines(whole=whole, clock=clock), clock=clock)
        return
    with _StagesAndLosses(*_columns(), console=console, get_time=clock) as bars:
        shown = _Bars(bars, whole=whole)
        yield Schedule(shown, clock=clock)
        shown.end()


def time_words(seconds: float) -> str:
    """A time to wait, as exactly as it is worth: ``8 s``, ``2 min 10 s``, ``1 h 05 min``.

    Example:
        >>> [time_words(seconds) for seconds in (8.4, 131, 599, 3900)]
        ['8 s', '2 min 10 s', '10 min', '1 h 05 min']
    """
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if seconds < 595:
        minutes, rest = divmod(10 * round(seconds / 10), 60)
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02} min"


class Lines:
    """A line on stderr for each finished stage, and one in between when there was none for half a minute.

    Args:
        whole: whether the time left of the whole is said.
        counting: whether stages count something, and are not worth a line when they are done.
        clock: seconds, from any origin.
    """

    def __init__(
        self, *, whole: bool = True, counting: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.whole, self.counting, self.clock = whole, counting, clock
        self.told, self.finished = clock(), ""

    def __call__(self, progress: Progress, /) -> None:
        """Print what is worth a line."""
        ended, now = progress.fraction >= 1, self.clock()
        if ended and (self.counting or progress.stage == self.finished):
            return
        if not ended and now - self.told < SILENCE:
            return
        steps = f"{progress.step:,} steps" if progress.losses else "done"
        facts = [steps, _losses(progress)] if ended else [f"{progress.fraction:.0%}"]
        if self.whole and progress.left:
            facts.append(f"about {time_words(progress.left)} left" + " of the whole" * (not self.counting))
        print(f"{progress.stage}: {'; '.join(fact for fact in facts if fact)}", file=sys.stderr, flush=True)
        self.told, self.finished = now, progress.stage if ended else ""


class _TimeLeft(ProgressColumn):
    """The time left by a task's own ``left`` seconds, told ``at`` some moment, and counted down from there."""

    def render(self, task: Task) -> Text:
        left, at = task.fields.get("left"), task.fields.get("at")
        elapsed = task.finished_time if task.finished else task.elapsed
        spent = "" if elapsed is None else time_words(elapsed)
        if task.finished or left is None or at is None:
            return Text(spent, style="progress.elapsed")
        rest = max(left - (task.get_time() - at), 0.0)
        return Text(f"{spent}, about {time_words(rest)} left", style="progress.remaining")


def _columns() -> list[ProgressColumn]:
    return [TextColumn("{task.description}"), BarColumn(bar_width=24), TaskProgressColumn(), _TimeLeft()]


class _StagesAndLosses(Bars):
    """Bars with a line of loss terms below, which is too long to stand beside them."""

    losses = ""

    def get_renderables(self) -> Iterator[RenderableType]:
        yield from super().get_renderables()
        yield Text(self.losses, style="dim")


class _Bars:
    def __init__(self, bars: _StagesAndLosses, *, whole: bool) -> None:
        self.bars = bars
        self.whole = bars.add_task("whole", total=1.0) if whole else None
        self.stages: dict[str, TaskID] = {}

    def __call__(self, progress: Progress, /) -> None:
        if progress.stage not in self.stages:
            for task in self.stages.values():
                self.bars.update(task, completed=1.0)
            self.stages[progress.stage] = self.bars.add_task(f"  {progress.stage}", total=1.0)
        self.bars.losses = _losses(progress)
        _advance(self.bars, self.stages[progress.stage], progress.fraction)
        if self.whole is None:
            return
        # The whole is not over before who shows it says so, by leaving: what follows may not have been planned yet.
        done = min(progress.whole or 0.0, 0.999)
        self.bars.update(self.whole, completed=done, left=progress.left, at=self.bars.get_time())

    def end(self) -> None:
        """All is done."""
        for task in (*self.stages.values(), *([] if self.whole is None else [self.whole])):
            self.bars.update(task, completed=1.0)


def _losses(progress: Progress) -> str:
    return "  ".join(f"{name} {value:.1e}" for name, value in progress.losses.items())


@contextmanager
def counter_bar(title: str, *, clock: Callable[[], float] = time.monotonic) -> Iterator[Callable[[int, int], None]]:
    """A bar with the time left on stderr, to be told ``(done, total)``; lines now and then where it is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        schedule = Schedule(Lines(counting=True, clock=clock), clock=clock)
        yield lambda done, total: schedule(Progress(title, done, total, done / max(total, 1), {}))
        return
    with Bars(*_columns(), console=console, transient=True, get_time=clock) as bars:
        task = bars.add_task(title, total=1.0)
        yield lambda done, total: _advance(bars, task, done / max(total, 1))


def _advance(bars: Bars, task: TaskID, fraction: float) -> None:
    """Show how much of a stage is done, and how long the rest will take at the pace of what is."""
    elapsed = bars.tasks[bars.task_ids.index(task)].elapsed or 0.0
    left = elapsed * (1 - fraction) / fraction if fraction else None
    bars.update(task, completed=fraction, left=left, at=bars.get_time())
