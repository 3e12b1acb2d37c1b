"""Progress on stderr: a bar for each stage, with the elapsed time and the time left at the pace so far; and tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console, RenderableType
from rich.progress import BarColumn, ProgressColumn, Task, TaskID, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bars
from rich.text import Text

from .settings import input_error


@dataclass(frozen=True)
class Progress:
    """How far a stage of the work is."""

    stage: str
    step: int
    steps: int  # planned; 0 for a stage that does not count steps
    fraction: float  # of the stage, in [0, 1]; not step / steps where a time budget may end it earlier
    losses: Mapping[str, float]  # unweighted terms of the last reported step


Report = Callable[[Progress], None]


def silent(_: Progress, /) -> None:
    """A `Report` that ignores everything."""


@contextmanager
def reported(report: Report | None, stage: str) -> Iterator[None]:
    """Report the beginning and the end of a stage that does not count steps."""
    report = report or silent
    report(Progress(stage, 0, 0, 0.0, {}))
    yield
    report(Progress(stage, 0, 0, 1.0, {}))


@contextmanager
def progress_bars(*, counting: bool = False, clock: Callable[[], float] = time.monotonic) -> Iterator[Report]:
    """Show a bar for each stage on stderr; where that is no terminal, print lines, see `Lines`.

    Bars of stages that are ``counting`` something go when they are done.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Lines(counting=counting, clock=clock)
        return
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TaskProgressColumn(), _TimeLeft())
    with _StagesAndLosses(*columns, console=console, transient=counting, get_time=clock) as bars:
        shown = _Bars(bars)
        yield shown
        shown.end()


def time_words(seconds: float) -> str:
    """A time to wait in two units at most: ``8 s``, ``2 min 10 s``, ``1 h 05 min``.

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

    Stages that are ``counting`` something are not worth a line when they are done.
    """

    def __init__(self, *, counting: bool = False, clock: Callable[[], float] = time.monotonic) -> None:
        self.counting, self.clock = counting, clock
        self.told, self.finished = clock(), ""
        self.begun: dict[str, tuple[float, float]] = {}  # when each stage began, and its fraction then

    def __call__(self, progress: Progress, /) -> None:
        """Print what is worth a line."""
        ended, now = progress.fraction >= 1, self.clock()
        begun, before = self.begun.setdefault(progress.stage, (now, progress.fraction))
        if ended and (self.counting or progress.stage == self.finished):
            return
        if not ended and now - self.told < 30:
            return
        if ended:
            steps = f"{progress.step:,} steps" if progress.losses else "done"
            facts = [f"{steps} in {time_words(now - begun)}", _losses(progress)]
        else:
            left = seconds_left(now - begun, before, progress.fraction)
            facts = [f"{progress.fraction:.0%}"] + ([] if left is None else [f"about {time_words(left)} left"])
        print(f"{progress.stage}: {'; '.join(fact for fact in facts if fact)}", file=sys.stderr, flush=True)
        self.told, self.finished = now, progress.stage if ended else ""


def seconds_left(elapsed: float, before: float, fraction: float) -> float | None:
    """Seconds that a stage still takes at the pace so far; None before there is any.

    ``before`` is the fraction that was done when it began ``elapsed`` seconds ago, more than 0 for a resumed one.
    """
    return elapsed * (1 - fraction) / (fraction - before) if fraction > before else None


class _TimeLeft(ProgressColumn):
    """Elapsed time of a task, and its time left as estimated at its last report, counted down from there."""

    def render(self, task: Task) -> Text:
        left, at = task.fields.get("left"), task.fields.get("at")
        elapsed = task.finished_time if task.finished else task.elapsed
        spent = "" if elapsed is None else time_words(elapsed)
        if task.finished or left is None or at is None:
            return Text(spent, style="progress.elapsed")
        rest = max(left - (task.get_time() - at), 0.0)
        return Text(f"{spent}, about {time_words(rest)} left", style="progress.remaining")


class _StagesAndLosses(Bars):
    """Bars with a line of loss terms below, which is too long to stand beside them."""

    losses = ""

    def get_renderables(self) -> Iterator[RenderableType]:
        yield from super().get_renderables()
        if self.losses:
            yield Text(self.losses, style="dim")


class _Bars:
    def __init__(self, bars: _StagesAndLosses) -> None:
        self.bars = bars
        self.stages: dict[str, TaskID] = {}

    def __call__(self, progress: Progress, /) -> None:
        if progress.stage not in self.stages:
            self.end()
            self.stages[progress.stage] = self.bars.add_task(progress.stage, total=1.0, before=progress.fraction)
        self.bars.losses = _losses(progress)
        self._advance(self.stages[progress.stage], progress.fraction)

    def end(self) -> None:
        """All stages so far are done."""
        for task in self.stages.values():
            self.bars.update(task, total=1.0, completed=1.0)

    def _advance(self, task: TaskID, fraction: float) -> None:
        """Show how much of a stage is done, and how long the rest takes at that pace; a pulse before anything is."""
        shown = self.bars.tasks[self.bars.task_ids.index(task)]
        left = seconds_left(shown.elapsed or 0.0, shown.fields["before"], fraction)
        shown.total = 1.0 if fraction else None  # `update` cannot take a total away
        self.bars.update(task, completed=fraction, left=left, at=self.bars.get_time())


def _losses(progress: Progress) -> str:
    return "  ".join(f"{name} {value:.1e}" for name, value in progress.losses.items())


def counted(report: Report, stage: str) -> Callable[[int, int], None]:
    """A function that reports how many parts of a stage are done, of how many."""
    return lambda done, total: report(Progress(stage, done, total, done / max(total, 1), {}))


@contextmanager
def counter_bar(title: str, *, clock: Callable[[], float] = time.monotonic) -> Iterator[Callable[[int, int], None]]:
    """A bar with the time left on stderr, to be told ``(done, total)``; lines now and then where it is no terminal."""
    with progress_bars(counting=True, clock=clock) as report:
        yield counted(report, title)


@contextmanager
def tensorboard_log(directory: str | Path) -> Iterator[Report]:
    """A receiver of progress that writes each loss term of a stage to a ``directory``, as "level 0/surface.data".

    Raises:
        InputError: tensorboard is not installed, or the directory cannot be made.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise input_error("--tensorboard: needs tensorboard; pip install mplicits[tensorboard]") from error
    try:
        Path(directory).mkdir(parents=True, exist_ok=True)
        writer = SummaryWriter(str(directory))
    except OSError as error:
        raise input_error(f"--tensorboard {directory}: cannot be written ({error.strerror or error})") from error

    def log(progress: Progress, /) -> None:
        for name, value in progress.losses.items():
            writer.add_scalar(f"{progress.stage}/{name}", value, progress.step)

    try:
        yield log
    finally:
        writer.close()


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Text in aligned columns, the first to the left and the others to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row in [header, ["-" * width for width in widths], *rows]:
        cells = [
            cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
