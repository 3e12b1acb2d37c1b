"""The loss of ``reconstruct``: rendered rays against photographs; levels join on schedule, bands follow 1/s."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...neural_fields import InputError
from ...neural_fields.backend.devices import graph_input, has_graph_inputs
from ...neural_fields.backend.fixed_shapes import FixedShapes, first_rows, fixed_shapes
from ...neural_fields.fields.losses import eikonal_loss
from ...neural_fields.networks.grids import ValueGrid, split_tables
from ...neural_fields.volume.render import Rendered, Sampling
from ..training.cuda_graphs import CudaGraphRecorder, GraphCache, Recorder
from ..training.settings import ReconstructConfig
from ..training.trainer import ErrorWeightedSampler, Group, Objective, Trainer, siren_groups, warm_cosine
from .consistency import (
    Cameras,
    ConsistencyOptions,
    GreyPictures,
    Pixels,
    Surface,
    consistency_loss,
    flatness_loss,
    surface_between,
)
from .measured import MeasuredDepths, depth_loss
from .model import RayPool, Rays, SceneModel


@dataclass(frozen=True)
class Schedule:
    """The schedule of the training of a scene. The values are this project's own."""

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
    strip: int = 16  # neighbouring pixels that share an error, at least
    strips: int = 1 << 20  # of them, at most; of more pixels each strip has more
    align_every: int = 64  # steps between two fits of scale and shift of depth maps to the surface
    faded: float = 0.5  # share of the training after which depths that were estimated from single pictures do not count


class Kind(NamedTuple):
    """The kind of a step: steps of one kind do the same operations."""

    rays: int  # how many there are
    level: int  # the finest that is switched on
    annealing: bool  # whether slopes are still annealed
    measured: bool  # whether measured depths count
    consistent: bool  # whether photographs are compared with each other


class Outcome(NamedTuple):
    """The losses of a step."""

    terms: dict[str, Tensor]  # of the loss, unweighted
    total: Tensor  # their weighted sum
    samples: Tensor  # evaluated per ray, 0-d


