"""A morph by a velocity that takes each key shape to the next, and carries what lies in between.

A level set knows no correspondence. Here a velocity v(x, t) is learnt first, whose characteristics φ minimise

    L = Σ_k |f_{k+1}(φ_{k→k+1}(x))|² over x on S_k, and |f_k(φ_{k+1→k}(x))|² over x on S_{k+1}      both ends are met
      + w(step) Σ |φ(x) − T(x)|²                                                  a guide, which fades
      + l Σ |φ(a) − b|²                                                           landmarks, where there are any
      + α ‖J + Jᵀ‖² / 2 + β (tr J)²                                         as rigid, as even in volume as can be

along all paths. The guide T matches points by entropic optimal transport of places, normals and values nearby.
`CarriedKeyframes` then is the shape at any time, and what the field of space-time learns. After Sang et al. 2025
("Implicit Neural Surface Deformation with Explicit Velocity Fields", and "4Deform"), who learn both together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import huber_loss, normalize, pad

from ...neural_fields import Field, at_time, flow
from ...neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from ..training.progress import Report
from ..training.scaffold import BUDGET, Budget
from ..training.settings import EvolveConfig
from ..training.trainer import Group, Objective, Trainer, seeded, warm_cosine
from .samples import Bounds, Known, around, joined, known_at, uniform
from .shapes import Landmarks, StaticShape, nearness, placed_landmarks


@dataclass(frozen=True)
class MotionOptions:
    """Numbers of the motion's training; lengths are in units of the field."""

    pool: int = 20_000  # points of each shape
    matched: int = 1000  # of them, which the guide has partners for
    steps: int = 8  # of the midpoint rule between two keys, while it is learnt
    guided: int = 256  # points with a partner, per end and step of the training
    loose: int = 512  # others, likewise
    regular: int = 1024  # places at which the regularity is evaluated, per step
    around: float = 0.05  # how far these are from the paths
    fades: float = 0.6  # share of the steps after which the guide is gone
    far: float = 0.1  # residuals count linearly from here on, so that points without a partner do not dominate
    data: float = 20.0  # weight of the ends
    inside: float = 0.98  # radius that no path should leave
    normals: float = 0.1  # cost of a pair with opposite normals, beside its squared distance
    surroundings: float = 0.06  # cost of a pair with other surroundings
    marked: float = 4.0  # weight of the squared differences of nearness to landmarks
    depths: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3)  # at which the surroundings are compared, inward and outward
    blur: float = 0.1  # first blur of the optimal transport, squared length
    least_blur: float = 0.003  # the last one
    cooling: float = 0.93  # factor of the blur, per round
    rounds: int = 100  # of Sinkhorn's iterations
    left: float = 5.0  # cost of mass without a partner; above 2², or the rear of a shape that travelled stays behind
    newton: int = 2  # steps to f = 0 of points that were carried
    share: float = 0.3  # of a time budget, for learning the motion
    rows: int = 8192  # points per call


MOTION = MotionOptions()


