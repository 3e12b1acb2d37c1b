"""What ``reconstruct`` minimises: rendered rays against photographs; levels join on schedule, bands follow 1/s."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...neural_fields.hash_encoding import tables_apart
from ...neural_fields.losses import eikonal_loss
from ...neural_fields.value_grid import ValueGrid
from ...neural_fields.volume_renderer import Rendered, Sampling
from ..run.focus import Focus
from ..run.settings import ReconstructConfig
from ..run.team import gathered, mean_of_all, own_generator, whole_batch
from ..run.trainer import Group, Objective, Trainer, warm_cosine
from .measured import MeasuredDepths, depth_loss
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

__all__ = ["SceneObjective", "scene_trainer"]


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
        self.grid = ValueGrid(config.march_grid, pool.device) if config.march_grid else None
        if self.grid is not None:
            self.kept |= {"march": self.grid.kept, "moved": self.grid.moved, "looks": torch.tensor([0, NEAR_EVERY, 0])}
        self.measured = measured if config.depth_weight else None
        if self.measured is not None:
            self.kept["affine"] = self.measured.affine

    def level_at(self, done: float) -> int:
        """The finest level that is switched on when a fraction of the schedule is done."""
        started = sum(start <= done for start in self.config.starts)
        return min(started, self.model.geometry.num_levels) - 1

    def look(self, step: int, done: float) -> ValueGrid | None:
        """The grid that rays march on, brought up to date: its near part often, all of it now and then.

        While the surface moves, often is every `NEAR_EVERY` steps; the less it moved, the longer it is left alone.
        """
        if self.grid is None:
            return None
        self.grid.kept = self.kept["march"]  # that of a run which is resumed
        looked, pause, looks = self.kept["looks"].tolist()
        if step >= looked + pause or not looks:
            unsure = float(self.kept["lately"][1])
            cell = 2 * math.sqrt(3) / self.grid.resolution  # its diagonal: all corners beside the surface are that near
            self.grid.reach = min(max(KNOWN * unsure, cell), max(FURTHEST, cell))
            whole = looks % (WHOLE_EVERY if done < EARLY else WHOLE_LATER) == 0
            self.grid.refresh(self.model.geometry, whole=whole)
            self.kept |= {"moved": self.grid.moved, "looks": torch.tensor([step, pause, looks + 1])}
        return self.grid

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
        config = self.config
        self.model.widen(config.band, config.least_delta)
        rays = self.pool.draw(whole_batch(self.batch()), self.generator, self.focus.watched(step, self.kept))
        generator = own_generator(self.generator)
        origins, directions = rays.origins, rays.directions
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(origins, directions, rays.view)
        seen = self.model.render(
            origins,
            directions,
            self.sampling,
            cos_anneal=min(1.0, done / config.anneal) if config.anneal else 1.0,
            level=self.level_at(done),
            least_weight=config.least_weight,
            skip=config.skip,
            skip_share=config.skip_share,
            guide=self.look(step, done),
            generator=generator,
        )
        if (step + 1) % NEAR_EVERY == 0:
            self.remember(step, mean_of_all((seen.counts > 0).sum() / len(origins)))
        target = rays.color
        if self.pool.has_masks:
            target = torch.lerp(self.model.background.expand_as(target), target, rays.mask[:, None])
        wrong = (self.model.photographed(seen, rays.view) - target).abs().mean(dim=1)
        self.focus.learn(gathered(rays.row), gathered(wrong.detach()))
        color = wrong.mean()
        # A mean over all sections within the region, those that were skipped included: some stand for the others.
        within = mean_of_all((seen.counts > 0).any(dim=1).sum().to(wrong)).clamp(min=1) * seen.counts.shape[1]
        eikonal = (seen.counts * eikonal_loss(seen.jet.gradient)).sum() / within
        terms = {"color": color, "eikonal": eikonal}
        total = color + config.eikonal_weight * eikonal
        if self.pool.has_masks and config.mask_weight:
            opacity = seen.opacity.clamp(1e-3, 1 - 1e-3)
            mask = torch.nn.functional.binary_cross_entropy(opacity, rays.mask)
            terms["mask"] = mask
            total = total + config.mask_weight * mask
        if config.smooth_weight:
            smooth = self.smooth_term(origins, directions, rays.flat, seen, self.level_at(done))
            terms["smooth"] = smooth
            total = total + config.smooth_weight * smooth
        if self.measured is not None and (done < FADED or self.measured.is_exact):
            depth = self.depth_term(self.measured, step, done)
            terms["depth"] = depth
            total = total + config.depth_weight * depth
        terms["uncertainty"] = 1 / self.model.inv_std
        return terms, total

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

    def depth_term(self, measured: MeasuredDepths, step: int, done: float) -> Tensor:
        """How far the surface is from what was measured: the mean of `depth_loss` over rays at random."""
        measured.affine = self.kept["affine"]  # that of a run which is resumed
        if measured.is_loose and done < FADED and step % SETTLE_EVERY == 0:
            measured.settle(self.grid or (lambda x: self.model.geometry.value(x, level=0)))
            self.kept["affine"] = measured.affine
        rays = measured.draw(whole_batch(DEPTH_RAYS), self.generator)
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(rays.origins, rays.directions, rays.view)
            rays = rays._replace(origins=origins, directions=directions)
        missed = depth_loss(
            self.model.geometry, rays, level=self.level_at(done), generator=own_generator(self.generator)
        )
        return torch.where(rays.exact, missed, max(1 - done / FADED, 0.0) * missed).mean()


def scene_trainer(
    model: SceneModel,
    pool: RayPool,
    config: ReconstructConfig,
    *,
    measured: MeasuredDepths | None = None,
    seconds: float | None = None,
) -> Trainer[SceneObjective]:
    """The training of a scene; see `SceneObjective` and `Trainer`."""
    return Trainer(
        SceneObjective(model, pool, config, measured),
        stage="reconstruct",
        steps=config.steps,
        seconds=seconds,
        network_name="model",
    )
