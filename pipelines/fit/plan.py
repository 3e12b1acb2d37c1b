"""What a fit will do, and how long that should take: its stages for a progress display, its shares of a time budget.

Without a budget nothing of this changes what is computed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ..run.costs import Net, Speed, densifying, jets, preparation, queries, training, values, windings
from ..run.schedule import Stage
from ..run.settings import FitConfig
from .unoriented import BATCH, SAMPLES, STAGES, STEPS

__all__ = ["FEWEST_SAMPLES", "FEWEST_STEPS", "FitPlan", "Share"]

# Dipoles that a winding number is the sum of: a leaf of the cloud each, and the single points of those near by.
DIPOLES = 3000
# Queries of a residual level are near the surface, where a few points are looked at; so many of a far one, per sample.
NEAR = 0.25
IN_BAND = 0.5  # of the points at which a level is asked, those that the next one is
# A level that gets fewer steps than this, or than a quarter of its own where those are fewer, is not begun: the warm-up
# of its learning rate would hardly be over.
FEWEST_STEPS = 60
FEWEST_SAMPLES = 5_000
# Of a level's share of a budget that is too small, its samples may take this part.
SAMPLING_SHARE = 1 / 3


@dataclass(frozen=True)
class Share:
    """What a level gets of a time budget.

    Attributes:
        seconds: for its samples and its training.
        samples: how many of each kind.
    """

    seconds: float
    samples: int


class FitPlan:
    """The stages of a fit, with the seconds that they should take.

    Args:
        config: settings of the fit.
        points: of the cloud.
        speed: of the machine.
    """

    def __init__(self, config: FitConfig, points: int, speed: Speed) -> None:
        self.config, self.points, self.speed = config, points, speed
        self.nets = [Net.siren(width, depth) for width, depth in zip(config.widths, config.depths, strict=True)]

    def preparing(self) -> Stage:
        """Cleaning the cloud."""
        return Stage("preparing the cloud", "preparation", self.speed.points(preparation(self.points)))

    def signs(self) -> list[Stage]:
        """Signs of normals, where level 0 gives them: one stage for each witness, the first with places to ask."""
        backward = 2  # times the work of a value
        points = (1 + backward) * values(STEPS * BATCH, self.nets[:1])
        seconds = self.speed.networks(points, steps=STEPS)
        places = self.speed.points(queries(SAMPLES, self.points) + windings(SAMPLES, DIPOLES))
        first, second = STAGES
        return [Stage(first, "steps", places + seconds), Stage(second, "steps", seconds)]

    def levels(self, first: int = 0, last: int | None = None) -> list[Stage]:
        """Samples and training of the levels from ``first`` on, up to but without ``last``."""
        numbers = range(first, self.config.num_levels if last is None else last)
        return [stage for level in numbers for stage in (self.sampling(level), self.training(level))]

    def sampling(self, level: int, samples: int | None = None) -> Stage:
        """Making the samples of a level."""
        return Stage(f"level {level}: samples", "samples", self.sampling_seconds(level, samples))

    def training(self, level: int) -> Stage:
        """All steps of a level."""
        return Stage(f"level {level}", "steps", self.config.steps[level] * self.step_seconds(level))

    def step_seconds(self, level: int) -> float:
        """One step of a level."""
        return self.speed.networks(training(1, self.config.batch, [self.nets[level]]), steps=1)

    def sampling_seconds(self, level: int, samples: int | None = None) -> float:
        """`sampling`, of so many samples instead of those of the settings."""
        count = self.config.samples if samples is None else samples
        filled = max(self.points, count) if self.config.between else self.points  # of a sparse cloud, at most
        if level:
            return self.speed.points(queries(NEAR * count, filled)) + self.looking_seconds(level, filled + 3 * count)
        points = queries(count, filled) + windings(count, DIPOLES)
        return self.speed.points(points + self._index(filled))

    def index_seconds(self, samples: int) -> float:
        """The index of the points, with what is between them; a part of the samples of level 0."""
        return self.speed.points(self._index(max(self.points, samples) if self.config.between else self.points))

    def _index(self, filled: int) -> float:
        return queries(filled, filled) + densifying(filled - self.points)

    def looking_seconds(self, level: int, points: int) -> float:
        """The levels before ``level`` at so many points; all but the first at those in their bands."""
        first, others = self.nets[:1], self.nets[1:level]
        return self.speed.networks(jets(points, first) + jets(IN_BAND * points, others))

    def shares(
        self,
        first: int,
        seconds: float,
        slowness: Callable[[str], float] = lambda _: 1.0,
    ) -> list[Share]:
        """Of a time budget: what each level from ``first`` on gets; levels that are left out are not in the list.

        If there is time for all that the settings ask for, it is shared out by how much that takes. If not, samples
        become fewer, until they take no more than `SAMPLING_SHARE` of their level. Levels that would then be trained
        for less than `FEWEST_STEPS` are left out, the finest first. Level 0 never is.

        Args:
            first: the next level.
            seconds: that are left.
            slowness: by kind of work, seconds that it takes for one predicted.
        """
        for last in range(self.config.num_levels, first, -1):
            shares = self._shared(range(first, last), seconds, slowness)
            if all(
                self._is_worth(level, share, slowness) for level, share in zip(range(first, last), shares, strict=True)
            ):
                return shares
        return self._shared(range(1), seconds, slowness) if first == 0 else []

    def least_seconds(self, level: int, slowness: Callable[[str], float]) -> float:
        """The training below which a level is not worth its samples."""
        return self._least_steps(level) * self.step_seconds(level) * slowness("steps")

    def _shared(self, levels: Sequence[int], seconds: float, slowness: Callable[[str], float]) -> list[Share]:
        sampling = [self.sampling_seconds(level) * slowness("samples") for level in levels]
        steps = [self.config.steps[level] * self.step_seconds(level) * slowness("steps") for level in levels]
        whole, full = seconds / (sum(sampling) + sum(steps)), self.config.samples
        if whole >= 1:
            return [Share((make + train) * whole, full) for make, train in zip(sampling, steps, strict=True)]
        shares = []
        for level, train in zip(levels, steps, strict=True):
            mine = seconds * train / sum(steps)
            shares.append(Share(mine, self._samples_in(level, SAMPLING_SHARE * mine / slowness("samples"))))
        return shares

    def _samples_in(self, level: int, seconds: float) -> int:
        """How many samples a level can have in so much time, not slowed down: what it takes grows linearly."""
        none, full = self.sampling_seconds(level, 0), self.sampling_seconds(level)
        share = (seconds - none) / (full - none)
        count = int(min(1.0, max(0.0, share)) * self.config.samples)
        return max(count, min(FEWEST_SAMPLES, self.config.samples))

    def _least_steps(self, level: int) -> int:
        return min(FEWEST_STEPS, -(-self.config.steps[level] // 4))

    def _is_worth(self, level: int, share: Share, slowness: Callable[[str], float]) -> bool:
        made = self.sampling_seconds(level, share.samples) * slowness("samples")
        return share.seconds - made >= self.least_seconds(level, slowness)