def match(
    first: StaticShape, second: StaticShape, seed: int, landmarks: Landmarks | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points of two shapes, and where the guide wants them on the other one, ``(M, 3)`` each: x, T(x), y, T(y).

    Unbalanced entropic optimal transport (Sinkhorn's iterations in logarithms, Chizat et al. 2018) with a cooling blur;
    T is the mean of what a point is matched with. Landmarks make points near one prefer points near its partner.
    """
    (x, n, a), (y, m, b) = [_surroundings(shape, seed + index) for index, shape in enumerate((first, second))]
    cost = torch.cdist(x, y).square() + MOTION.normals / 2 * (1 - n @ m.T)
    cost = cost + MOTION.surroundings * torch.cdist(a, b).square() / a.shape[1]
    if landmarks is not None and len(landmarks.before):
        cost = cost + MOTION.marked * torch.cdist(nearness(x, landmarks.before), nearness(y, landmarks.after)).square()
    rows, columns, blur = torch.zeros(len(x)), torch.zeros(len(y)), MOTION.blur
    for step in range(MOTION.rounds):
        blur = max(MOTION.least_blur, MOTION.blur * MOTION.cooling**step)
        damped = -blur * MOTION.left / (MOTION.left + blur)
        rows = damped * (torch.logsumexp((columns - cost) / blur, dim=1) - math.log(len(y)))
        columns = damped * (torch.logsumexp((rows[:, None] - cost) / blur, dim=0) - math.log(len(x)))
    plan = (rows[:, None] + columns - cost) / blur
    return x, torch.softmax(plan, dim=1) @ y, y, torch.softmax(plan, dim=0).T @ x


@torch.no_grad()
def _surroundings(shape: StaticShape, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points, normals, and ``(M, 8)`` of what the field says inward and outward, over what a plane would: 1."""
    points = shape.points(MOTION.matched, seed)
    normals = normalize(shape.field.jet(points).gradient, dim=-1)
    ways = [sign * depth for depth in MOTION.depths for sign in (-1.0, 1.0)]
    said = [shape.field.value(points + way * normals) / way for way in ways]
    return points, normals, torch.stack(said, dim=1)


class MotionObjective(Objective):
    """The loss of a ``velocity`` between ``shapes`` in one frame, at the times ``keys``; see the module."""

    def __init__(
        self,
        velocity: VelocitySiren,
        shapes: Sequence[StaticShape],
        keys: Sequence[float],
        config: EvolveConfig,
        generator: torch.Generator,
    ) -> None:
        super().__init__(velocity, [Group(list(velocity.parameters()), warm_cosine(config.motion_rate))], generator)
        self.velocity, self.shapes, self.keys, self.config = velocity, shapes, keys, config
        self.pools = [shape.points(MOTION.pool, config.seed + index) for index, shape in enumerate(shapes)]
        self.landmarks = placed_landmarks(config.landmarks, shapes)
        pairs = zip(itertools.pairwise(shapes), self.landmarks, strict=True)
        self.guides = [match(*pair, config.seed + 17 * index, own) for index, (pair, own) in enumerate(pairs)]

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Tensor]:
        """See `Objective.losses`; one interval between two keys in each step."""
        config, before = self.config, step % len(self.guides)
        x, wanted_x, y, wanted_y = self.guides[before]
        own = self.landmarks[before]
        marked = self._draw(len(own.before), min(len(own.before), MOTION.guided))
        here, there = own.before[marked], own.after[marked]
        ends = ((before, before + 1, x, wanted_x, here, there), (before + 1, before, y, wanted_y, there, here))
        met, guided, places, times, missed = [], [], [], [], [x.new_zeros(())]
        for start, end, points, wanted, leaves, arrives in ends:
            chosen, pool = self._draw(len(points), MOTION.guided), self.pools[start]
            begun = torch.cat((points[chosen], pool[self._draw(len(pool), MOTION.loose)], leaves))
            path, when = self._path(begun, self.keys[start], self.keys[end])
            left = self.shapes[end].field.value(path[-1][: MOTION.guided + MOTION.loose])
            if len(leaves):
                missed.append((path[-1][MOTION.guided + MOTION.loose :] - arrives).square().sum(dim=1).mean())
            met.append(huber_loss(left, torch.zeros_like(left), delta=MOTION.far))
            guided.append((path[-1][: MOTION.guided] - wanted[chosen]).square().sum(dim=1).mean())
            places.append(path.reshape(-1, 3))
            times.append(when[:, None].expand(path.shape[:2]).reshape(-1))
        x, t = torch.cat(places), torch.cat(times)
        beyond = (x.norm(dim=1) - MOTION.inside).clamp(min=0).square().mean()
        chosen = self._draw(len(x), MOTION.regular)
        aside = MOTION.around * torch.randn(MOTION.regular, 3, generator=self.generator)
        jet = self.velocity.jet(x[chosen].detach() + aside, t[chosen])
        terms = {
            "ends": met[0] + met[1],
            "guide": guided[0] + guided[1],
            "landmarks": torch.stack(missed).sum(),
            "rigid": jet.killing.mean() / 2,
            "volume": jet.divergence.square().mean(),
            "steady": jet.rate.square().sum(dim=1).mean(),
        }
        guide_weight = config.guide_weight * max(0.0, 1 - done / MOTION.fades)
        total = MOTION.data / 2 * terms["ends"] + guide_weight * terms["guide"]
        total = total + config.rigid_weight * terms["rigid"] + config.volume_weight * terms["volume"]
        total = total + config.landmark_weight * terms["landmarks"]
        return terms, total + 1e-3 * terms["steady"] + MOTION.data * beyond

    def _path(self, points: Tensor, start: float, end: float) -> tuple[Tensor, Tensor]:
        """Places ``(S + 1, N, 3)`` by the midpoint rule, and times ``(S + 1,)``."""
        step, path = (end - start) / MOTION.steps, [points]
        for index in range(MOTION.steps):
            time = points.new_full((), start + index * step)
            half = path[-1] + step / 2 * self.velocity(path[-1], time)
            path.append(path[-1] + step * self.velocity(half, time + step / 2))
        return torch.stack(path), torch.linspace(start, end, MOTION.steps + 1)

    def _draw(self, count: int, wanted: int) -> Tensor:
        return torch.randint(max(count, 1), (wanted,), generator=self.generator)


def learn_motion(
    shapes: Sequence[StaticShape],
    keys: Sequence[float],
    config: EvolveConfig,
    progress: Report | None = None,
    *,
    budget: Budget | None = None,
) -> VelocitySiren:
    """A velocity that takes each of the shapes to the next one, on the CPU.

    Of a time ``budget`` it takes `MotionOptions.share` at most.
    """
    with seeded(config.seed):
        velocity = VelocitySiren(config.motion_width, 2, omega=config.motion_omega)
    generator = torch.Generator().manual_seed(config.seed * 1009 + 71)
    for shape in shapes:
        shape.field.requires_grad_(False)
    objective = MotionObjective(velocity, shapes, keys, config, generator)
    left = None if budget is None else budget.left()
    seconds = None if left is None else max(MOTION.share * left, BUDGET.least_seconds)
    trainer = Trainer(objective, stage="motion", steps=config.motion_steps * (len(keys) - 1), seconds=seconds)
    trainer.run(report=progress)
    if budget is not None and trainer.ended_early:
        budget.notes.append(f"{trainer.step} steps of the motion instead of {trainer.steps}")
    return velocity.requires_grad_(False)


def carried_samples(
    carried: CarriedKeyframes, shapes: Sequence[StaticShape], count: int, seed: int
) -> tuple[Known, Bounds]:
    """Where shapes on their way are, and on which side of them other places lie.

    About half of the known samples are the shapes themselves at their times, with their values; the others are points
    carried to any time and moved to f = 0, with unit normals. Bounds are signs, as values in between are no distances.
    """
    generator, keys = torch.Generator().manual_seed(seed), carried.keys.times
    each = -(-count // (2 * len(shapes)))
    known = [known_at(shape, key, each, seed, generator) for shape, key in zip(shapes, keys, strict=True)]
    sides: list[Tensor] = []
    for index, shape in enumerate(shapes):
        first, last = keys[max(index - 1, 0)], keys[min(index + 1, len(keys) - 1)]
        t = first + (last - first) * torch.rand(each, generator=generator)
        begun = around(shape, each, seed + 31 + index, generator)
        begun = torch.cat((shape.points(each, seed + 57 + index), begun))
        parts = zip(begun.split(MOTION.rows), t.repeat(2).split(MOTION.rows), strict=True)
        x = torch.cat([flow(carried.velocity, part, keys[index], end) for part, end in parts])
        known.append(_on_surface(carried, at_time(x[:each], t)))
        sides.append(at_time(x[each:], t))
    anywhere = at_time(uniform(count // 2, generator), torch.rand(count // 2, generator=generator))
    points = torch.cat((*sides, anywhere))
    with torch.no_grad():
        value = torch.cat([carried.value(part) for part in points.split(MOTION.rows)])
    sure = value.abs() > 1e-3
    positive = value[sure] > 0
    low, high = torch.where(positive, 0.0, -math.inf), torch.where(positive, math.inf, 0.0)
    return joined(known), Bounds(points[sure], low, high)


def _on_surface(carried: Field, points: Tensor) -> Known:
    """Those of the points that Newton's steps along ∇f bring to f = 0, with value 0 and unit normals."""
    found = []
    for part in points.split(MOTION.rows):
        here = part
        for _ in range(MOTION.newton):
            value, gradient, _ = carried.jet(here)
            slope = gradient[:, :3].square().sum(dim=1).clamp(min=0.25)
            here = here - pad((value / slope).clamp(-MOTION.far, MOTION.far)[:, None] * gradient[:, :3], (0, 1))
        value, gradient, _ = carried.jet(here)
        arrived = (value.abs() < 1e-3) & (gradient[:, :3].norm(dim=1) > 0.2)
        normals = normalize(gradient[:, :3], dim=1)
        found.append(Known(here[arrived], torch.zeros(int(arrived.sum())), normals[arrived]))
    return joined(found)


@torch.no_grad()
def motion_figures(
    velocity: VelocitySiren, shapes: Sequence[StaticShape], keys: Sequence[float]
) -> list[dict[str, float]]:
    """Of each way from a key to the next: rms and largest |f| where it ends, and how rigid and even it is."""
    figures = []
    for index, (start, end) in enumerate(itertools.pairwise(keys)):
        points = shapes[index].points(5000, 7)
        there = flow(velocity, points, start, end)
        middle = flow(velocity, points, start, (start + end) / 2)
        left = shapes[index + 1].field.value(there)
        jet = velocity.jet(middle, middle.new_full((), (start + end) / 2))
        figures.append(
            {
                "from": start,
                "to": end,
                "rms_at_end": float(left.square().mean().sqrt()),
                "max_at_end": float(left.abs().max()),
                "mean_way": float((there - points).norm(dim=1).mean()),
                "killing": float(jet.killing.mean()),
                "divergence_rms": float(jet.divergence.square().mean().sqrt()),
            }
        )
    return figures
