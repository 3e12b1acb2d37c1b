"""What ``reconstruct`` minimises: rendered rays against photographs; levels join on schedule, bands follow 1/s."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...neural_fields.backend.devices import handed, is_supplied
from ...neural_fields.backend.fixed_shapes import FixedShapes, fixed_shapes
from ...neural_fields.fields.losses import eikonal_loss
from ...neural_fields.networks.grids import ValueGrid, tables_apart
from ...neural_fields.volume.render import Sampling
from ..training.replay import CudaGraphs, Recorder, Replays
from ..training.settings import ReconstructConfig
from ..training.trainer import ErrorWeightedSampler, Group, Objective, Trainer, warm_cosine
from .measured import MeasuredDepths, depth_loss
from .model import RayPool, SceneModel


@dataclass(frozen=True)
class Schedule:
    """What happens when in the training of a scene. The values are this project's own."""

    near_every: int = 16  # steps between two updates of the SDF grid near the surface, at least
    near_rest: int = 128  # the same at most, while the surface rests
    whole_every: int = 8  # such updates between two of the whole grid, in the ``early`` share of the training
    whole_late: int = 64  # the same later
    early: float = 0.125  # share of the training in which the surface comes to its place
    # how far values near the surface may move between two updates, in units of its uncertainty 1/s
    moved: float = 0.125
    known: float = 8.0  # distance from the surface within which values are updated, in units of 1/s
    furthest: float = 0.15  # the same at most, in radii of the region
    least_rays: float = 0.25  # share of the rays that a step keeps, however many samples they have
    poses_from: float = 0.1  # share of the training after which camera poses are refined
    pose_rate: float = 3.0  # their learning rate over the geometry's
    depth_rays: int = 256  # measured rays per step
    settle_every: int = 64  # steps between two fits of scale and shift of depth maps to the surface
    faded: float = 0.5  # share of the training after which depths that were estimated from single pictures do not count


class Kind(NamedTuple):
    """The kind of a step: steps of one kind do the same operations."""

    rays: int  # how many there are
    level: int  # the finest that is switched on
    annealing: bool  # whether slopes are still annealed
    measured: bool  # whether measured depths count


class Outcome(NamedTuple):
    """What a step is descended by."""

    terms: dict[str, Tensor]  # of the loss, unweighted
    total: Tensor  # their weighted sum
    sections: Tensor  # samples that are evaluated per ray, 0-d


