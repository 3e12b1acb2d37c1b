"""What an evolution will do, and how long that should take: for its progress display, and within its time budget.

Without a budget nothing of this changes what is computed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from ..run.costs import Net, Speed, jets, training, values
from ..run.schedule import Stage
from ..run.settings import EvolveConfig
from .source import CELLS

__all__ = ["FEWEST_STEPS", "EvolvePlan", "within"]

# Steps of a field of space-time over those of a field of space with as many parameters, by the law's derivatives.
ORDER_ONE, ORDER_TWO = 1.6, 2.8
# A shape that is given as a field: what its coarse levels cost; and one that is a formula.
USUAL, EXACT = Net.siren(256, 2), Net(2000, 60)
# Of a step of a motion: evaluations on its paths, and of the shapes where they end. For each known sample of a
# deformation: evaluations of the motion, by Runge and Kutta forth and back, with derivatives.
PATHS, ENDS, CARRIED = 26_000, 1_500, 160
# Grid of the pace between two shapes: its vertices, and how often the motion is asked for each, most not at all.
PACED, PACED_WAYS = (CELLS + 1) ** 3, 8
MESHED = 128  # cells along the meshes of shapes
ENDS_MESHED = 192
# FLOPs that take as long as the Chamfer distance of an end; and as a mesh beside its values, by its resolution squared:
# networks of an evolution are small, so that signs and triangles cost more than they do.
JUDGING, SQUARE = 2.0e10, 0.9e6
# A level is not worth fewer steps, or fewer than a quarter of its own.
FEWEST_STEPS = 40
FEWEST_SAMPLES, FEWEST_FRAMES = 5_000, 3
# Of a budget that is too small, what known samples and the checks at the end may take.
SAMPLING_SHARE, CHECKING_SHARE, MOVING_SHARE = 0.25, 0.25, 0.3
FEWEST_MOTION_STEPS = 50


@dataclass(frozen=True)
class EvolvePlan:
    """The stages of an evolution, with the seconds that they should take.

    Attributes:
        config: settings of the evolution.
        speed: of the machine.
    """

    config: EvolveConfig
    speed: Speed

    def stages(self, first: int = 0, *, begun: bool = False) -> list[Stage]:
        """Training from a level on, which has ``begun`` if its start is learnt; and the checks."""
        config, start = self.config, [self.starting()] if first == 0 and not begun else []
        return [*start, *(self.level(level) for level in range(first, config.num_levels)), self.checking()]

    def shapes(self) -> Stage:
        """Reading and meshing the shapes."""
        work = values(4 * MESHED**2, self._given())
        return Stage("shapes", "shapes", self.speed.points(work))

    def moving(self, known: bool = False) -> list[Stage]:
        """Learning the motion of a deformation, unless it is ``known``."""
        if self.config.kind != "deform" or known:
            return []
        steps = self.config.motion_steps * max(len(self.config.shapes) - 1, 1)
        work = training(steps, PATHS, [self._motion()]) + training(steps, ENDS, self._given()[:1])
        return [Stage("motion", "steps", self.speed.networks(work, steps=steps))]

    def known(self) -> Stage:
        """Samples at which the field is known, and bounds."""
        config = self.config
        points = 4.5 * config.samples / max(len(config.shapes), 1) + 1e5
        work = jets(points, self._given())
        if config.kind == "deform":
            work += training(1, CARRIED * config.samples, [self._motion()])
            pairs = max(len(config.shapes) - 1, 1)
            work += values(pairs * PACED, self._given()) + values(pairs * PACED * PACED_WAYS, [self._motion()])
        return Stage("known samples", "samples", self.speed.points(work))

    def starting(self) -> Stage:
        """Learning the shape at time 0."""
        steps = self.config.start_steps
        work = training(steps, self.config.batch / 2, [self._net(0, inputs=3)])
        return Stage("first shape", "steps", self.speed.networks(work, steps=steps))

    def level(self, level: int) -> Stage:
        """All steps of a level."""
        steps = self.config.steps[level]
        return Stage(f"level {level}", "steps", steps * self.step_seconds(level))

    def step_seconds(self, level: int) -> float:
        """One step of a level."""
        config, order = self.config, ORDER_TWO if self.config.kind == "smooth" else ORDER_ONE
        before = jets(config.batch, [self._net(each) for each in range(level)])
        return self.speed.networks(order * training(1, config.batch, [self._net(level)]) + before, steps=1)

    def checking(self) -> Stage:
        """Meshes of frames and ends."""
        config, nets = self.config, [self._net(level) for level in range(self.config.num_levels)]
        ends = 2 if config.kind == "transport" else max(len(config.shapes), 1)
        cells = config.frames * config.resolution**2 + ends * ENDS_MESHED**2
        work = values(4 * cells, nets) + jets(2 * cells, nets) + SQUARE * cells + ends * JUDGING
        return Stage("checks", "mesh", self.speed.points(work))

    def _given(self) -> list[Net]:
        """The shapes' fields; exact ones, as "sphere:0.5", cost next to nothing."""
        return [USUAL if Path(shape).exists() else EXACT for shape in self.config.shapes]

    def _motion(self) -> Net:
        return Net.siren(self.config.motion_width, 2, inputs=4)

    def _net(self, level: int, *, inputs: int = 4) -> Net:
        return Net.siren(self.config.widths[level], self.config.depths[level], inputs=inputs)


def within(config: EvolveConfig, speed: Speed, seconds: float) -> tuple[EvolveConfig, list[str]]:
    """The settings that a time budget leaves, and sentences on what it changed: fewer known samples, fewer checks.

    Args:
        config: settings.
        speed: of the machine.
        seconds: that are left.
    """
    plan, notes = EvolvePlan(config, speed), list[str]()
    for stage in plan.moving():
        steps = max(int(MOVING_SHARE * seconds / stage.seconds * config.motion_steps), FEWEST_MOTION_STEPS)
        if steps < config.motion_steps:
            notes.append(f"{steps} steps of the motion instead of {config.motion_steps}")
            config = replace(config, motion_steps=steps)
    share = SAMPLING_SHARE * seconds / plan.known().seconds
    if share < 1 and config.samples > FEWEST_SAMPLES:
        samples = max(int(share * config.samples), FEWEST_SAMPLES)
        notes.append(f"{samples:,} known samples instead of {config.samples:,}")
        config = replace(config, samples=samples)
    share = CHECKING_SHARE * seconds / plan.checking().seconds
    if share < 1 and config.frames > FEWEST_FRAMES:
        frames = max(int(share * config.frames), FEWEST_FRAMES)
        notes.append(f"{frames} frames are checked instead of {config.frames}")
        config = replace(config, frames=frames)
    return config, notes
