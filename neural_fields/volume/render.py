"""``render_volume``: colours, depths and normals of rays through any field, by NeuS's volume rendering.

Where to sample is asked of the coarsest level alone; then one jet per sample gives value, gradient and features, and
inside a `MultiscaleSDF` the residual levels see only the samples in their bands. Colours are asked only for the samples
that contribute to their pixel, and jets, if wanted, only where the values of the march say that there is weight.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..backend._checks import at_least, positive
from ..backend.devices import precise, uniform
from ..backend.fixed_shapes import chosen
from ..fields.field import Field, Jet
from ..fields.function import FieldLike, as_field
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

__all__ = ["RayColor", "RayOutside", "Rendered", "Sampling", "render_volume", "sample_depths"]

# Sharpness of the importance samples in units of 1/δ₀: half of them lie within δ₀ / 15 of the coarse surface.
BAND_SHARPNESS = 16.0
# The same where weights are estimated to find sections without any: a finer surface may lie δ₀ / 8 away.
SKIP_SHARPNESS = 8.0

RayColor = Callable[[Tensor, Tensor, Jet], Tensor]
"""Colours ``(N, 3)`` of points ``(N, 3)`` seen along unit directions ``(N, 3)``, given the geometry's jet there."""


class RayOutside(Protocol):
    """What lies outside the unit sphere."""

    def __call__(self, inverted: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Density ``(N,)`` ≥ 0 and colour ``(N, 3)`` at `invert_outside` points ``(N, 4)``."""
        ...


@dataclass(frozen=True)
class Sampling:
    """How many samples a ray gets, and where.

    Attributes:
        uniform: evenly spaced depths.
        importance: further depths near the surface, at the coarsest level.
        rounds: in how many rounds these come, each with twice the sharpness of the one before.
        sharpness: inv_std of the first round.
        outside: samples behind the region of interest, if something is there.

    Raises:
        ValueError: a number is out of range.
    """

    uniform: int = 64
    importance: int = 64
    rounds: int = 4
    sharpness: float = 64.0
    outside: int = 32

    def __post_init__(self) -> None:
        at_least(2, uniform=self.uniform)
        at_least(1, rounds=self.rounds, outside=self.outside)
        at_least(0, importance=self.importance)
        positive(sharpness=self.sharpness)


class Rendered(NamedTuple):
    """What rays see.

    Attributes:
        color: ``(R, 3)``, the background included.
        opacity: ``(R,)`` share of the ray that ends inside the unit sphere, in [0, 1].
        depth: ``(R,)`` Σ w t, so depth / opacity is the mean depth of what is seen.
        normal: ``(R, 3)`` Σ w ∇f/|∇f|; shorter than 1 where normals differ or the ray passes.
        weights: ``(R, S)``.
        depths: ``(R, S)`` the middles of the sections.
        jet: of the field there, ``(R, S, …)``; 0 in sections that were skipped.
        counts: ``(R, S)`` for how many sections each jet stands in a mean over all of them: 1 if none was skipped, else
            0 there and 1 / ``skip_share`` in those that were kept by chance. 0 on rays that miss the unit sphere.
    """

    color: Tensor
    opacity: Tensor
    depth: Tensor
    normal: Tensor
    weights: Tensor
    depths: Tensor
    jet: Jet
    counts: Tensor


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
    least_weight: float = 0.0,
    skip: float = 0.0,
    skip_share: float = 0.0,
    guide: Callable[[Tensor], Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Rendered:
    """Render rays through the unit sphere; differentiable in the rays and all parameters, ``inv_std`` too.

    Inside `fixed_shapes` the sections, colours and rays that are chosen have the ``rooms`` "sections", "colors" and
    "outside", as bands have theirs, and the host never waits.

    Args:
        field: the geometry, in unit-sphere coordinates; or any function of points ``(..., 3)`` → ``(...,)``.
        color: for example a `ViewColor`, or ``lambda x, v, jet: texture.colors(x)``.
        origins: ``(R, 3)``.
        directions: ``(R, 3)`` unit vectors.
        inv_std: s of NeuS; 1/s is how far around the surface light is stopped.
        sampling: where to sample.
        cos_anneal: see `neus_optical_depth`.
        level: level of the field to render.
        background: ``(3,)`` or ``(R, 3)`` colour of what light passes the sphere; None is black.
        outside: what is behind the sphere; ``background`` is then behind that.
        least_weight: no colour is asked for samples of a smaller weight, nor what is outside of rays of which less
            light is left; a pixel's error is at most ``least_weight`` times the number of its samples and one.
        skip: sections whose weight is estimated to be smaller, from values of the coarsest level at their ends, get no
            jet and stop no light; 0 evaluates all. The neighbours of kept sections are kept, and of each ray the
            section in which the field is smallest. Where the skipped sections of a ray had the weights w in the full
            sum, each channel of its colour differs from the full one by Σ w at most.
        skip_share: of those sections, this share is evaluated nevertheless, drawn by ``generator``; see
            `Rendered.counts`.
        guide: values of points ``(..., 3)`` → ``(...,)`` by which samples are placed and skipped; for example a
            `ValueGrid`, which costs no network. By default the coarsest level of the field.
        generator: jitters the samples, for training; None is deterministic.

    Raises:
        ValueError: shapes do not match, there is no such level, or ``skip_share`` is no share.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Sphere, render_volume
        >>> red = lambda x, direction, jet: torch.tensor([1.0, 0.0, 0.0]).expand_as(x)
        >>> eye, ahead = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> seen = render_volume(Sphere(radius=0.5), red, eye, ahead, inv_std=1000.0)
        >>> seen.color.round(decimals=3).tolist(), round(float(seen.depth), 2)
        ([[1.0, 0.0, 0.0]], 1.5)
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
        field, origins, directions, near, far, sampling, level=level, guide=guide, generator=generator
    )
    interval = edges.diff(dim=1)
    depths = edges[:, :-1] + 0.5 * interval
    # Sections of a ray that misses the sphere have no length, and stand for nothing.
    counts, rows = (far > near).to(depths)[:, None].expand_as(depths), None
    if skip > 0 and counts.numel():
        with torch.no_grad():  # an estimate chooses sections and teaches nobody
            values = _march(field, guide)(ray_points(origins, directions, edges))
            estimated = secant_weights(edges, values, _estimate_sharpness(field, level, inv_std), cos_anneal=cos_anneal)
            counts = counts * _counts(estimated, values, skip, skip_share, generator)
        rows = chosen("sections", counts.flatten() > 0)

    def of_sections(tensor: Tensor) -> Tensor:
        """``(R, S, …)`` → ``(K, …)``, those that are evaluated."""
        flat = tensor.flatten(0, 1)
        return flat if rows is None else rows.of(flat)

    def in_place(found: Tensor) -> Tensor:
        """The way back; 0 in sections that were skipped."""
        shape = (*depths.shape, *found.shape[1:])
        return (found if rows is None else rows.back(found)).reshape(shape)

    points = of_sections(ray_points(origins, directions, depths))  # (K, 3)
    along = of_sections(directions[:, None].expand(-1, depths.shape[1], -1))
    with nullcontext() if rows is None else rows.wanted():
        found = field.jet(points, level=level)
    slope = (found.gradient * along).sum(dim=-1)
    optical = neus_optical_depth(found.value, slope, of_sections(interval), inv_std, cos_anneal=cos_anneal)
    weights, remaining = transmittance_weights(in_place(optical))
    matter = None
    if least_weight > 0:
        matter = of_sections(weights.detach()) > least_weight
        matter = matter if rows is None or rows.full else matter & rows.used
    seen = in_place(_colors(color, points, along, found, matter))
    mixed = composite(weights, seen)
    if outside is not None:
        # As for colours: where next to no light gets there, nobody asks what is there.
        through = chosen("outside", remaining.detach() > least_weight)
        eyes, along, ends, light = (through.of(tensor) for tensor in (origins, directions, far, remaining))
        last = background if background is None or background.ndim == 1 else through.of(background)
        behind = _behind(outside, eyes, along, ends, sampling, last, generator)
        mixed = mixed + through.back(light[:, None] * behind)
    elif background is not None:
        mixed = mixed + remaining[:, None] * background
    jet = Jet(*(in_place(part) for part in found))
    normals = torch.nn.functional.normalize(jet.gradient, dim=-1)
    return Rendered(
        color=mixed,
        opacity=1 - remaining,
        depth=(weights * depths).sum(dim=1),
        normal=composite(weights, normals),
        weights=weights,
        depths=depths,
        jet=jet,
        counts=counts,
    )


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
    guide: Callable[[Tensor], Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The ends of the sections of each ray, ``(R, uniform + importance + 2)``, from ``near`` to ``far``, sorted.

    Only the coarsest level is asked, or ``guide`` in its place. If a finer one is meant, the sharpness ends at
    BAND_SHARPNESS / δ₀, so that samples reach into the band in which the finer surface may lie.
    """
    depths = stratified_depths(near, far, sampling.uniform, generator=generator)
    sharpest = BAND_SHARPNESS / field.deltas[0].to(precise(near.device)) if field.resolve_level(level) else None
    if sampling.importance:
        march = _march(field, guide)
        values = march(ray_points(origins, directions, depths))
        share, extra = divmod(sampling.importance, sampling.rounds)
        for index in range(sampling.rounds):
            count = share + (index < extra)
            sharpness = sampling.sharpness * 2**index
            sharpness = sharpness if sharpest is None else sharpest.clamp(max=sharpness)
            more = importance_depths(depths, values, count, sharpness, generator=generator)
            depths, order = torch.cat((depths, more), dim=1).sort(dim=1)
            if index + 1 < sampling.rounds:
                found = march(ray_points(origins, directions, more))
                values = torch.cat((values, found), dim=1).gather(1, order)
    return torch.cat((near[:, None], depths, far[:, None]), dim=1)


def _march(field: Field, guide: Callable[[Tensor], Tensor] | None) -> Callable[[Tensor], Tensor]:
    """What is asked for values: points ``(..., 3)`` → ``(...,)``."""
    return partial(field.value, level=0) if guide is None else guide


def _estimate_sharpness(field: Field, level: int, inv_std: Tensor | float) -> Tensor:
    """The s by which weights are estimated: a finer surface may lie beside the coarsest one, so it is bounded."""
    known = torch.as_tensor(inv_std).detach()
    if not level:
        return known
    return torch.minimum(known, (SKIP_SHARPNESS / field.deltas[0]).to(known))


@torch.no_grad()
def _counts(estimated: Tensor, values: Tensor, skip: float, share: float, generator: torch.Generator | None) -> Tensor:
    """See `Rendered.counts`, from estimated weights ``(R, S)`` and the values ``(R, S + 1)`` at sections' ends."""
    if not estimated.numel():
        return torch.ones_like(estimated)
    around = torch.nn.functional.max_pool1d(estimated[:, None], 3, stride=1, padding=1)[:, 0]
    smallest = (values[:, 1:] + values[:, :-1]).argmin(dim=1, keepdim=True)
    counts = (around >= skip).to(estimated).scatter(1, smallest, 1.0)
    if share and generator is not None:
        chance = uniform(estimated.shape, generator, estimated.device) < share
        counts = torch.where((counts == 0) & chance, 1 / share, counts)
    return counts


def _colors(color: RayColor, points: Tensor, along: Tensor, jet: Jet, matter: Tensor | None) -> Tensor:
    """Colours ``(K, 3)`` of the samples that matter ``(K,)``, 0 for the others; of all for None."""
    if matter is None or not len(points):
        return color(points, along, jet)
    rows = chosen("colors", matter)
    return rows.back(color(rows.of(points), rows.of(along), Jet(*(rows.of(part) for part in jet))))


def _behind(
    outside: RayOutside,
    origins: Tensor,
    directions: Tensor,
    far: Tensor,
    sampling: Sampling,
    background: Tensor | None,
    generator: torch.Generator | None,
) -> Tensor:
    """The colour ``(R, 3)`` of what lies behind the unit sphere."""
    # A ray that misses the sphere begins to see the outside where it is nearest to the centre.
    nearest = torch.maximum(far, -(origins * directions).sum(dim=-1))
    depths = outside_depths(nearest, sampling.outside, generator=generator)
    points = invert_outside(ray_points(origins, directions, depths))
    along = directions[:, None].expand(-1, sampling.outside, -1).reshape(-1, 3)
    density, seen = outside(points.flatten(0, 1), along)
    interval = torch.cat((depths.diff(dim=1), depths[:, -1:]), dim=1)
    weights, remaining = transmittance_weights(density.reshape(depths.shape) * interval)
    mixed = composite(weights, seen.reshape(*depths.shape, 3))
    return mixed if background is None else mixed + remaining[:, None] * background