class SceneObjective(Objective):
    """How far a scene is from the pixels of a pool, and from depths that were measured in the same pictures."""

    schedule = Schedule()

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
            groups.append(
                Group(
                    moved, lambda done: self.schedule.pose_rate * rate(done) if done > self.schedule.poses_from else 0.0
                )
            )
        super().__init__(model, groups, torch.Generator().manual_seed(config.seed))
        self.model, self.pool, self.config = model, pool, config
        self.sampling = Sampling(uniform=config.uniform, importance=config.importance)
        # As of late, on the CPU, which reads them: sections of a ray that are evaluated, and the surface's uncertainty.
        self.kept["lately"] = torch.tensor([0.0, 1 / float(model.inv_std.detach())])
        self.sampler = ErrorWeightedSampler(len(pool), config.focus, pool.device)
        self.kept |= self.sampler.kept
        self.grid = ValueGrid(config.march_grid, pool.device) if config.march_grid else None
        if self.grid is not None:
            self.kept |= {
                "march": self.grid.kept,
                "moved": self.grid.moved,
                "looks": torch.tensor([0, self.schedule.near_every, 0]),
            }
        self.done = 0.0  # of the schedule, at the step under way
        self.measured = measured if config.depth_weight else None
        if self.measured is not None:
            self.kept["affine"] = self.measured.affine

    def level_at(self, done: float) -> int:
        """The finest level that is switched on when a fraction of the schedule is done."""
        started = sum(start <= done for start in self.config.starts)
        return min(started, self.model.geometry.num_levels) - 1

    def look(self, step: int, done: float) -> None:
        """Bring the SDF grid up to date: near the surface often, all of it now and then; see `Schedule`."""
        if self.grid is None:
            return
        plan = self.schedule
        self.grid.kept = self.kept["march"]  # that of a run which is resumed
        looked, pause, looks = self.kept["looks"].tolist()
        if step >= looked + pause or not looks:
            unsure = float(self.kept["lately"][1])
            cell = 2 * math.sqrt(3) / self.grid.resolution  # its diagonal: all corners beside the surface are that near
            self.grid.reach = min(max(plan.known * unsure, cell), max(plan.furthest, cell))
            whole = looks % (plan.whole_every if done < plan.early else plan.whole_late) == 0
            self.grid.refresh(self.model.geometry, whole=whole)
            self.kept |= {"moved": self.grid.moved, "looks": torch.tensor([step, pause, looks + 1])}

    def remember(self, step: int, sections: Tensor) -> None:
        """Fetch what the next steps depend on, all at once: a GPU is waited for."""
        unsure = 1 / self.model.inv_std.detach()
        known = [sections, unsure.to(sections)]
        if self.grid is None:
            self.kept["lately"] = torch.stack(known).cpu()
            return
        *lately, moved = torch.stack([*known, self.kept["moved"].to(sections)]).tolist()
        self.kept["lately"] = torch.tensor(lately)
        looked, pause, looks = self.kept["looks"].tolist()
        plan = self.schedule
        if looked > step - plan.near_every:  # since this was done last
            allowed = plan.moved * lately[1]
            pause = pause // 2 if moved > allowed else 2 * pause if moved < allowed / 2 else pause
            self.kept["looks"] = torch.tensor([looked, min(max(pause, plan.near_every), plan.near_rest), looks])

    def batch(self) -> int:
        """Rays of the next step: fewer while their sections are many, as they are while the surface is unsure."""
        rays, jets = self.config.rays, self.config.jets
        if not jets:
            return rays
        sections = float(self.kept["lately"][0])
        return min(max(round(jets / sections) if sections else 0, math.ceil(self.schedule.least_rays * rays)), rays)

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        kind = self.ahead(step, done)
        outcome = self.evaluate(kind)
        self.behind(step, outcome.sections)
        return outcome.terms, outcome.total

    def ahead(self, step: int, done: float) -> Kind:
        """Do what a step needs of the host first → the kind of the step."""
        self.done = done
        self.sampler.at_step(step, self.kept)
        self.look(step, done)
        measured = self.measured
        if measured is not None:
            measured.affine = self.kept["affine"]  # that of a run which is resumed
            if measured.is_loose and done < self.schedule.faded and step % self.schedule.settle_every == 0:
                measured.settle(self.grid or (lambda x: self.model.geometry.value(x, level=0)))
                self.kept["affine"] = measured.affine
        return Kind(
            rays=self.batch(),
            level=self.level_at(done),
            annealing=done < self.config.anneal,
            measured=measured is not None and (done < self.schedule.faded or measured.is_exact),
        )

    def behind(self, step: int, sections: Tensor) -> None:
        """Do what follows a step on the host; ``sections`` is the number per ray, 0-d."""
        if (step + 1) % self.schedule.near_every == 0:
            self.remember(step, sections)

    def by_time(self, number: Callable[[float], float]) -> Tensor | float:
        """A number that follows from the share of the schedule that is done; a tensor where the step is replayed."""
        device = self.pool.device
        return handed(lambda: torch.tensor(number(self.done)), device) if is_supplied() else number(self.done)

    def evaluate(self, kind: Kind) -> Outcome:
        """The losses of a fresh batch; nothing of it depends on the step but by what it is `handed`."""
        config, pool = self.config, self.pool
        self.model.widen(config.band, config.least_delta)
        rays = pool.draw(kind.rays, self.generator, self.sampler)
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
        self.sampler.learn(rays.row, wrong.detach())
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
        if self.measured is not None and kind.measured:
            depth = self.depth_term(self.measured, kind.level)
            terms["depth"] = depth
            total = total + config.depth_weight * depth
        terms["uncertainty"] = 1 / self.model.inv_std
        return Outcome(terms, total, sections)

    def depth_term(self, measured: MeasuredDepths, level: int) -> Tensor:
        """How far the surface is from what was measured: the mean of `depth_loss` over rays at random."""
        rays = measured.draw(self.schedule.depth_rays, self.generator)
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(rays.origins, rays.directions, rays.view)
            rays = rays._replace(origins=origins, directions=directions)
        missed = depth_loss(self.model.geometry, rays, level=level, generator=self.generator)
        left = self.by_time(lambda done: max(1 - done / self.schedule.faded, 0.0))
        return torch.where(rays.exact, missed, left * missed).mean()


CHOICES = ("sections", "colors", "outside")


@dataclass(frozen=True)
class Capacity:
    """How many rows a recorded step has room for: for n requested, ``spare`` n + ``more``, in multiples of ``step``."""

    spare: float = 1.25
    more: int = 64
    step: int = 256
    full: float = 0.95  # share of the capacity that may be requested before it is enlarged
    empty: float = 0.5  # share of the capacity below which a new one has to lie to replace it
    ray_counts: int = 8  # numbers of rays are multiples of this share of the most, 1 / ``ray_counts``

    def of(self, need: float) -> int:
        """Rows to reserve."""
        return self.step * math.ceil((self.spare * need + self.more) / self.step)

    def suits(self, room: int, need: float) -> bool:
        """Whether reserved rows are neither too few for what is requested now, nor far too many."""
        return need <= self.full * room and self.of(need) >= self.empty * room


# How many rows each of the CHOICES of a step has room for, and then each band; None for all.
Rooms = tuple[int, ...] | None


