"""Tracing surfaces that move, with what one frame shows about the next ones.

**Key frames** are traced from scratch (`sphere_trace`), and record for every ray where it comes within ``reach`` of the
surface. Until the surface may have moved that far, the frames in between trace less:

- Rays that never came near it are left out.
- The others begin where they came near. Those that passed end where they left it again.
- A ray starts at its expected hit, from its depths in the last two frames, if the values fell evenly to the hit.

These rest on the ``speed``, a bound on |∂f/∂t|: a point with f ≥ reach stays outside for ``reach / speed``. Until the
next key frame they miss what grows out of the last stretch of an even fall, and a spike between two clear samples of a
ray.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..fields.field import Field
from ..tracing.cones import CONE_LIPSCHITZ, cone_starts
from ..tracing.sphere import BOUNDING_RADIUS, Expected, Hits, Near, ball_points, trace_expected
from .field import SpaceTimeSDF, TimeSlice, check_spacetime


def moment(field: Field, t: float) -> Field:
    """The three-dimensional field at a time: `SpaceTimeSDF.at`, the cheapest, or else a `TimeSlice`.

    ValueError if the field is not four-dimensional.
    """
    return field.at(t) if isinstance(field, SpaceTimeSDF) else TimeSlice(field, t)


class _Frame(NamedTuple):
    """A frame that was traced."""

    time: float
    depth: Tensor  # of hits, infinite elsewhere
    slope: Tensor  # how fast the field fell along the rays there


class _Key(NamedTuple):
    """A key frame."""

    time: float
    lasts: float  # time in which the surface moves by the reach
    near: Near  # where each ray came near the surface
    far: Tensor  # where to stop: where rays that missed had left it again


class DynamicTracer:
    """First intersections of the same rays with a moving surface, frame after frame; see the module.

    Times may come in any order and distance; the nearer, the more frames there are between two key frames. The
    ``tolerance``, ``resolution``, ``lipschitz`` and ``radius`` are those of `sphere_trace`.

    Args:
        field: four-dimensional.
        origins: ``(3,)`` or ``(..., 3)``.
        directions: ``(..., 3)`` of unit length. Rays ``(H, W, 3)`` of an image with one origin are traced in tiles
            first.
        level: whose surface to find.
        reach: distance that is near; by default 12 resolutions. More makes key frames fewer and other frames dearer;
            with 0 every frame is a key frame.
        speed: bound on |∂f/∂t| near the surface; by default 1.25 times the largest measured around it at every key
            frame.

    Raises:
        ValueError: the field is not four-dimensional, has no such level, or a number is negative.
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
        reach: float | None = None,
        speed: float | None = None,
    ) -> None:
        check_spacetime(field)
        for name, number in (("reach", reach), ("speed", speed)):
            if number is not None and number < 0:
                raise ValueError(f"{name}={number}: expected ≥ 0")
        self.field, self.origins, self.directions = field, origins, directions
        self.level, self.lipschitz, self.radius = field.resolve_level(level), lipschitz, radius
        self.settings: dict[str, Any] = {"level": self.level, "lipschitz": lipschitz, "radius": radius}
        self.settings |= {"tolerance": tolerance, "resolution": resolution}
        self.reach, self.speed = 12.0 * resolution if reach is None else reach, speed
        self._frames: list[_Frame] = []
        self._key: _Key | None = None

    @torch.no_grad()
    def trace(self, t: float) -> Hits:
        """The hits at a time; errors are those of `sphere_trace`."""
        field, key = moment(self.field, t), self._key
        if key is not None and abs(t - key.time) < key.lasts:
            hits, slope, _ = self._trace(field, self._expected(t, key.near.value), key.near.clear, key.far, None)
        else:
            hits, slope = self._trace_key(field, t)
        self._frames = [*self._frames[-1:], _Frame(t, torch.where(hits.mask, hits.depth, torch.inf), slope)]
        return hits

    def _trace_key(self, field: Field, t: float) -> tuple[Hits, Tensor]:
        """Trace a key frame."""
        unknown = torch.full_like(self.directions[..., 0], torch.inf)
        hits, slope, near = self._trace(field, self._expected(t, unknown), self._tiles(field), torch.inf, self.reach)
        lasts = 0.0
        if self.reach:
            speed = self._measured_speed(t) if self.speed is None else self.speed
            lasts = self.reach / max(speed, torch.finfo(torch.float32).tiny)
        self._key = _Key(t, lasts, near, torch.where(hits.mask, torch.inf, near.leave))
        return hits, slope

    def _trace(
        self, field: Field, expected: Expected | None, near: Tensor | float, far: Tensor | float, reach: float | None
    ) -> tuple[Hits, Tensor, Near]:
        rays = self.origins, self.directions
        return trace_expected(field, *rays, expected, near=near, far=far, reach=reach, **self.settings)

    def _measured_speed(self, t: float) -> float:
        """Largest |∂f/∂t| near the surface now, with a margin; for a distance, how fast the surface moves."""
        interval, near, margin = 1e-3, 0.1, 1.25  # of time; of the surface; a quarter more than was measured
        generator = torch.Generator().manual_seed(0)
        points = ball_points(16384, radius=self.radius, generator=generator).to(self.directions)
        before, after = (moment(self.field, t + sign * interval / 2).value(points, level=0) for sign in (-1, 1))
        rate = (after - before).abs() / interval
        close = before.abs() < max(near, 4 * self.reach)
        return margin * float((rate[close] if close.any() else rate).max())

    def _tiles(self, field: Field) -> Tensor | float:
        """Depths up to which tiles show that nothing is near."""
        if self.origins.shape != (3,) or self.directions.ndim != 3:
            return 0.0
        cones = {"level": self.level, "lipschitz": CONE_LIPSCHITZ * self.lipschitz, "radius": self.radius}
        return cone_starts(field, self.origins, self.directions, clearance=self.reach, **cones)

    def _expected(self, t: float, value: Tensor) -> Expected | None:
        """The last hits, extrapolated in time, with the known values where rays begin."""
        if not self._frames:
            return None
        last = self._frames[-1]
        before = self._frames[0]
        depth = last.depth
        if before.time != last.time:
            moved = depth + (depth - before.depth) * ((t - last.time) / (last.time - before.time))
            depth = torch.where(moved.isfinite(), moved, depth)
        return Expected(depth, last.slope, value)
