"""Benchmark ``eta``: how long works were said to take while they were under way, and how long they took."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from mplicits.datasets import sample_torus
from mplicits.datasets.synthetic.scenes import SCENES, render_scene
from mplicits.neural_fields import InputError
from mplicits.pipelines.evolve.train import evolve
from mplicits.pipelines.fit.train import fit
from mplicits.pipelines.reconstruct.train import reconstruct
from mplicits.pipelines.run.config import load_config
from mplicits.pipelines.run.schedule import Progress, Report
from mplicits.pipelines.run.settings import EvolveConfig, FitConfig, ReconstructConfig

from ..harness.benchmark import Benchmark, Part
from ..harness.cells import Workplace
from ..harness.tables import Column, Figure, Table, tabulated

__all__ = ["WORKS", "EtaBench", "EtaRow", "Watch"]

WORKS = ("fit", "reconstruct", "evolve")
FIRST = 5.0  # seconds
SCENE = "painted-sphere"


@dataclass(frozen=True)
class EtaRow:
    """One work.

    Attributes:
        work: "fit", "reconstruct" or "evolve".
        seconds: that it took.
        at_first: seconds that it was said to take in all, after five of them; None where it took less.
        at_quarter: the same after a quarter of them.
        at_half: the same after half of them.
    """

    work: str
    seconds: float
    at_first: float | None
    at_quarter: float
    at_half: float


class Watch:
    """Hears how far a work is, and remembers how long it was said to take.

    Args:
        then: told of all progress as well.
        clock: seconds, from any origin.
    """

    def __init__(self, then: Report, clock: Callable[[], float] = time.monotonic) -> None:
        self.then, self.clock, self.begun = then, clock, clock()
        self.said: list[tuple[float, float]] = []  # when, and the time that was left

    def __call__(self, progress: Progress, /) -> None:
        """Remember a message."""
        if progress.left is not None:
            self.said.append((self.clock() - self.begun, progress.left))
        self.then(progress)

    def total_at(self, moment: float) -> float:
        """Seconds in all, as was said last before a ``moment``, or first where that was later."""
        heard = [sum(each) for each in self.said if each[0] <= moment]
        return heard[-1] if heard else sum(self.said[0])

    def row(self, work: str) -> EtaRow:
        """What the whole was said to take, now that it is over."""
        total = self.clock() - self.begun
        first = self.total_at(FIRST) if total > FIRST else None
        return EtaRow(work, total, first, self.total_at(total / 4), self.total_at(total / 2))


@dataclass(frozen=True, kw_only=True)
class EtaBench(Benchmark[EtaRow]):
    """The time left as progress bars show it, against the time that it took.

    A fit of a torus, a reconstruction of a painted sphere from exact pictures and a morph of a sphere into a torus,
    each with its ``fast`` preset.

    Attributes:
        works: some of `WORKS`.
        share: factor on the steps of the presets.
        points: of the torus.
    """

    name = "eta"
    row = EtaRow
    source = "the time left, as progress bars say it"
    works: tuple[str, ...] = WORKS
    share: float = 1.0
    points: int = 50_000

    def cells(self) -> list[Part]:
        """See `Benchmark.cells`: one for each work."""
        for work in self.works:
            if work not in WORKS:
                raise InputError(f"{work}: expected {', '.join(WORKS)}")
        return [Part(self.name, f"time left of {work}", options=(("work", work),)) for work in self.works]

    def measure(self, cell: Part, work: Workplace) -> list[EtaRow]:
        """See `Benchmark.measure`."""
        name = cell.parameters["work"]
        said = work.stage(name)
        if name == "fit":
            config = load_config(FitConfig, "fast", {"device": self.device})
            config, cloud = replace(config, steps=self._shared(*config.steps)), sample_torus(self.points)
            watch = Watch(said)
            fit(cloud, config, progress=watch)
        elif name == "reconstruct":
            settings = load_config(ReconstructConfig, "fast", {"device": self.device})
            (steps,) = self._shared(settings.steps)
            images = render_scene(SCENES[SCENE](), 24, 64, seed=0)
            watch = Watch(said)
            reconstruct(images, replace(settings, steps=steps), progress=watch)
        else:
            shapes = ("sphere:0.5", "torus:0.5,0.2")
            moving = load_config(EvolveConfig, "fast", {"device": self.device, "shapes": shapes})
            watch = Watch(said)
            evolve(replace(moving, steps=self._shared(*moving.steps)), progress=watch)
        return [watch.row(name)]

    def tables(self, rows: Sequence[EtaRow], *, sgemm: float) -> tuple[Table, ...]:
        """The whole as it was said to be, over what it was."""
        figures: list[Figure[EtaRow]] = [
            (Column("took, s", ".0f"), lambda r: r.seconds),
            (Column("said at 5 s", ".0f"), lambda r: r.at_first),
            (Column("over true", ".2f"), lambda r: None if r.at_first is None else r.at_first / r.seconds),
            (Column("said at 25 %", ".0f"), lambda r: r.at_quarter),
            (Column("over true", ".2f"), lambda r: r.at_quarter / r.seconds),
            (Column("said at 50 %", ".0f"), lambda r: r.at_half),
            (Column("over true", ".2f"), lambda r: r.at_half / r.seconds),
        ]
        items = [(row.work, row) for row in rows]
        return (tabulated(self.name, "The whole time, as it was said to be on the way", "work", figures, items),)

    def _shared(self, *steps: int) -> tuple[int, ...]:
        return tuple(max(round(self.share * count), 1) for count in steps)
