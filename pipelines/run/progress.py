"""A progress bar per stage of a fit, with its loss terms and the time left."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.text import Text

from .trainer import Progress, Report

__all__ = ["counter_bar", "progress_bars"]


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Show bars on stderr; where that is no terminal, one line per finished stage instead."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines()
        return
    bars = _BarsAndLosses(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    )
    with bars:
        yield _Bars(bars)


class _BarsAndLosses(Bars):
    """Bars with a line of loss terms below, which is too long to stand beside them."""

    losses = ""

    def get_renderables(self) -> Iterator[RenderableType]:
        yield from super().get_renderables()
        yield Text(self.losses, style="dim")


class _Bars:
    def __init__(self, bars: _BarsAndLosses) -> None:
        self.bars = bars
        self.tasks: dict[str, TaskID] = {}

    def __call__(self, progress: Progress, /) -> None:
        if progress.stage not in self.tasks:
            for task in self.tasks.values():
                self.bars.update(task, completed=1.0)
            self.tasks[progress.stage] = self.bars.add_task(progress.stage, total=1.0)
        self.bars.losses = _text(progress)
        self.bars.update(self.tasks[progress.stage], completed=progress.fraction)


class _Lines:
    def __call__(self, progress: Progress, /) -> None:
        if progress.fraction >= 1:
            print(f"{progress.stage}: {progress.step:,} steps; {_text(progress)}", file=sys.stderr)


def _text(progress: Progress) -> str:
    return "  ".join(f"{name} {value:.1e}" for name, value in progress.losses.items())


@contextmanager
def counter_bar(title: str) -> Iterator[Callable[[int, int], None] | None]:
    """A progress bar with the time left on stderr, to be told ``(done, total)``; None where that is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    with Bars(console=console, transient=True) as bar:
        task = bar.add_task(title)
        yield lambda done, total: bar.update(task, completed=done, total=total)
