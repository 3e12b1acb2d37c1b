"""What ``evolve`` trains: known samples of space-time, bounds, and the law in between, for each kind of evolution."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...neural_fields import InputError, RigidMotion, Similarity, at_time, flow
from ...neural_fields.spacetime.evolution import Law, VectorField, mean_curvature, morph, transport
from ...neural_fields.spacetime.flow import IntegrationError, trajectories
from ...neural_fields.spacetime.moving import Keyframes
from ...neural_fields.spacetime.velocity import CarriedKeyframes, VelocitySiren
from ..training.progress import Report
from ..training.scaffold import BUDGET, Budget, affordable
from ..training.settings import EvolveConfig
from .deform import carried_samples, learn_motion, motion_figures
from .samples import Bounds, Carried, Known, around, joined, known_at, signs, uniform, values_at
from .shapes import Placement, StaticShape, aligned, into_unit_sphere

END_POINTS = 50_000  # on a surface that shall be met
REACH_POINTS = 2000
# Fitted fields are distances only about so far from their surfaces; a bound from them is taken for so much less.
CAUTION = 0.8


@dataclass(frozen=True, eq=False)
class End:
    """A surface that shall be met."""

    name: str  # of the shape
    time: float
    points: Tensor  # (N, 3) on it
    others: Tensor  # (N, 3) on it too, drawn independently


@dataclass(frozen=True, eq=False)
class Problem:
    """An evolution to be learnt, in unit-sphere coordinates."""

    similarity: Similarity  # from the first shape's input coordinates
    known: Known  # where the field is known; some of it at time 0
    bounds: Bounds  # where bounds are; may be empty
    law: Law | None  # what holds in between, or None where enough is known
    ends: tuple[End, ...]  # the surfaces to be met
    placements: tuple[Placement, ...] = ()  # where each shape was put, from its own unit sphere
    motion: VelocitySiren | None = None  # the velocity that carries the shapes, where one was learnt
    motion_figures: tuple[Mapping[str, float], ...] = ()  # how well it does that, for each two shapes
    # moments between which the law moves one shape to the next; its error is taken per interval
    keys: tuple[float, ...] = (0.0, 1.0)
    samples: int | None = None  # known samples that were made; fewer than the settings' for want of time


def build_problem(
    shapes: Sequence[StaticShape],
    config: EvolveConfig,
    *,
    motion: VelocitySiren | None = None,
    progress: Report | None = None,
    budget: Budget | None = None,
) -> Problem:
    """The problem that a configuration means, of shapes each in its own unit sphere.

    The ``motion`` of a deformation is learnt if it is not given. It and the known samples get a share of the
    ``budget``.

    Raises:
        InputError: too few or too many shapes for this kind, or a motion that cannot be followed.
    """
    counts = {"morph": (2, math.inf), "deform": (2, math.inf), "transport": (1, math.inf), "smooth": (1, 1)}
    least, most = counts[config.kind]
    if not least <= len(shapes) <= most:
        expected = f"{least}" if least == most else f"at least {least}"
        raise InputError(f"{len(shapes)} shapes for kind {config.kind}; expected {expected}")
    if config.kind == "deform":
        return _deform(list(shapes), config, motion, progress, budget)
    build = {"morph": _morph, "transport": _transport, "smooth": _smooth}[config.kind]
    try:
        return build(list(shapes), config, budget)
    except IntegrationError as error:
        raise InputError(
            f"the motion cannot be followed ({error}); use a smaller --angle, --twist or --velocity"
        ) from error


def between(times: Tensor, keys: Sequence[float], values: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds ``(N,)``, below and above, on a field whose surface stays between two shapes; ±∞ for none.

    What is outside both is at least as far from the surface as from the nearer of them, and inside both likewise: ``f ≥
    min(f_k, f_{k+1})`` where both are positive, ``f ≤ max(f_k, f_{k+1})`` where both are negative. ``values`` ``(N,
    K)`` are the shapes' distances, ``keys`` the increasing times of the shapes.
    """
    inner = torch.tensor(keys[1:-1], dtype=times.dtype, device=times.device)
    before = torch.bucketize(times, inner)[:, None]
    pair = torch.cat((values.gather(1, before), values.gather(1, before + 1)), dim=1)
    nearer, deeper = pair.amin(dim=1), pair.amax(dim=1)
    low = torch.where(nearer > 0, nearer, -math.inf)
    return low, torch.where(deeper < 0, deeper, math.inf)


