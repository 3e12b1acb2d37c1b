"""What ``reconstruct`` minimises: rendered rays against photographs; levels join on schedule, bands follow 1/s."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ....neural_fields.backend.devices import handed, is_supplied
from ....neural_fields.fields.losses import eikonal_loss
from ....neural_fields.networks.hash_encoding import tables_apart
from ....neural_fields.networks.value_grid import ValueGrid
from ....neural_fields.volume.render import Rendered, Sampling
from ...training.focus import Focus
from ...training.settings import ReconstructConfig
from ...training.trainer import Group, Objective, warm_cosine
from ..data.measured import MeasuredDepths, depth_loss
from ..sampling.coverage import Coverage
from .model import RayPool, SceneModel
from .smoothness import tangents, unevenness

# Steps between two looks at the surface's surroundings, at least and at most.
NEAR_EVERY, NEAR_REST = 16, 128
# Such looks between two at everything: in the share of the training in which the surface comes to its place, and later.
WHOLE_EVERY, WHOLE_LATER, EARLY = 8, 64, 0.125
# How far values near the surface may move from look to look, and how far off they have to be known (no light is stopped
# further off), in units of its uncertainty 1/s; the latter in radii of the region, at most.
MOVED, KNOWN, FURTHEST = 0.125, 8.0, 0.15
LEAST_SHARE = 0.25  # of the rays of a step, however many sections they have
# The share of the training after which cameras are moved, and their rate in units of the geometry's.
POSES_FROM, POSE_RATE = 0.1, 3.0
# Rays of a step whose ends are held to be smooth, and the opacity of those that end on something.
SMOOTH_RAYS, SOLID = 96, 0.9
DEPTH_RAYS = 256  # measured ones of a step
# Steps between two fits of maps whose scale is not known to the surface; and the share of the training after which
# depths that were estimated from single pictures, which are wrong in their details, do not count any more.
SETTLE_EVERY, FADED = 64, 0.5

__all__ = ["Kind", "Outcome", "SceneObjective"]


class Kind(NamedTuple):
    """Of which kind a step is: those of one kind do the same operations.

    Attributes:
        rays: how many there are.
        level: the finest that is switched on.
        annealing: whether slopes are still annealed.
        measured: whether measured depths count.
    """

    rays: int
    level: int
    annealing: bool
    measured: bool


class Outcome(NamedTuple):
    """What a step is descended by.

    Attributes:
        terms: of the loss, unweighted.
        total: their weighted sum.
        sections: that are evaluated per ray, 0-d.
    """

    terms: dict[str, Tensor]
    total: Tensor
    sections: Tensor


class SceneObjective(Objective):
    """How far a scene is from the pixels of a pool.

    Args:
        model: what is trained, on the pool's device.
        pool: the pixels.
        config: settings.
        measured: depths of the same pictures, if there are any.
    """

    def __init__(
        self, model: SceneModel, pool: RayPool, config: ReconstructConfig, measured: MeasuredDepths | None = None
    ) -> None:
        rate = warm_cosine(config.learning_rate)
        parts = [part for part in (model.color, model.outside, model.exposures) if part is not None]
        grid, colors = tables_apart(*parts)
        groups = [
            Group(list(model.geometry.parameters()), rate),
            Group(colors, lambda done: config.color_rate * rate(done)),
            Group([model.variance], lambda done: config.sharpening * rate(done)),
        ]
        if grid:
            groups.append(Group(grid, lambda done: config.grid_rate * config.color_rate * rate(done)))
        if model.poses is not None:  # not before there is something to be compared with
            moved = list(model.poses.parameters())
            groups.append(Group(moved, lambda done: POSE_RATE * rate(done) if done > POSES_FROM else 0.0))
        super().__init__(model, groups, torch.Generator().manual_seed(config.seed))
        self.model, self.pool, self.config = model, pool, config
        self.sampling = Sampling(uniform=config.uniform, importance=config.importance)
        # As of late, on the CPU, which reads them: sections of a ray that are evaluated, and the surface's uncertainty.
        self.kept["lately"] = torch.tensor([0.0, 1 / float(model.inv_std.detach())])
        self.focus = Focus(len(pool), config.focus, pool.device)
        self.kept |= self.focus.kept
        self.coverage = Coverage(pool.device) if config.focus else None
        if self.coverage is not None:
            self.kept |= self.coverage.kept
        self.grid = ValueGrid(config.march_grid, pool.device) if config.march_grid else None
        if self.grid is not None:
            self.kept |= {"march": self.grid.kept, "moved": self.grid.moved, "looks": torch.tensor([0, NEAR_EVERY, 0])}
        self.done = 0.0  # of the schedule, at the step under way
        self.measured = measured if config.depth_weight else None
        if self.measured is not None:
            self.kept["affine"] = self.measured.affine

    def level_at(self, done: float) -> int:
        """The finest level that is switched on when a fraction of the schedule is done."""
        started = sum(start <= done for start in self.config.starts)
        return min(started, self.model.geometry.num_levels) - 1

    def look(self, step: int, done: float) -> None:
        """Bring the grid that rays march on up to date: its near part often, all of it now and then.

        While the surface moves, often is every `NEAR_EVERY` steps; the less it moved, the longer it is left alone.
        """
        if self.grid is None:
            return
        self.grid.kept = self.kept["march"]  # that of a run which is resumed
        looked, pause, looks = self.kept["looks"].tolist()
        if step >= looked + pause or not looks:
            unsure = float(self.kept["lately"][1])
            cell = 2 * math.sqrt(3) / self.grid.resolution  # its diagonal: all corners beside the surface are that near
            self.grid.reach = min(max(KNOWN * unsure, cell), max(FURTHEST, cell))
            whole = looks % (WHOLE_EVERY if done < EARLY else WHOLE_LATER) == 0
            self.grid.refresh(self.model.geometry, whole=whole)
            self.kept |= {"moved": self.grid.moved, "looks": torch.tensor([step, pause, looks + 1])}

    def remember(self, step: int, sections: Tensor) -> None:
        """Fetch what the next steps depend on, all at once: a GPU is waited for.

        Args:
            step: number of the step.
            sections: 0-d, evaluated per ray in it.
        """
        unsure = 1 / self.model.inv_std.detach()
        known = [sections, unsure.to(sections)]
        if self.grid is None:
            self.kept["lately"] = torch.stack(known).cpu()
            return
        *lately, moved = torch.stack([*known, self.kept["moved"].to(sections)]).tolist()
        self.kept["lately"] = torch.tensor(lately)
        looked, pause, looks = self.kept["looks"].tolist()
        if looked > step - NEAR_EVERY:  # since this was done last
            allowed = MOVED * lately[1]
            pause = pause // 2 if moved > allowed else 2 * pause if moved < allowed / 2 else pause
            self.kept["looks"] = torch.tensor([looked, min(max(pause, NEAR_EVERY), NEAR_REST), looks])

    def batch(self) -> int:
        """Rays of the next step: fewer while their sections are many, as they are while the surface is unsure."""
        rays, jets = self.config.rays, self.config.jets
        if not jets:
            return rays
        sections = float(self.kept["lately"][0])
        return min(max(round(jets / sections) if sections else 0, math.ceil(LEAST_SHARE * rays)), rays)

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        kind = self.ahead(step, done)
        outcome = self.evaluate(kind)
        self.behind(step, outcome.sections)
        return outcome.terms, outcome.total

    def ahead(self, step: int, done: float) -> Kind:
        """What has to be done on the host before a step, and of which kind the step is."""
        self.done = done
        self.focus.watched(step, self.kept)
        if self.coverage is not None:
            self.coverage.take_up(self.kept)
        self.look(step, done)
        measured = self.measured
        if measured is not None:
            measured.affine = self.kept["affine"]  # that of a run which is resumed
            if measured.is_loose and done < FADED and step % SETTLE_EVERY == 0:
                measured.settle(self.grid or (lambda x: self.model.geometry.value(x, level=0)))
                self.kept["affine"] = measured.affine
        return Kind(
            rays=self.batch(),
            level=self.level_at(done),
            annealing=done < self.config.anneal,
            measured=measured is not None and (done < FADED or measured.is_exact),
        )

    def behind(self, step: int, sections: Tensor) -> None:
        """What has to be done on the host after a step, of which a ray had so many sections, 0-d."""
        if (step + 1) % NEAR_EVERY == 0:
            self.remember(step, sections)

    def by_time(self, number: Callable[[float], float]) -> Tensor | float:
        """A number that follows from the share of the schedule that is done; a tensor where the step is replayed."""
        device = self.pool.device
        return handed(lambda: torch.tensor(number(self.done)), device) if is_supplied() else number(self.done)

    def evaluate(self, kind: Kind) -> Outcome:
        """The losses of a fresh batch; nothing of it depends on the step but by what it is `handed`."""
        config, pool = self.config, self.pool
        self.model.widen(config.band, config.least_delta)
        rays = pool.draw(kind.rays, self.generator, self.focus)
        origins, directions = rays.origins, rays.directions
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(origins, directions, rays.view)
        seen = self.model.render(
            origins,
            directions,
            self.sampling,
            cos_anneal=self.by_time(lambda done: done / config.anneal) if kind.annealing else 1.0,
            level=kind.level,
            least_weight=config.least_weight,
            skip=config.skip,
            skip_share=config.skip_share,
            guide=self.grid,
            generator=self.generator,
        )
        sections = (seen.counts > 0).sum() / len(origins)
        target = rays.color
        if pool.has_masks:
            target = torch.lerp(self.model.background.expand_as(target), target, rays.mask[:, None])
        wrong = (self.model.photographed(seen, rays.view) - target).abs().mean(dim=1)
        if self.coverage is not None:
            self.watch(self.coverage, rays.row, wrong, origins, directions, seen)
        color = wrong.mean()
        # A mean over all sections within the region, those that were skipped included: some stand for the others.
        within = (seen.counts > 0).any(dim=1).sum().to(wrong).clamp(min=1) * seen.counts.shape[1]
        eikonal = (seen.counts * eikonal_loss(seen.jet.gradient)).sum() / within
        terms = {"color": color, "eikonal": eikonal}
        total = color + config.eikonal_weight * eikonal
        if pool.has_masks and config.mask_weight:
            opacity = seen.opacity.clamp(1e-3, 1 - 1e-3)
            mask = torch.nn.functional.binary_cross_entropy(opacity, rays.mask)
            terms["mask"] = mask
            total = total + config.mask_weight * mask
        if config.smooth_weight:
            smooth = self.smooth_term(origins, directions, rays.flat, seen, kind.level)
            terms["smooth"] = smooth
            total = total + config.smooth_weight * smooth
        if self.measured is not None and kind.measured:
            depth = self.depth_term(self.measured, kind.level)
            terms["depth"] = depth
            total = total + config.depth_weight * depth
        terms["uncertainty"] = 1 / self.model.inv_std
        return Outcome(terms, total, sections)

    @torch.no_grad()
    def watch(
        self, coverage: Coverage, rows: Tensor, wrong: Tensor, origins: Tensor, directions: Tensor, seen: Rendered
    ) -> None:
        """Take note of how wrong pixels are, which counts the more the fewer see the same place."""
        # Where most of a ray ends: the mean of two surfaces, one behind the other, is on none.
        depth = seen.depths.gather(1, seen.weights.argmax(dim=1, keepdim=True))
        around = coverage.around(origins + depth * directions)
        rare = torch.lerp(torch.ones_like(wrong), coverage.rarity(around), seen.opacity)
        self.focus.learn(rows, rare * wrong)
        coverage.learn(around, self.focus.odds(rows), seen.opacity)

    def smooth_term(self, origins: Tensor, directions: Tensor, flat: Tensor, seen: Rendered, level: int) -> Tensor:
        """How unevenly normals turn where rays end whose pixels are like those around; of the first rays of a step.

        Where the rays end is taken as it is: only how the surface lies there is taught.
        """
        first = slice(SMOOTH_RAYS)
        with torch.no_grad():
            opacity = seen.opacity[first]
            depth = seen.depth[first] / opacity.clamp_min(SOLID)
            ends = origins[first] + depth[:, None] * directions[first]
            along = tangents(normalize(seen.normal[first], dim=1))
            weight = torch.where(opacity > SOLID, flat[first], 0.0)
        return (weight * unevenness(self.model.geometry, ends, along, level=level)).mean()

    def depth_term(self, measured: MeasuredDepths, level: int) -> Tensor:
        """How far the surface is from what was measured: the mean of `depth_loss` over rays at random."""
        rays = measured.draw(DEPTH_RAYS, self.generator)
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(rays.origins, rays.directions, rays.view)
            rays = rays._replace(origins=origins, directions=directions)
        missed = depth_loss(self.model.geometry, rays, level=level, generator=self.generator)
        left = self.by_time(lambda done: max(1 - done / FADED, 0.0))
        return torch.where(rays.exact, missed, left * missed).mean()
