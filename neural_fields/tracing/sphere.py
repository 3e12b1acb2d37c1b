"""Sphere tracing of any field, with coarse levels leading fine ones (paper Sec. 3 and suppl. "Rendering").

Let v = |f(p)| at a point of a ray. A ball around p of radius r = (v − δ_j) / L holds no zero of f. Here δ_j is the
half-width of the first band that v is not inside of (0 inside all of them), and L the Lipschitz constant. Outside band
j the value is that of level j, and the surface lies where |f_j| < δ_j: one rule serves all levels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..backend.devices import makes_wait
from ..backend.errors import positive
from ..fields.field import Field, FieldLike, as_field
from ..fields.similarity import ball_chord
from ..networks.colors import TextureField
from ..networks.multiscale import as_levels, choose_levels, levels_of
from ._march import (
    BAND_ENTRY,
    BOLDNESS,
    FLOOR,
    PATIENCE,
    STEEPEST_RISE,
    Expected,
    Near,
    RayHits,
    Rays,
    Rule,
    march,
    march_budget,
)
from ._march_gpu import march_ahead

BOUNDING_RADIUS = 1.05  # of surfaces; fields live in the unit sphere, which they may pass a little
MAX_STEPS = 512  # evaluations of a ray after which it ends as a miss


class Hits(NamedTuple):
    """Intersections of rays with a surface.

    Attributes:
        mask: ``(...,)`` bool, whether the ray meets it.
        depth: ``(...,)`` along the ray, in lengths of its direction; for a ray that misses, where its search ended.
        position: ``(..., 3)`` the point at that depth, origin + depth · direction.
        level: ``(...,)`` int64, the finest level that was part of the last value.
        steps: ``(...,)`` int64, evaluations of the field on the ray.
    """

    mask: Tensor
    depth: Tensor
    position: Tensor
    level: Tensor
    steps: Tensor


def sphere_trace(
    field: FieldLike,
    origins: Tensor,
    directions: Tensor,
    *,
    level: int = -1,
    near: Tensor | float = 0.0,
    far: Tensor | float = torch.inf,
    tolerance: float = 1e-5,
    resolution: float = 1e-4,
    lipschitz: float = 1.0,
    radius: float | None = BOUNDING_RADIUS,
    max_steps: int = MAX_STEPS,
    budget: Sequence[int] | None = None,
    capture: float = 2e-3,
    differentiable: bool = False,
) -> Hits:
    """First intersections of rays with the zero set of a level.

    The default mode runs until every depth is known to ``tolerance``. Steps are the widest that leave no gap between
    the balls around two samples if the surface is a plane (Bálint and Valasek 2018); where a gap opens, the step is
    taken back. The resolution doubles after every 16 steps of a ray. A change of sign is closed in on by the secant
    rule and bisection in turn. A ray that starts inside the surface is traced to its exit.

    With a ``budget``, the paper's mode: that many steps ``t ← t + f_j − δ_j`` on each level (20, 5, 5 in its Tab. 4),
    after which |f| < ``capture`` is a hit.

    With ``differentiable``, depth and position carry the derivatives of the implicit function f(o + t d) = 0 with
    respect to origins, directions and parameters: dt = −(df + ⟨∇f, do + t dd⟩) / ⟨∇f, d⟩. They grow without bound where
    rays graze.

    Args:
        field: what to trace, three-dimensional; or any function of points ``(..., 3)`` → ``(...,)``.
        origins: ``(..., 3)``.
        directions: ``(..., 3)`` of any length but 0; broadcast with ``origins``.
        level: whose surface to find.
        near: depth at which to start, a number or a tensor that broadcasts to ``(...,)``, see `cone_starts`. A ray that
            is behind the surface there starts from the beginning instead.
        far: depth at which to stop.
        tolerance: of the depth, in the field's units; limited by the precision of the numbers.
        resolution: two crossings nearer to each other than this may be overlooked.
        lipschitz: bound L on the slope of the field.
        radius: the surface lies in the ball of this radius around 0; None where it may lie anywhere.
        max_steps: rays that need more end as misses.
        budget: steps on each level up to ``level``, for the fixed mode.
        capture: the |f| that the fixed mode takes for a hit.
        differentiable: whether depth and position of the hits carry gradients.

    Raises:
        ValueError: shapes do not fit, the field is not three-dimensional, a number is out of range, or a ``budget`` is
            for a level without a band.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, sphere_trace
        >>> hits = sphere_trace(Sphere(radius=0.5), torch.tensor([0.0, 0.0, -2.0]), torch.tensor([0.0, 0.0, 1.0]))
        >>> bool(hits.mask), round(float(hits.depth), 4)
        (True, 1.5)
    """
    field = as_field(field)
    if budget is None:
        hits, _, _ = trace_expected(
            field, origins, directions, None, level=level, near=near, far=far, tolerance=tolerance,
            resolution=resolution, lipschitz=lipschitz, radius=radius, max_steps=max_steps,
        )  # fmt: skip
    else:
        check_rays(field, origins, directions, tolerance=tolerance, resolution=resolution, lipschitz=lipschitz)
        _check_budget(field, level, budget)
        with torch.no_grad():
            units, length = unit_directions(directions)
            spans, marched = _begin(origins, units, length, near, far, radius)
            march_budget(field, Rays.begin(*spans), marched, budget, tolerance, capture)
            hits = _hits(marched, origins, units, length)
    return _on_graph(field, origins, directions, level, hits) if differentiable else hits


def _on_graph(field: Field, origins: Tensor, directions: Tensor, level: int, hits: Hits) -> Hits:
    """Hits whose depth and position carry the derivatives of the implicit function."""
    origins, directions = torch.broadcast_tensors(origins, directions)
    rows = hits.mask.reshape(-1).nonzero()[:, 0]
    o, d, depth = origins.reshape(-1, 3)[rows], directions.reshape(-1, 3)[rows], hits.depth.reshape(-1)
    jet = field.jet(o + depth[rows, None] * d, level=level)
    slope = (jet.gradient * d).sum(dim=-1).detach()
    slope = torch.where(slope == 0, torch.finfo(slope.dtype).eps, slope)
    # The value itself is left out: where the trace ended is known better than one step from there.
    depth = depth.index_add(0, rows, (jet.value.detach() - jet.value) / slope).reshape(hits.depth.shape)
    return hits._replace(depth=depth, position=origins + depth[..., None] * directions)


def _check_budget(field: Field, level: int, budget: Sequence[int]) -> None:
    level = field.resolve_level(level)
    if len(budget) != level + 1:
        raise ValueError(f"budget={list(budget)}: expected {level + 1} number(s) of steps, one for each level")
    if bool((field.deltas[:level].isinf().cpu() & (torch.tensor(budget[:level]) > 0)).any()):
        raise ValueError(f"budget={list(budget)}: a level without a band leads to no other; give it 0 steps")


@torch.no_grad()
def trace_expected(
    field: Field,
    origins: Tensor,
    directions: Tensor,
    expected: Expected | None,
    *,
    level: int = -1,
    near: Tensor | float = 0.0,
    far: Tensor | float = torch.inf,
    tolerance: float = 1e-5,
    resolution: float = 1e-4,
    lipschitz: float = 1.0,
    radius: float | None = BOUNDING_RADIUS,
    max_steps: int = MAX_STEPS,
    reach: float | None = None,
) -> tuple[Hits, Tensor, Near]:
    """`sphere_trace` in the default mode, with expected depths and slopes of the hits, and values at ``near``, if any.

    A ray is first evaluated so near to its expected hit that the ball there just reaches back to ``near``. Where the
    field does not fall as expected, there is a gap between the balls, or the point lies behind the surface. Then the
    ray goes back: wrong depths and slopes only cost steps. But a ``value`` is trusted: where it implies an even fall
    from ``near`` to the hit, no other hit is searched for in between.

    Returns the hits, how fast the field fell along each ray at its last step ``(...,)``, and, with a ``reach``, where
    the ray came within it of the surface.
    """
    level = field.resolve_level(level)
    check_rays(field, origins, directions, tolerance=tolerance, resolution=resolution, lipschitz=lipschitz)
    rule = Rule(field.deltas[:level].to(directions), tolerance, resolution, lipschitz)
    directions, length = unit_directions(directions)
    spans, hits = _begin(origins, directions, length, near, far, radius)
    shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
    if expected is None and reach is None and choose_levels(levels_of(field)[: level + 1], directions, jet=False).fused:
        _march_fused(field, level, spans, hits, rule, max_steps)
    else:
        rays = Rays.begin(*spans)
        if expected is not None:
            depth, slope, value = (part.to(directions).broadcast_to(shape) for part in expected)
            flat = Expected((depth * length).reshape(-1), slope.reshape(-1), value.reshape(-1))
            rays = rays.expecting(flat, rule)
        go = march_ahead if makes_wait(directions.device) else march
        go(field, level, rays, hits, rule, max_steps, reach)
    clear, value, leave = (column.reshape(shape) for column in hits.near)
    near_surface = Near(clear / length, value, leave / length)
    return _hits(hits, origins, directions, length), hits.slope.reshape(shape), near_surface


def march_constants(dtype: torch.dtype) -> dict[str, float]:
    """Constants of `_march` that the fused kernels are compiled for."""
    return {
        "PATIENCE": PATIENCE,
        "BOLDNESS": BOLDNESS,
        "STEEPEST_RISE": STEEPEST_RISE,
        "BAND_ENTRY": BAND_ENTRY,
        "FLOOR": FLOOR * torch.finfo(dtype).eps,
    }


def _march_fused(field: Field, level: int, spans: Sequence[Tensor], hits: RayHits, rule: Rule, max_steps: int) -> None:
    """`march` by the fused kernels, with the same bounds, but for the last bits."""
    from ..backend.kernels.paths import march_fused
    from ..backend.kernels.tracing import March, Marched, Queue, RayTensors

    origins, directions, entries, starts, ends = (column.contiguous() for column in spans)
    if not len(starts):
        return
    levels = as_levels(field, level)
    marched, queue = Marched.nothing(hits.depth), Queue.of(starts, ends)
    numbers = starts.new_tensor([rule.tolerance, rule.resolution, rule.lipschitz])
    rays = RayTensors(origins, directions, starts, entries, ends)
    march_fused(March(levels, rays, queue, marched, numbers, max_steps, march_constants(starts.dtype)))
    hits.mask, hits.depth, hits.steps, hits.slope, hits.level = marched.in_own_types()


def _begin(
    origins: Tensor, directions: Tensor, length: Tensor, near: Tensor | float, far: Tensor | float, radius: float | None
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor, Tensor], RayHits]:
    """Flat rays, as `Rays.begin` takes them, inside the ball of ``radius``; and memory for their results.

    Directions are of unit length; ``near`` and ``far`` count in the ``length`` that they had.
    """
    origins, directions = torch.broadcast_tensors(origins, directions)
    shape = directions.shape[:-1]
    # Numbers are filled in on the device, without waiting.
    depths = (
        part.to(directions) if isinstance(part, Tensor) else directions.new_full((), part) for part in (near, far)
    )
    starts, ends = ((depth.broadcast_to(shape) * length).reshape(-1) for depth in depths)
    origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
    entries = torch.zeros_like(starts)
    if radius is not None:
        entry, leave = ball_crossing(origins, directions, radius)
        entries, ends = entry.clamp(min=0), torch.minimum(ends, leave)
    return (origins, directions, entries, torch.maximum(starts, entries), ends), RayHits(starts)


def _hits(hits: RayHits, origins: Tensor, directions: Tensor, length: Tensor) -> Hits:
    """Results in the shape of the rays; see `_begin`."""
    shape = torch.broadcast_shapes(origins.shape, directions.shape)[:-1]
    depth = hits.depth.reshape(shape)
    position = origins + depth[..., None] * directions
    return Hits(
        hits.mask.reshape(shape), depth / length, position, hits.level.reshape(shape), hits.steps.reshape(shape)
    )


def check_rays(field: Field, origins: Tensor, directions: Tensor, **numbers: float) -> None:
    """Raise ValueError unless field and rays are three-dimensional, and ``numbers`` positive."""
    if field.in_dim != 3:
        raise ValueError(f"field.in_dim={field.in_dim}: rays are traced in three dimensions; take a TimeSlice")
    for name, rows in (("origins", origins), ("directions", directions)):
        if rows.ndim == 0 or rows.shape[-1] != 3:
            raise ValueError(f"{name} has shape {tuple(rows.shape)}; expected (..., 3)")
    positive(**numbers)


def unit_directions(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Directions of length 1 and the lengths they had; those that are 1 but for rounding stay as they are."""
    length = directions.norm(dim=-1)
    rounding = 8 * torch.finfo(length.dtype).eps  # of a normalised vector: half a unit for each operation
    length = torch.where(((length - 1).abs() <= rounding) | (length == 0), torch.ones_like(length), length)
    return directions / length[..., None], length