def velocity_field(motion: RigidMotion, twist: float = 0.0) -> VectorField:
    """The velocity of a rigid motion, whose angular velocity may grow by ``twist`` per unit along its axis."""
    if not twist:
        return motion.velocity

    def velocity(x: Tensor, t: Tensor) -> Tensor:
        time = torch.as_tensor(t, dtype=x.dtype, device=x.device)
        axis = x.new_tensor(motion.axis)
        from_center = x - x.new_tensor(motion.center) - x.new_tensor(motion.drift) * time[..., None]
        along = (from_center * axis).sum(dim=-1, keepdim=True)
        turned = torch.linalg.cross(axis.expand(x.shape), from_center)
        return motion.velocity(x, t) + twist * along * turned

    return velocity


def _deform(
    shapes: list[StaticShape],
    config: EvolveConfig,
    motion: VelocitySiren | None,
    progress: Report | None,
    budget: Budget | None,
) -> Problem:
    placed, region = _together(shapes, config)
    keys = config.key_times()
    motion = motion or learn_motion(placed, keys, config, progress, budget=budget)
    carried = CarriedKeyframes(Keyframes(keys, [shape.field for shape in placed]), motion)
    known, bounds, number = _sampled(lambda count: carried_samples(carried, placed, count, config.seed), config, budget)
    ends = tuple(_end(shape, time, config.seed) for shape, time in zip(placed, keys, strict=True))
    similarity, figures = _composed(shapes[0].similarity, region), tuple(motion_figures(motion, placed, keys))
    return Problem(similarity, known, bounds, None, ends, _placements(placed), motion, figures, samples=number)


def _together(shapes: list[StaticShape], config: EvolveConfig) -> tuple[list[StaticShape], Similarity]:
    """Shapes aligned in one frame, and into the unit sphere of all."""
    placed = aligned(shapes, config.align)
    return into_unit_sphere(placed, np.concatenate([shape.surface.vertices for shape in placed]))