class SceneObjective(Objective):
    """Losses of a scene against the pixels of a pool and against measured depths, and of ``pictures`` by each other."""

    schedule, patches = Schedule(), ConsistencyOptions()

    def __init__(
        self,
        model: SceneModel,
        pool: RayPool,
        config: ReconstructConfig,
        measured: MeasuredDepths | None = None,
        pictures: GreyPictures | None = None,
    ) -> None:
        rate = warm_cosine(config.learning_rate)
        parts = [part for part in (model.color, model.outside, model.exposures) if part is not None]
        grid, colors = split_tables(*parts)
        groups = [
            *siren_groups(model.geometry, config.learning_rate, config.turn),
            Group(colors, lambda done: config.color_rate * rate(done)),
            Group([model.variance], lambda done: config.sharpening * rate(done)),
        ]
        if grid:
            groups.append(Group(grid, lambda done: config.grid_rate * config.color_rate * rate(done)))
        if model.poses is not None:  # not before there is something to be compared with
            plan = self.schedule
            late = [*model.poses.parameters()], lambda done: plan.pose_rate * rate(done) * (done > plan.poses_from)
            groups.append(Group(*late))
        super().__init__(model, groups, torch.Generator().manual_seed(config.seed))
        self.model, self.pool, self.config, self.pictures = model, pool, config, pictures
        self.sampling = Sampling(uniform=config.uniform, importance=config.importance)
        # Recent values, on the CPU, which reads them: samples evaluated per ray, and the surface's uncertainty.
        self.kept["lately"] = torch.tensor([0.0, 1 / float(model.inv_std.detach())])
        strip = max(self.schedule.strip, math.ceil(len(pool) / self.schedule.strips))
        self.sampler = ErrorWeightedSampler(len(pool), config.focus, pool.device, strip=strip)
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

    def refresh_grid(self, step: int, done: float) -> None:
        """Bring the SDF grid up to date: near the surface often, all of it now and then; see `Schedule`."""
        if self.grid is None:
            return
        plan = self.schedule
        self.grid.kept = self.kept["march"]  # that of a run which is resumed
        last, pause, count = self.kept["looks"].tolist()
        if step >= last + pause or not count:
            unsure = float(self.kept["lately"][1])
            cell = 2 * math.sqrt(3) / self.grid.resolution  # its diagonal: all corners beside the surface are that near
            self.grid.reach = min(max(plan.known * unsure, cell), max(plan.furthest, cell))
            whole = count % (plan.whole_every if done < plan.early else plan.whole_late) == 0
            self.grid.refresh(self.model.geometry, whole=whole)
            self.kept |= {"moved": self.grid.moved, "looks": torch.tensor([step, pause, count + 1])}

    def read_back(self, step: int, samples: Tensor) -> None:
        """Read what the next steps depend on from the device in one copy, which waits for a GPU."""
        unsure = 1 / self.model.inv_std.detach()
        shift = unsure if self.grid is None else self.kept["moved"]
        *lately, moved = torch.stack([samples, unsure.to(samples), shift.to(samples)]).tolist()
        if math.isnan(lately[1]):
            raise InputError(f"training diverged before step {step}; begin again with a lower --learning-rate")
        self.kept["lately"] = torch.tensor(lately)
        if self.grid is None:
            return
        last, pause, count = self.kept["looks"].tolist()
        plan = self.schedule
        if last > step - plan.near_every:  # since this was done last
            allowed = plan.moved * lately[1]
            pause = pause // 2 if moved > allowed else 2 * pause if moved < allowed / 2 else pause
            self.kept["looks"] = torch.tensor([last, min(max(pause, plan.near_every), plan.near_rest), count])

    def batch(self) -> int:
        """Rays of the next step: fewer while their samples are many, as they are while the surface is uncertain."""
        rays, jets = self.config.rays, self.config.jets
        if not jets:
            return rays
        samples = float(self.kept["lately"][0])
        return min(max(round(jets / samples) if samples else 0, math.ceil(self.schedule.least_rays * rays)), rays)

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`."""
        outcome = self.evaluate(self.before_step(step, done))
        self.after_step(step, outcome.samples)
        return outcome.terms, outcome.total

    def before_step(self, step: int, done: float) -> Kind:
        """Do the host's part of a step → the kind of the step."""
        self.done = done
        self.sampler.at_step(step, self.kept)
        self.refresh_grid(step, done)
        if (measured := self.measured) is not None:
            measured.affine = self.kept["affine"]  # that of a run which is resumed
            if measured.is_loose and done < self.schedule.faded and step % self.schedule.align_every == 0:
                measured.align(self.grid or (lambda x: self.model.geometry.value(x, level=0)))
                self.kept["affine"] = measured.affine
        return Kind(
            rays=self.batch(),
            level=self.level_at(done),
            annealing=done < self.config.anneal,
            measured=measured is not None and (done < self.schedule.faded or measured.is_exact),
            consistent=self.pictures is not None and done >= self.patches.start,
        )

    def after_step(self, step: int, samples: Tensor) -> None:
        """Do the host's part after a step; ``samples`` is the number evaluated per ray, 0-d."""
        if (step + 1) % self.schedule.near_every == 0:
            self.read_back(step, samples)

    def by_time(self, number: Callable[[float], float]) -> Tensor | float:
        """A number that depends on the share of the schedule that is done; a tensor in a CUDA graph."""
        device = self.pool.device
        return graph_input(lambda: torch.tensor(number(self.done)), device) if has_graph_inputs() else number(self.done)

    def evaluate(self, kind: Kind) -> Outcome:
        """The losses of a fresh batch; it depends on the step only through each `graph_input`."""
        config, pool = self.config, self.pool
        self.model.widen(config.band, config.least_delta)
        rays = pool.draw(kind.rays, self.generator, self.sampler)
        origins, directions = rays.origins, rays.directions
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(origins, directions, rays.view)
        skipped = {"alpha_threshold": config.skip, "skip_share": config.skip_share, "sdf_grid": self.grid}
        annealed = self.by_time(lambda done: done / config.anneal) if kind.annealing else 1.0
        rendered = self.model.render(
            origins, directions, self.sampling, cos_anneal=annealed, level=kind.level,
            early_stop_eps=config.least_weight, generator=self.generator, **skipped,
        )  # fmt: skip
        samples = (rendered.counts > 0).sum() / len(origins)
        target = rays.color
        if pool.has_masks:
            target = torch.lerp(self.model.background.expand_as(target), target, rays.mask[:, None])
        wrong = (self.model.photographed(rendered, rays.view) - target).abs().mean(dim=1)
        self.sampler.learn(rays.row, wrong.detach())
        color = wrong.mean()
        # A mean over all intervals within the region, skipped ones included: some kept ones count for them.
        within = (rendered.counts > 0).any(dim=1).sum().to(wrong).clamp(min=1) * rendered.counts.shape[1]
        eikonal = (rendered.counts * eikonal_loss(rendered.jet.gradient)).sum() / within
        terms = {"color": color, "eikonal": eikonal}
        total = color + config.eikonal_weight * eikonal
        if pool.has_masks and config.mask_weight:
            opacity = rendered.opacity.clamp(1e-3, 1 - 1e-3)
            # PyTorch's own stops a GPU for good where a training has diverged.
            terms["mask"] = mask = -torch.lerp((1 - opacity).log(), opacity.log(), rays.mask).mean()
            total = total + config.mask_weight * mask
        if self.measured is not None and kind.measured:
            depth = self.depth_term(self.measured, kind.level)
            terms["depth"] = depth
            total = total + config.depth_weight * depth
        if self.pictures is not None and kind.consistent:
            given = rays, (origins, directions), rendered
            terms["consistency"], terms["flatness"] = self.consistency_terms(self.pictures, *given, kind.level)
            total = total + config.consistency * (terms["consistency"] + self.patches.flatness * terms["flatness"])
        terms["uncertainty"] = 1 / self.model.inv_std
        return Outcome(terms, total, samples)

    def depth_term(self, measured: MeasuredDepths, level: int) -> Tensor:
        """The mean of `depth_loss` over random rays with measured depths."""
        rays = measured.draw(self.schedule.depth_rays, self.generator)
        if self.model.poses is not None:
            origins, directions = self.model.poses.moved(rays.origins, rays.directions, rays.view)
            rays = rays._replace(origins=origins, directions=directions)
        missed = depth_loss(self.model.geometry, rays, level=level, generator=self.generator)
        left = self.by_time(lambda done: max(1 - done / self.schedule.faded, 0.0))
        return torch.where(rays.exact, missed, left * missed).mean()

    def consistency_terms(
        self, pictures: GreyPictures, rays: Rays, lines: tuple[Tensor, Tensor], rendered: Rendered, level: int
    ) -> tuple[Tensor, Tensor]:
        """Means of `consistency_loss` and `flatness_loss` over the first rays that enter the surface.

        ``lines`` are the eyes and directions of the rays.
        """
        pool, poses, options = self.pool, self.model.poses, self.patches
        surface = surface_between(rendered, *lines, options)
        rows = first_rows(surface.found, min(options.patches, len(surface.found)))
        used, rows = rows < len(surface.found), rows.clamp(max=len(surface.found) - 1)
        surface = Surface(*(part[rows] for part in surface))
        surface = surface._replace(found=surface.found & used)
        cameras = Cameras(pool.eyes, pool.axes, pool.lens)
        if poses is not None:
            views = torch.arange(len(pool.eyes), device=pool.device).repeat_interleave(3)
            eyes, columns = poses.moved(pool.eyes[views], pool.axes.mT.reshape(-1, 3), views)
            cameras = Cameras(eyes[::3], columns.reshape(-1, 3, 3).mT, pool.lens)
        distance = self.grid or (lambda x: self.model.geometry.value(x, level=0))
        pixels = Pixels(*pool.places(rays.row[rows]))
        consistency = consistency_loss(surface, pixels, cameras, pictures, distance, options)
        seen = surface, pixels, cameras, pictures, options
        return consistency.mean(), flatness_loss(self.model.geometry, *seen, self.generator, level=level).mean()


CHOICES = ("samples", "colors", "outside")


@dataclass(frozen=True)
class Capacity:
    """Rows reserved for a recorded step: ``spare`` n + ``more`` for n requested, in multiples of ``step``."""

    spare: float = 1.25
    more: int = 64
    step: int = 256
    full: float = 0.95  # share of the capacity that may be requested before it is enlarged
    empty: float = 0.5  # share of the capacity below which a new one has to lie to replace it
    ray_counts: int = 8  # numbers of rays are multiples of this share of the most, 1 / ``ray_counts``

    def of(self, requested: float) -> int:
        """Rows to reserve."""
        return self.step * math.ceil((self.spare * requested + self.more) / self.step)

    def suits(self, capacity: int, requested: float) -> bool:
        """Whether the capacity is neither too small for the rows requested now, nor far too large."""
        return requested <= self.full * capacity and self.of(requested) >= self.empty * capacity


# The capacity of each of the CHOICES of a step, then of each band; None for all rows.
Capacities = tuple[int, ...] | None


class GraphTrainer(Trainer[SceneObjective]):
    """A `Trainer` of a scene whose steps are CUDA graphs, or what another ``recorder`` replays.

    How many samples of rays are evaluated, lie in bands, and get colours differs from step to step, and a recorded step
    has a capacity for each. It follows, every sixteen steps, from the most that was requested in the last sixteen. A
    step whose request exceeds it is not taken: its gradient would leave something out.
    """

    capacity = Capacity()

    def __init__(self, objective: SceneObjective, *, recorder: Recorder | None = None, **others: Any) -> None:
        super().__init__(objective, **others)
        device = self.trained[0].device
        self.graphs = GraphCache(device, recorder or CudaGraphRecorder())
        for group in self.adam.param_groups:
            group["capturable"] = device.type == "cuda"
        # The most rows requested lately, of CHOICES and residual levels; and the number of steps not taken.
        self.peaks = torch.zeros(len(CHOICES) + len(objective.model.geometry.deltas) + 1, device=device)
        self.capacities: dict[Kind, tuple[int, ...]] = {}
        self.requested: dict[int, list[float]] = {}  # by the finest level switched on: rows per ray, at most
        self.not_taken = 0

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """See `Trainer.restore`; recorded graphs are dropped, because they use other memory."""
        super().restore(state)
        self.graphs = GraphCache(self.graphs.device, self.graphs.recorder)

    def facts(self) -> dict[str, Any]:
        """Kinds of steps that were recorded, steps that were not taken, and why nothing is recorded, if so."""
        refused = {"refused": self.graphs.refused} if self.graphs.refused else {}
        return {"recorded": self.graphs.recorded, "not_taken": self.not_taken, **refused}

    def _step(self) -> dict[str, Tensor]:
        kind = self.objective.before_step(self.step, self.fraction)
        part = math.ceil(self.objective.config.rays / self.capacity.ray_counts)
        kind = kind._replace(rays=math.ceil(kind.rays / part) * part)
        capacities = self._capacities(kind)
        terms = dict(self.graphs.run((kind, capacities), lambda: self._work(kind, capacities)))
        # A replay changes parameters behind PyTorch's back; the fused kernels pack them again by their versions.
        torch.autograd.graph.increment_version(self.trained)
        self.objective.after_step(self.step, terms.pop("samples"))
        self.step += 1
        if self.step % self.objective.schedule.near_every == 0:
            self._read_requested(kind)
        return terms

    def _work(self, kind: Kind, capacities: Capacities) -> dict[str, Tensor]:
        """The device's part of a step."""
        objective = self.objective
        groups = [group for optimiser in self.optimisers.values() for group in optimiser.param_groups]
        rates = graph_input(
            lambda: torch.tensor([group["rate"](objective.done) for group in groups]), self.trained[0].device
        )
        for group, rate in zip(groups, rates.unbind(), strict=True):
            group["lr"] = rate
        given = capacities or ()
        with fixed_shapes(given[len(CHOICES) :], named_capacity=dict(zip(CHOICES, given, strict=False))) as shapes:
            outcome = objective.evaluate(kind)
        with torch.no_grad():
            requested = self._requested(shapes)
            over = [requested[row] > capacity for row, capacity in enumerate(given)]
            overflow = torch.stack(over).any().float() if over else requested.new_zeros(())
            self.peaks[: len(requested)] = torch.maximum(self.peaks[: len(requested)], requested)
            self.peaks[-1] += overflow
        for optimiser in self.optimisers.values():  # of a step that is not taken it is 1
            optimiser.found_inf = overflow  # pyright: ignore[reportAttributeAccessIssue]
        self.descend(outcome.total)
        return {name: term.detach() for name, term in outcome.terms.items()} | {"samples": outcome.samples}

    def _requested(self, shapes: FixedShapes) -> Tensor:
        """How many rows were to be chosen, of `CHOICES` and in each band."""
        none = self.peaks.new_zeros(())
        bands = [*shapes.requested, *[none] * (len(self.peaks) - 1 - len(CHOICES) - len(shapes.requested))]
        named = [shapes.named_requested.get(name, none) for name in CHOICES]
        return torch.stack([part.to(none) for part in named + bands])

    def _capacities(self, kind: Kind) -> Capacities:
        """The capacities of a kind of step: the present ones, as long as they suit the rows requested."""
        old, per_ray = self.capacities.get(kind), self.requested.get(kind.level)
        if per_ray is None:
            return old
        requested = [kind.rays * each for each in per_ray]
        if old is None or not all(map(self.capacity.suits, old, requested)):
            self.capacities[kind] = tuple(map(self.capacity.of, requested))
        return self.capacities[kind]

    def _read_requested(self, kind: Kind) -> None:
        """Read from the device how many rows the last steps requested."""
        *peaks, overflows = self.peaks.tolist()
        self.requested[kind.level] = [peak / kind.rays for peak in peaks]
        self.not_taken += int(overflows)
        self.peaks.zero_()


def scene_trainer(
    model: SceneModel,
    pool: RayPool,
    config: ReconstructConfig,
    *,
    measured: MeasuredDepths | None = None,
    pictures: GreyPictures | None = None,
    seconds: float | None = None,
) -> Trainer[SceneObjective]:
    """The training of a scene; see `SceneObjective` and `Trainer`. On a GPU its steps are CUDA graphs."""
    objective = SceneObjective(model, pool, config, measured, pictures)
    kind = GraphTrainer if config.graphs and pool.device.type == "cuda" else Trainer
    return kind(objective, stage="reconstruct", steps=config.steps, seconds=seconds, network_name="model")
