"""Tracing surfaces that move: every frame says where the rays of the next one had better look first.

Where a ray met the surface twice, its next depth is foretold, and the slope there with it. That lets it skip the way to
the surface: `trace_expected` looks first at the point from which a ball would just reach back to where the ray began,
then at the foretold depth itself, and most rays are done. Rays that missed had to get away from what they passed; the
tiles of their pixels are marched from behind as well (`cone_ends`), so that they end sooner.

**What holds.** Nothing is taken over from an older frame but where to look. Every ray still needs an unbroken chain of
empty balls of this frame's field from its start to its hit, as in `sphere_trace`; a ray whose balls leave a gap, or
that finds itself behind the surface, goes back to its start. So the hits are those of tracing from scratch, to its
tolerance and its resolution, whatever has moved and however far: what comes into view in front of an old hit breaks the
chain there. Nothing is assumed about the motion. One that cannot be foretold costs evaluations, up to a little more
than from scratch.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from .field import Field
from .spacetime import SpaceTimeSDF, TimeSlice
from .tracing import BOUNDING_RADIUS, Expected, Hits, cone_ends, cone_starts, trace_expected

__all__ = ["DynamicTracer", "moment", "trace_sequence"]

# Networks are a little steeper than a distance here and there, and a cone that goes too far loses thin parts.
CONE_LIPSCHITZ = 1.15


def moment(field: Field, t: float) -> Field:
    """The three-dimensional field at a time: `SpaceTimeSDF.at`, where a point costs least, or else a `TimeSlice`.

    Raises:
        ValueError: the field is not four-dimensional.
    """
    return field.at(t) if isinstance(field, SpaceTimeSDF) else TimeSlice(field, t)


class _Frame(NamedTuple):
    """What is kept of a frame.

    Attributes:
        time: when.
        depth: of the hits, infinite where there are none.
        slope: how fast the field fell along the rays there.
    """

    time: float
    depth: Tensor
    slope: Tensor


class DynamicTracer:
    """First intersections of the same rays with a surface that moves, frame after frame.

    The hits are those of `sphere_trace` on the slice at each time (see the module for why). Times may come in any order
    and at any distance; the nearer, the better is a frame foretold.

    Args:
        field: four-dimensional.
        origins: ``(3,)`` or ``(..., 3)``.
        directions: ``(..., 3)`` of unit length. The rays ``(H, W, 3)`` of an image with one origin are traced in tiles
            first, as far as whole tiles see nothing.
        level: whose surface to find.
        tolerance: see `sphere_trace`.
        resolution: see `sphere_trace`.
        lipschitz: see `sphere_trace`.
        radius: see `sphere_trace`.

    Raises:
        ValueError: the field is not four-dimensional, or has no such level.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Moving, RigidMotion, Sphere
        >>> from mplicits.neural_fields.dynamic_tracing import DynamicTracer
        >>> ball = Moving(Sphere(radius=0.3), RigidMotion(velocity=(0.0, 0.0, 0.5)))
        >>> tracer = DynamicTracer(ball, torch.tensor([0.0, 0.0, -2.0]), torch.tensor([[0.0, 0.0, 1.0]]))
        >>> [round(float(tracer.trace(t).depth), 4) for t in (0.0, 0.1, 0.2)]
        [1.7, 1.75, 1.8]
    """

    def __init__(
        self,
        field: Field,
        origins: Tensor,
        directions: Tensor,
        *,
        level: int = -1,
        tolerance: float = 1e-5,
        resolution: float = 1e-4,
        lipschitz: float = 1.0,
        radius: float = BOUNDING_RADIUS,
    ) -> None:
        if field.in_dim != 4:
            raise ValueError(f"field.in_dim={field.in_dim}: expected a field of space-time, four-dimensional")
        self.field, self.origins, self.directions = field, origins, directions
        self.level, self.radius = field.resolve_level(level), radius
        self.tolerance, self.resolution, self.lipschitz = tolerance, resolution, lipschitz
        self._frames: list[_Frame] = []

    @torch.no_grad()
    def trace(self, t: float) -> Hits:
        """The hits at a time.

        Raises:
            ValueError: see `sphere_trace`.
        """
        field = moment(self.field, t)
        near, far = self._tiles(field)
        hits, slope = trace_expected(
            field,
            self.origins,
            self.directions,
            self._expected(t),
            level=self.level,
            near=near,
            far=far,
            radius=self.radius,
            tolerance=self.tolerance,
            resolution=self.resolution,
            lipschitz=self.lipschitz,
        )
        self._frames = [*self._frames[-1:], _Frame(t, torch.where(hits.mask, hits.depth, torch.inf), slope)]
        return hits

    def _tiles(self, field: Field) -> tuple[Tensor | float, Tensor | float]:
        """Between which depths there may be something, as far as tiles can tell."""
        if self.origins.shape != (3,) or self.directions.ndim != 3:
            return 0.0, torch.inf
        cones = {"level": self.level, "lipschitz": CONE_LIPSCHITZ * self.lipschitz, "radius": self.radius}
        near = cone_starts(field, self.origins, self.directions, **cones)
        if not self._frames:
            return near, torch.inf
        passing = near.isfinite() & self._frames[-1].depth.isinf()
        return near, cone_ends(field, self.origins, self.directions, passing, **cones)

    def _expected(self, t: float) -> Expected | None:
        """The last hits, moved on as they moved before."""
        if not self._frames:
            return None
        last = self._frames[-1]
        before = self._frames[0]
        depth = last.depth
        if before.time != last.time:
            moved = depth + (depth - before.depth) * ((t - last.time) / (last.time - before.time))
            depth = torch.where(moved.isfinite(), moved, depth)
        return Expected(depth, last.slope)


def trace_sequence(
    field: Field,
    times: Iterable[float],
    origins: Tensor,
    directions: Tensor,
    *,
    level: int = -1,
    tolerance: float = 1e-5,
    resolution: float = 1e-4,
    lipschitz: float = 1.0,
    radius: float = BOUNDING_RADIUS,
) -> Iterator[Hits]:
    """The hits of the same rays at one time after the other; see `DynamicTracer`."""
    tracer = DynamicTracer(
        field,
        origins,
        directions,
        level=level,
        tolerance=tolerance,
        resolution=resolution,
        lipschitz=lipschitz,
        radius=radius,
    )
    for t in times:
        yield tracer.trace(t)