def _morph(shapes: list[StaticShape], config: EvolveConfig, budget: Budget | None) -> Problem:
    placed, region = _together(shapes, config)
    keys = config.key_times()
    pairs = list(zip(placed, keys, strict=True))

    def samples(count: int) -> tuple[Known, Bounds]:
        generator, per_shape = torch.Generator().manual_seed(config.seed), -(-count // len(placed))
        known = [known_at(shape, time, per_shape, config.seed, generator) for shape, time in pairs]
        x, t = uniform(count, generator), torch.rand(count, generator=generator)
        low, high = between(t, keys, torch.stack([values_at(shape.field, x) for shape in placed], dim=1))
        bounded = torch.isfinite(low) | torch.isfinite(high)
        return joined(known), Bounds(at_time(x, t)[bounded], CAUTION * low[bounded], CAUTION * high[bounded])

    known, bounds, number = _sampled(samples, config, budget)
    guide = Keyframes(keys, [shape.field for shape in placed]).requires_grad_(False)
    ends = tuple(_end(shape, time, config.seed) for shape, time in pairs)
    similarity = _composed(shapes[0].similarity, region)
    law, places = morph(guide, extend=True), _placements(placed)
    return Problem(similarity, known, bounds, law, ends, places, keys=keys, samples=number)


def _smooth(shapes: list[StaticShape], config: EvolveConfig, budget: Budget | None) -> Problem:
    placed, region = into_unit_sphere(shapes, shapes[0].surface.vertices)
    (shape,), alpha = placed, config.alpha / region.scale**2
    squared = float((shape.surface.vertices**2).sum(axis=1).max())

    def samples(count: int) -> tuple[Known, Bounds]:
        generator = torch.Generator().manual_seed(config.seed)
        known = known_at(shape, 0.0, count, config.seed, generator)
        # What is inside a sphere stays inside it while both shrink.
        x, t = uniform(count, generator), torch.rand(count, generator=generator)
        beyond = x.norm(dim=1) - (squared - 4 * max(alpha, 0.0) * t).clamp(min=0).sqrt()
        outside = (beyond > 0) & (alpha > 0)
        low = CAUTION * beyond[outside]
        return known, Bounds(at_time(x, t)[outside], low, torch.full_like(low, math.inf))

    known, bounds, number = _sampled(samples, config, budget)
    end = _end(shape, 0.0, config.seed)
    law = mean_curvature(alpha, extend=True)
    similarity, places = _composed(shape.similarity, region), _placements(placed)
    return Problem(similarity, known, bounds, law, (end,), places, samples=number)


def _transport(shapes: list[StaticShape], config: EvolveConfig, budget: Budget | None) -> Problem:
    shapes, times = aligned(shapes, "none"), [index / 8 for index in range(9)]
    reach = [
        trajectories(_velocity(config, index, Similarity.identity()), shape.points(REACH_POINTS, 0), times)
        for index, shape in enumerate(shapes)
    ]
    placed, region = into_unit_sphere(shapes, torch.cat(reach).reshape(-1, 3).double().numpy())
    velocities = [_velocity(config, index, region) for index in range(len(placed))]
    carried = Carried([shape.field for shape in placed], velocities)
    rigid = not any(config.twist)

    def samples(count: int) -> tuple[Known, Bounds]:
        generator, each = torch.Generator().manual_seed(config.seed), -(-count // len(placed))
        points = []
        for index, (shape, velocity) in enumerate(zip(placed, velocities, strict=True)):
            y = around(shape, each, config.seed + index, generator)
            # A quarter of the known samples is at the first moment.
            t = torch.rand(each, generator=generator) * (torch.rand(each, generator=generator) > 0.25)
            points.append(at_time(flow(velocity, y, 0.0, t), t))
        known = carried.samples(torch.cat(points))
        return (known, Bounds(torch.empty(0, 4), torch.empty(0), torch.empty(0))) if rigid else signs(known)

    known, bounds, number = _sampled(samples, config, budget)
    law = transport(velocities[0], extend=not rigid) if len(placed) == 1 else None
    name = " + ".join(shape.name for shape in shapes)
    ends = tuple(
        End(name, time, *(carried.surface(placed, time, END_POINTS, seed) for seed in (0, 1))) for time in (0.0, 1.0)
    )
    similarity, places = _composed(shapes[0].similarity, region), _placements(placed)
    return Problem(similarity, known, bounds, law, ends, places, samples=number)


def _sampled(
    samples: Callable[[int], tuple[Known, Bounds]], config: EvolveConfig, budget: Budget | None
) -> tuple[Known, Bounds, int]:
    """Known samples and bounds, and their number: the settings', or what a time budget leaves time for."""
    count, left = config.samples, None if budget is None else budget.left()
    if budget is not None and left is not None:
        count = affordable(samples, config.samples, BUDGET.sampling_share * left)
        if count < config.samples:
            budget.notes.append(f"{count:,} known samples instead of {config.samples:,}")
    return *samples(count), count


def _velocity(config: EvolveConfig, index: int, region: Similarity) -> VectorField:
    """The vector field of one shape, in the coordinates of the region."""
    axis, center, drift = ([*config.per_shape(name, index)] for name in ("axis", "center", "velocity"))
    center = region.to_unit(np.array(center)).tolist()
    motion = RigidMotion(
        axis=(axis[0], axis[1], axis[2]),
        angle=config.per_shape("angle", index)[0],
        center=(center[0], center[1], center[2]),
        velocity=(drift[0] / region.scale, drift[1] / region.scale, drift[2] / region.scale),
    )
    return velocity_field(motion, config.per_shape("twist", index)[0] * region.scale)


def _end(shape: StaticShape, time: float, seed: int) -> End:
    return End(shape.name, time, *(shape.points(END_POINTS, seed + 101 + index) for index in range(2)))


def _placements(shapes: Sequence[StaticShape]) -> tuple[Placement, ...]:
    return tuple(shape.placement for shape in shapes)


def _composed(first: Similarity, region: Similarity) -> Similarity:
    """From input coordinates through the first shape's unit sphere to the region's."""
    center = first.to_input(np.asarray(region.center))
    return Similarity((float(center[0]), float(center[1]), float(center[2])), first.scale * region.scale)
