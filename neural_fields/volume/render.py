"""Volume rendering of any field as in NeuS: `sample_rays`, then `render_samples`; `render_volume` does both.

Samples are placed by the coarsest level alone. One jet per sample gives value, gradient and features; residual levels
are evaluated only in their bands, and colours only for samples that contribute to their pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ..backend.devices import precise, uniform
from ..backend.errors import at_least, positive, renamed
from ..backend.fixed_shapes import chosen
from ..fields.field import Field, FieldLike, Jet, as_field
from .weights import (
    composite,
    importance_depths,
    invert_outside,
    neus_optical_depth,
    outside_depths,
    ray_points,
    secant_weights,
    sphere_span,
    stratified_depths,
    transmittance_weights,
)

RayColor = Callable[[Tensor, Tensor, Jet], Tensor]
"""Colours ``(N, 3)`` of points ``(N, 3)`` seen along unit directions ``(N, 3)``, given the geometry's jet there."""
RayOutside = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Density ``(N,)`` ≥ 0 and colour ``(N, 3)`` outside the unit sphere, at `invert_outside` points ``(N, 4)``."""


@dataclass(frozen=True)
class Sampling:
    """Number and places of the samples of a ray. ValueError if a number is out of range.

    Attributes:
        uniform: evenly spaced depths.
        importance: further depths near the surface, at the coarsest level.
        rounds: in which these are placed, each with twice the sharpness of the one before.
        sharpness: inv_std of the first round.
        outside: samples behind the region of interest, if there is a background field.
        band_sharpness: highest inv_std of a round in units of 1/δ₀; half of the samples then lie within δ₀ / 15.
        skip_sharpness: the same for the weights by which intervals are skipped; a finer surface may lie δ₀ / 8 away.
    """

    uniform: int = 64
    importance: int = 64
    rounds: int = 4
    sharpness: float = 64.0
    outside: int = 32
    band_sharpness: float = 16.0
    skip_sharpness: float = 8.0

    def __post_init__(self) -> None:
        at_least(2, uniform=self.uniform)
        at_least(1, rounds=self.rounds, outside=self.outside)
        at_least(0, importance=self.importance)
        positive(sharpness=self.sharpness, band_sharpness=self.band_sharpness, skip_sharpness=self.skip_sharpness)


class Samples(NamedTuple):
    """Intervals of rays.

    Attributes:
        t_starts: ``(R, S)`` depth at which each begins.
        t_ends: ``(R, S)`` depth at which each ends, where the next begins.
        counts: ``(R, S)`` weight in a mean over all intervals: 1, or 0 for skipped ones and 1 / ``skip_share`` for
            those kept by chance. 0 on rays that miss the unit sphere.
        skipped: whether intervals with a count of 0 are left out of the rendering.
    """

    t_starts: Tensor
    t_ends: Tensor
    counts: Tensor
    skipped: bool


class Rendered(NamedTuple):
    """Rendered rays.

    Attributes:
        color: ``(R, 3)``, the background included.
        opacity: ``(R,)`` share of the ray that ends inside the unit sphere, in [0, 1].
        depth: ``(R,)`` Σ w t, so depth / opacity is the mean depth.
        normal: ``(R, 3)`` Σ w ∇f/|∇f|; shorter than 1 where normals differ or the ray passes.
        weights: ``(R, S)``.
        depths: ``(R, S)`` the middles of the intervals.
        jet: of the field there, ``(R, S, …)``; 0 in intervals that were skipped.
        counts: ``(R, S)``, see `Samples`.
    """

    color: Tensor
    opacity: Tensor
    depth: Tensor
    normal: Tensor
    weights: Tensor
    depths: Tensor
    jet: Jet
    counts: Tensor


@partial(renamed, least_weight="early_stop_eps", skip="alpha_threshold", guide="sdf_grid")
def render_volume(
    field: FieldLike,
    color: RayColor,
    origins: Tensor,
    directions: Tensor,
    *,
    inv_std: Tensor | float,
    sampling: Sampling | None = None,
    cos_anneal: Tensor | float = 1.0,
    level: int = -1,
    background: Tensor | None = None,
    outside: RayOutside | None = None,
    early_stop_eps: float = 0.0,
    alpha_threshold: float = 0.0,
    skip_share: float = 0.0,
    sdf_grid: Callable[[Tensor], Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Rendered:
    """Render rays through the unit sphere; differentiable in the rays and all parameters, ``inv_std`` too.

    Inside `fixed_shapes` the chosen intervals, colours and rays have the named capacities "samples", "colors" and
    "outside", and the host never waits.

    Args:
        field: the geometry, in unit-sphere coordinates; or any function of points ``(..., 3)`` → ``(...,)``.
        color: for example a `ColorNetwork`, or ``lambda x, v, jet: texture.colors(x)``.
        origins: ``(R, 3)``.
        directions: ``(R, 3)`` unit vectors.
        inv_std: s of NeuS; 1/s is how far around the surface light is stopped.
        sampling: where to sample.
        cos_anneal: see `neus_optical_depth`.
        level: level of the field to render.
        background: ``(3,)`` or ``(R, 3)`` colour behind everything; None is black.
        outside: background field outside the sphere.
        early_stop_eps: colours are evaluated only for samples of a larger weight, and ``outside`` only for rays with
            more light left. A pixel's error is at most this times the number of its samples and one.
        alpha_threshold: intervals are skipped whose weight, estimated from values of the coarsest level at their ends,
            is smaller; 0 skips none. Neighbours of kept intervals are kept, and the one with the smallest value of each
            ray. Each channel of a ray's colour changes by at most the sum of the skipped weights.
        skip_share: share of the intervals to skip that is kept nevertheless, drawn by ``generator``.
        sdf_grid: values of points ``(..., 3)`` → ``(...,)`` that place and skip samples in place of the coarsest level;
            for example a `ValueGrid`, which costs no network.
        generator: jitters the samples, for training; None is deterministic.

    Raises:
        ValueError: shapes do not match, there is no such level, or ``skip_share`` is no share.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, render_volume
        >>> red = lambda x, direction, jet: torch.tensor([1.0, 0.0, 0.0]).expand_as(x)
        >>> eye, ahead = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> rendered = render_volume(Sphere(radius=0.5), red, eye, ahead, inv_std=1000.0)
        >>> rendered.color.round(decimals=3).tolist(), round(float(rendered.depth), 2)
        ([[1.0, 0.0, 0.0]], 1.5)
    """
    field, sampling = as_field(field), sampling or Sampling()
    samples = sample_rays(
        field, origins, directions, inv_std=inv_std, sampling=sampling, cos_anneal=cos_anneal, level=level,
        alpha_threshold=alpha_threshold, skip_share=skip_share, sdf_grid=sdf_grid, generator=generator,
    )  # fmt: skip
    return render_samples(
        field, color, origins, directions, samples, inv_std=inv_std, cos_anneal=cos_anneal, level=level,
        background=background, outside=outside, outside_samples=sampling.outside, early_stop_eps=early_stop_eps,
        generator=generator,
    )  # fmt: skip


def sample_rays(
    field: FieldLike,
    origins: Tensor,
    directions: Tensor,
    *,
    inv_std: Tensor | float,
    sampling: Sampling | None = None,
    cos_anneal: Tensor | float = 1.0,
    level: int = -1,
    alpha_threshold: float = 0.0,
    skip_share: float = 0.0,
    sdf_grid: Callable[[Tensor], Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Samples:
    """Cut rays ``(R, 3)`` through the unit sphere into intervals, short ones near the surface; without a graph.

    Arguments and errors are those of `render_volume`. ``inv_std`` matters only with an ``alpha_threshold``.
    """
    if origins.shape != directions.shape or origins.ndim != 2 or origins.shape[1] != 3:
        raise ValueError(
            f"origins {tuple(origins.shape)}, directions {tuple(directions.shape)}: expected (R, 3) for both"
        )
    if not 0 <= skip_share <= 1:
        raise ValueError(f"skip_share={skip_share}: expected a share in [0, 1]")
    field = as_field(field)
    level, sampling = field.resolve_level(level), sampling or Sampling()
    near, far = sphere_span(origins, directions)
    edges = sample_depths(
        field, origins, directions, near, far, sampling, level=level, sdf_grid=sdf_grid, generator=generator
    )
    # Intervals of a ray that misses the sphere have no length, and do not count.
    counts = (far > near).to(edges)[:, None].expand(-1, edges.shape[1] - 1)
    skipped = alpha_threshold > 0 and counts.numel() > 0
    if skipped:
        with torch.no_grad():
            values = _coarsest(field, sdf_grid)(ray_points(origins, directions, edges))
            known = torch.as_tensor(inv_std).detach()
            if level:  # a finer surface may lie beside the coarsest one
                known = torch.minimum(known, (sampling.skip_sharpness / field.deltas[0]).to(known))
            estimated = secant_weights(edges, values, known, cos_anneal=cos_anneal)
            counts = counts * _counts(estimated, values, alpha_threshold, skip_share, generator)
    return Samples(edges[:, :-1], edges[:, 1:], counts, skipped)


def render_samples(
    field: FieldLike,
    color: RayColor,
    origins: Tensor,
    directions: Tensor,
    samples: Samples,
    *,
    inv_std: Tensor | float,
    cos_anneal: Tensor | float = 1.0,
    level: int = -1,
    background: Tensor | None = None,
    outside: RayOutside | None = None,
    outside_samples: int = 32,
    early_stop_eps: float = 0.0,
    generator: torch.Generator | None = None,
) -> Rendered:
    """Render rays ``(R, 3)`` that `sample_rays` has cut into intervals; arguments as in `render_volume`.

    ``outside_samples`` is the number of samples of a ray in ``outside``.
    """
    field, (t_starts, t_ends, counts, skipped) = as_field(field), samples
    interval = t_ends - t_starts
    depths = t_starts + 0.5 * interval
    rows = chosen("samples", counts.flatten() > 0) if skipped else None

    def gathered(tensor: Tensor) -> Tensor:
        """``(R, S, …)`` → ``(K, …)``, the intervals that are evaluated."""
        flat = tensor.flatten(0, 1)
        return flat if rows is None else rows.of(flat)

    def in_place(values: Tensor) -> Tensor:
        """``(K, …)`` → ``(R, S, …)``, 0 in intervals that were skipped."""
        return (values if rows is None else rows.back(values)).reshape(*depths.shape, *values.shape[1:])

    points = gathered(ray_points(origins, directions, depths))  # (K, 3)
    along = gathered(directions[:, None].expand(-1, depths.shape[1], -1))
    with nullcontext() if rows is None else rows.masked():
        flat = field.jet(points, level=level)
    slope = (flat.gradient * along).sum(dim=-1)
    optical = neus_optical_depth(flat.value, slope, gathered(interval), inv_std, cos_anneal=cos_anneal)
    weights, remaining = transmittance_weights(in_place(optical))
    mask = None
    if early_stop_eps > 0:
        mask = gathered(weights.detach()) > early_stop_eps
        mask = mask if rows is None or rows.full else mask & rows.used
    mixed = composite(weights, in_place(_colors(color, points, along, flat, mask)))
    if outside is not None:
        through = chosen("outside", remaining.detach() > early_stop_eps)
        eyes, along, ends, light = (through.of(tensor) for tensor in (origins, directions, t_ends[:, -1], remaining))
        last = background if background is None or background.ndim == 1 else through.of(background)
        behind = _behind(outside, eyes, along, ends, outside_samples, last, generator)
        mixed = mixed + through.back(light[:, None] * behind)
    elif background is not None:
        mixed = mixed + remaining[:, None] * background
    jet = Jet(*(in_place(part) for part in flat))
    normals = torch.nn.functional.normalize(jet.gradient, dim=-1)
    depth, normal = (weights * depths).sum(dim=1), composite(weights, normals)
    return Rendered(mixed, 1 - remaining, depth, normal, weights, depths, jet, counts)


@torch.no_grad()
def sample_depths(
    field: Field,
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    sampling: Sampling,
    *,
    level: int = -1,
    sdf_grid: Callable[[Tensor], Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The ends of the intervals of each ray, ``(R, uniform + importance + 2)``, from ``near`` to ``far``, sorted.

    Only the coarsest level is evaluated, or ``sdf_grid``. If a finer one is meant, the sharpness ends at
    ``band_sharpness`` / δ₀, so that samples reach into the band in which the finer surface may lie.
    """
    depths = stratified_depths(near, far, sampling.uniform, generator=generator)
    finer = bool(field.resolve_level(level))
    sharpest = sampling.band_sharpness / field.deltas[0].to(precise(near.device)) if finer else None
    if sampling.importance:
        coarsest = _coarsest(field, sdf_grid)
        values = coarsest(ray_points(origins, directions, depths))
        share, extra = divmod(sampling.importance, sampling.rounds)
        for index in range(sampling.rounds):
            count = share + (index < extra)
            sharpness = sampling.sharpness * 2**index
            sharpness = sharpness if sharpest is None else sharpest.clamp(max=sharpness)
            more = importance_depths(depths, values, count, sharpness, generator=generator)
            depths, order = torch.cat((depths, more), dim=1).sort(dim=1)
            if index + 1 < sampling.rounds:
                values = torch.cat((values, coarsest(ray_points(origins, directions, more))), dim=1).gather(1, order)
    return torch.cat((near[:, None], depths, far[:, None]), dim=1)


