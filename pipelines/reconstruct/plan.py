"""What a reconstruction will do, and how long that should take: for a progress display, and within a time budget."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..run.costs import Net, Speed, jets, training, values
from ..run.schedule import Stage
from ..run.settings import ReconstructConfig, TextureConfig
from ..texture.train import texture_stages
from .hull import STEPS as HULL_STEPS
from .objective import EARLY, NEAR_EVERY, SMOOTH_RAYS, WHOLE_EVERY, WHOLE_LATER
from .seen import RAYS as SEEN_RAYS

__all__ = ["SEEING", "START", "WITNESSES", "ReconstructPlan", "level_stage"]

START = "a surface to begin with"
SEEING = "what photographs see"
TRACED = 8  # values along a ray that is traced to the surface
SPHERE_STEPS, SPHERE_BATCH = 200, 1024
# Of the samples of a ray: those in the band of the next level, those that get a colour, and rays that meet the region.
IN_BAND, COLOURED, MET = 0.4, 0.6, 0.8
# Where sections are skipped: those that are left.
EVALUATED = 0.2
NEUS = Net(parameters=459_000, neurons=2048)  # its 8 layers of 256
GRID = Net(parameters=6_000, neurons=256)  # as long as looking up the hash encoding takes
WITNESSES = 9  # cameras that are asked for the colour of a point of the texture, at most
MESHED = 128  # cells along the mesh whose points are coloured


def level_stage(level: int) -> str:
    """The name of the stage in which a level is the finest that is switched on."""
    return f"reconstruct, level {level}"


def grid_rows(resolution: int) -> float:
    """Values per step that keep the grid up to date: of the ball now and then, else of the twelfth near the surface."""
    ball = 4 / 3 * math.pi * (resolution / 2 + math.sqrt(3)) ** 3
    return ball * (EARLY / WHOLE_EVERY + (1 - EARLY) / WHOLE_LATER + 1 / 12) / NEAR_EVERY


@dataclass(frozen=True)
class ReconstructPlan:
    """The stages of a reconstruction, with the seconds that they should take.

    Attributes:
        config: its settings.
        speed: of the machine.
        pixels: of a view.
        held_out: how many views are.
        texture: settings of the texture.
    """

    config: ReconstructConfig
    speed: Speed
    pixels: int
    held_out: int
    texture: TextureConfig

    @property
    def nets(self) -> list[Net]:
        """The levels of the geometry."""
        if self.config.geometry == "neus":
            return [NEUS]
        return [Net.siren(*size) for size in zip(self.config.widths, self.config.depths, strict=True)]

    def starts(self) -> list[float]:
        """When each level is switched on, as shares of the training."""
        return [0.0] if self.config.geometry == "neus" else [*self.config.starts[: len(self.nets)]]

    def before(self) -> list[Stage]:
        """What comes before the training."""
        hull = 0 if self.config.start == "sphere" or self.config.geometry == "neus" else HULL_STEPS
        steps = SPHERE_STEPS + hull
        return [Stage(START, "rays", self.speed.networks(training(steps, SPHERE_BATCH, self.nets[:1]), steps=steps))]

    def levels(self) -> list[Stage]:
        """The training, in a stage for each level that joins."""
        starts = self.starts()
        shares = [end - begin for begin, end in zip(starts, [*starts[1:], 1.0], strict=True)]
        return [
            Stage(level_stage(level), "rays", share * self.config.steps * self.step_seconds(level))
            for level, share in enumerate(shares)
        ]

    def after(self) -> list[Stage]:
        """What comes after it."""
        stages = []
        if self.held_out:
            stages.append(Stage("held-out views", "rays", self.held_out * self.view_seconds()))
        stages.append(Stage(SEEING, "rays", self.speed.points(values(SEEN_RAYS * TRACED, self.nets))))
        if self.config.texture_steps:
            meshed = values(4 * MESHED**2, self.nets) + jets(self.texture.samples, self.nets)
            meshed += values((WITNESSES + 1) * self.texture.samples, [self._color()])
            stages.append(Stage("texture: surface", "mesh", self.speed.points(meshed)))
            stages += texture_stages(self.texture, self.texture.samples, self.nets, self.speed)
        return stages

    def step_seconds(self, level: int) -> float:
        """One step, while so many levels are switched on."""
        config = self.config
        samples = config.rays * (config.uniform + config.importance)
        # Values find where importance samples belong; then jets of the samples that are left are trained.
        marched = grid_rows(config.march_grid) if config.march_grid else samples if config.importance else 0.0
        looked = values(marched, self.nets[:1])
        evaluated = EVALUATED * samples if config.skip else samples
        # Those that get a colour are half of all samples at most.
        coloured = COLOURED * min(evaluated, samples / 2)
        if config.smooth_weight:
            evaluated += 3 * min(SMOOTH_RAYS, config.rays)
        trained = training(1, evaluated, self._on(level)) + training(1, coloured, [self._color()])
        return self.speed.networks(MET * (looked + trained), steps=2)

    def view_seconds(self) -> float:
        """One picture of a view."""
        samples = self.pixels * (self.config.uniform + self.config.importance)
        nets = self._on(len(self.nets) - 1)
        evaluated = EVALUATED * samples if self.config.skip else samples
        work = values(samples, nets[:1]) + jets(evaluated, nets) + values(COLOURED * evaluated, [self._color()])
        return self.speed.networks(MET * work)

    def _on(self, level: int) -> list[Net]:
        """The levels that are switched on; all but the first only look at what is in their band."""
        first, *others = self.nets[: level + 1]
        shared = [Net(round(IN_BAND * net.parameters), round(IN_BAND * net.neurons)) for net in others]
        return [first, *shared]

    def _color(self) -> Net:
        width, depth = self.config.color_width, self.config.color_depth
        grid = GRID if self.config.color_grid else Net(0, 0)
        return Net(
            parameters=grid.parameters + width * (width * (depth - 1) + 100), neurons=grid.neurons + width * depth
        )