class ReplayedTrainer(Trainer[SceneObjective]):
    """A `Trainer` of a scene whose steps are replayed; ``recorder`` None is for CUDA's graphs.

    How many samples of rays are evaluated, lie in bands, and get colours differs from step to step, and a recorded step
    has a capacity for each. It follows, every sixteen steps, from the most that was requested in the last sixteen. A
    step whose request exceeds it is not taken: its gradient would leave something out.
    """

    capacity = Capacity()

    def __init__(self, objective: SceneObjective, *, recorder: Recorder | None = None, **others: Any) -> None:
        super().__init__(objective, **others)
        device = self.trained[0].device
        self.replays = Replays(device, recorder or CudaGraphs())
        for group in self.adam.param_groups:
            group["capturable"] = device.type == "cuda"
        # The most rows requested lately, of CHOICES and residual levels; and the number of steps not taken.
        self.peaks = torch.zeros(len(CHOICES) + len(objective.model.geometry.deltas) + 1, device=device)
        self.rooms: dict[Kind, tuple[int, ...]] = {}
        self.asked: dict[int, list[float]] = {}  # by the level that is on: what a ray asked for, at most
        self.left_out = 0

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """See `Trainer.restore`; what was recorded is forgotten, because it is about other memory."""
        super().restore(state)
        self.replays = Replays(self.replays.device, self.replays.recorder)

    def facts(self) -> dict[str, Any]:
        """Kinds of steps that were recorded, steps that were not taken, and why nothing is recorded, if so."""
        refused = {"refused": self.replays.refused} if self.replays.refused else {}
        return {"recorded": self.replays.recorded, "not_taken": self.left_out, **refused}

    def _step(self) -> dict[str, Tensor]:
        kind = self.objective.ahead(self.step, self.fraction)
        part = math.ceil(self.objective.config.rays / self.capacity.ray_counts)
        kind = kind._replace(rays=math.ceil(kind.rays / part) * part)
        rooms = self._rooms(kind)
        found = dict(self.replays.do((kind, rooms), lambda: self._work(kind, rooms)))
        # A replay changes parameters behind PyTorch's back; the fused kernels pack them again by their versions.
        torch.autograd.graph.increment_version(self.trained)
        sections = found.pop("sections")
        self.objective.behind(self.step, sections)
        self.step += 1
        if self.step % self.objective.schedule.near_every == 0:
            self._learn(kind)
        return found

    def _work(self, kind: Kind, rooms: Rooms) -> dict[str, Tensor]:
        """A step as the device does it."""
        objective = self.objective
        rates = handed(
            lambda: torch.tensor([rate(objective.done) for _, rate in objective.groups]), self.trained[0].device
        )
        for group, rate in zip(self.adam.param_groups, rates.unbind(), strict=True):
            group["lr"] = rate
        given = rooms or ()
        with fixed_shapes(given[len(CHOICES) :], rooms=dict(zip(CHOICES, given, strict=False))) as shapes:
            outcome = objective.evaluate(kind)
        with torch.no_grad():
            asked = self._asked(shapes)
            over = [asked[row] > room for row, room in enumerate(given)]
            lost = torch.stack(over).any().float() if over else asked.new_zeros(())
            self.peaks[: len(asked)] = torch.maximum(self.peaks[: len(asked)], asked)
            self.peaks[-1] += lost
        self.adam.found_inf = lost  # pyright: ignore[reportAttributeAccessIssue]  of a step that is not taken it is 1
        self.descend(outcome.total)
        terms = {name: term.detach() for name, term in outcome.terms.items()}
        return terms | {"sections": outcome.sections}

    def _asked(self, shapes: FixedShapes) -> Tensor:
        """How many rows were to be chosen, of `CHOICES` and in each band."""
        none = self.peaks.new_zeros(())
        bands = [*shapes.demand, *[none] * (len(self.peaks) - 1 - len(CHOICES) - len(shapes.demand))]
        return torch.stack([part.to(none) for part in [shapes.asked.get(name, none) for name in CHOICES] + bands])

    def _rooms(self, kind: Kind) -> Rooms:
        """The rooms of a kind of step: those that it has, as long as they hold the rows requested."""
        old, asked = self.rooms.get(kind), self.asked.get(kind.level)
        if asked is None:
            return old
        wanted = [kind.rays * each for each in asked]
        if old is None or not all(map(self.capacity.suits, old, wanted)):
            self.rooms[kind] = tuple(map(self.capacity.of, wanted))
        return self.rooms[kind]

    def _learn(self, kind: Kind) -> None:
        """Look at the rows requested in the last steps."""
        *peaks, lost = self.peaks.tolist()
        self.asked[kind.level] = [peak / kind.rays for peak in peaks]
        self.left_out += int(lost)
        self.peaks.zero_()


def scene_trainer(
    model: SceneModel,
    pool: RayPool,
    config: ReconstructConfig,
    *,
    measured: MeasuredDepths | None = None,
    seconds: float | None = None,
) -> Trainer[SceneObjective]:
    """The training of a scene; see `SceneObjective` and `Trainer`. On a GPU, it is replayed."""
    objective = SceneObjective(model, pool, config, measured)
    kind = ReplayedTrainer if config.graphs and pool.device.type == "cuda" else Trainer
    return kind(objective, stage="reconstruct", steps=config.steps, seconds=seconds, network_name="model")