def _coarsest(field: Field, sdf_grid: Callable[[Tensor], Tensor] | None) -> Callable[[Tensor], Tensor]:
    """Values of points ``(..., 3)`` → ``(...,)`` that place samples."""
    return partial(field.value, level=0) if sdf_grid is None else sdf_grid


@torch.no_grad()
def _counts(
    estimated: Tensor, values: Tensor, threshold: float, share: float, generator: torch.Generator | None
) -> Tensor:
    """See `Samples.counts`, from estimated weights ``(R, S)`` and the values ``(R, S + 1)`` at the intervals' ends."""
    around = torch.nn.functional.max_pool1d(estimated[:, None], 3, stride=1, padding=1)[:, 0]
    smallest = (values[:, 1:] + values[:, :-1]).argmin(dim=1, keepdim=True)
    counts = (around >= threshold).to(estimated).scatter(1, smallest, 1.0)
    if share and generator is not None:
        chance = uniform(estimated.shape, generator, estimated.device) < share
        counts = torch.where((counts == 0) & chance, 1 / share, counts)
    return counts


def _colors(color: RayColor, points: Tensor, along: Tensor, jet: Jet, mask: Tensor | None) -> Tensor:
    """Colours ``(K, 3)`` of the samples in the mask ``(K,)``, 0 for the others; of all for None."""
    if mask is None or not len(points):
        return color(points, along, jet)
    rows = chosen("colors", mask)
    return rows.back(color(rows.of(points), rows.of(along), Jet(*(rows.of(part) for part in jet))))


def _behind(
    outside: RayOutside,
    origins: Tensor,
    directions: Tensor,
    far: Tensor,
    count: int,
    background: Tensor | None,
    generator: torch.Generator | None,
) -> Tensor:
    """The colour ``(R, 3)`` behind the unit sphere, from ``count`` samples."""
    # For a ray that misses the sphere, the outside begins at the point nearest to the centre.
    nearest = torch.maximum(far, -(origins * directions).sum(dim=-1))
    depths = outside_depths(nearest, count, generator=generator)
    points = invert_outside(ray_points(origins, directions, depths))
    density, colors = outside(points.flatten(0, 1), directions[:, None].expand(-1, count, -1).reshape(-1, 3))
    interval = torch.cat((depths.diff(dim=1), depths[:, -1:]), dim=1)
    weights, remaining = transmittance_weights(density.reshape(depths.shape) * interval)
    mixed = composite(weights, colors.reshape(*depths.shape, 3))
    return mixed if background is None else mixed + remaining[:, None] * background