def ball_crossing(origins: Tensor, directions: Tensor, radius: float | Tensor) -> tuple[Tensor, Tensor]:
    """Depths at which rays enter and leave the ball around 0; those that miss it enter after they leave."""
    middle, half = ball_chord(origins, directions, radius)
    missed = half == 0
    return torch.where(missed, torch.inf, middle - half), torch.where(missed, -torch.inf, middle + half)


def ball_points(count: int, *, radius: float, generator: torch.Generator) -> Tensor:
    """Points ``(count, 3)`` uniform in the ball around 0."""
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return radius * torch.rand(count, 1, generator=generator) ** (1 / 3) * directions


class Mapped(NamedTuple):
    """Attributes at points.

    Attributes:
        values: ``(..., C)``; zero, or the constant of a texture, at points that were not reached.
        reached: ``(...,)`` bool, whether the point lies in the band or could be moved to the surface.
    """

    values: Tensor
    reached: Tensor


@torch.no_grad()
def project_to_surface(
    field: FieldLike, points: Tensor, *, level: int = -1, steps: int = 10, tolerance: float = 1e-5
) -> tuple[Tensor, Tensor]:
    """Move points to the surface, ``x ← x − f(x) ∇f(x) / |∇f(x)|²`` until ``|f(x)|`` is small.

    Where f is a signed distance, one step lands on the closest point; elsewhere the points follow ∇f.

    Args:
        field: f; or any function of points ``(..., 3)`` → ``(...,)``.
        points: ``(..., d)``, in the field's coordinates.
        level: whose surface.
        steps: most evaluations per point; points that have arrived are left alone.
        tolerance: on ``|f|``, in field units.

    Returns:
        Points ``(..., d)``, and bool ``(...,)``: whether each of them has arrived.

    Raises:
        ValueError: there is no such level, or the dimension is wrong.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, project_to_surface
        >>> project_to_surface(Sphere(radius=0.5), torch.tensor([[0.8, 0.0, 0.0]]))
        (tensor([[0.5000, 0.0000, 0.0000]]), tensor([True]))
    """
    field = as_field(field)
    moved = field.check_points(points).reshape(-1, field.in_dim).clone()
    arrived = torch.zeros(len(moved), dtype=torch.bool, device=moved.device)
    moving = torch.arange(len(moved), device=moved.device)
    for step in range(steps + 1):
        x = moved[moving]
        value, gradient, _ = field.jet(x, level=level)
        near = value.abs() < tolerance
        arrived[moving[near]] = True
        moving = moving[~near]
        if step == steps or not len(moving):
            break
        value, gradient = value[~near, None], gradient[~near]
        slope = gradient.norm(dim=-1, keepdim=True)
        direction = gradient / slope.clamp_min(torch.finfo(slope.dtype).tiny)
        # However flat the field is, a step is never longer than 2 |f|.
        moved[moving] = x[~near] - value * direction / slope.clamp_min(0.5)
    return moved.reshape(points.shape), arrived.reshape(points.shape[:-1])


@torch.no_grad()
def map_attribute(
    field: FieldLike,
    attribute: Callable[[Tensor], Tensor],
    points: Tensor,
    *,
    delta: float,
    level: int = -1,
    batch: int = 1 << 18,
) -> Mapped:
    """The mapping {S, f, g} of the paper at points ``(..., d)`` of any surface S, in the field's coordinates.

    ``attribute`` is g, points ``(N, d)`` of the band → ``(N, C)``; ``delta`` the half-width of the band, in field
    units; ``batch`` points at a time. Errors are those of `project_to_surface`.
    """
    field = as_field(field)
    rows = field.check_points(points).reshape(-1, field.in_dim)
    parts: list[tuple[Tensor, Tensor]] = []
    for part in rows.split(batch):
        reached = field.value(part, level=level).abs() < delta
        away = (~reached).nonzero()[:, 0]
        if len(away):
            feet, arrived = project_to_surface(field, part[away], level=level)
            part, reached = part.index_copy(0, away, feet), reached.index_copy(0, away, arrived)
        kept = reached.nonzero()[:, 0]
        found = attribute(part[kept])
        parts.append((found.new_zeros(len(part), found.shape[-1]).index_copy(0, kept, found), reached))
    values, reached = (torch.cat(both) for both in zip(*parts, strict=True))
    return Mapped(values.reshape(*points.shape[:-1], values.shape[-1]), reached.reshape(points.shape[:-1]))


def map_colors(texture: TextureField, points: Tensor, *, batch: int = 1 << 18) -> Mapped:
    """Neural texture mapping: the colours of a texture at points ``(..., d)`` of any surface near its geometry.

    Colours ``(..., 3)`` of points that were not reached are ``texture.outside``. ``batch`` is points at a time.
    """
    values, reached = map_attribute(
        texture.geometry, texture.colors, points, delta=float(texture.delta), level=texture.geometry_level, batch=batch
    )
    return Mapped(torch.where(reached[..., None], values, texture.outside.to(values)), reached)
