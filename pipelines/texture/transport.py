"""Texture transport: the colours of a surface that moves are those that its points had at the start.

Where they were is integrated back in time along the velocity that was learnt, or else for the vertices of a coarse
mesh; between these, points move by the affine map that fits the nearest ones best. Places that were on no surface have
averaged colours (`SpreadColors`). Colours of the end, where there are any, fade in with time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...neural_fields import Field, InputError, Similarity, TextureField, flow, load_field, map_colors
from ...neural_fields.meshing.extract import surface_of
from ...neural_fields.spacetime.dynamic_tracing import moment
from ...neural_fields.spacetime.evolution import VectorField
from ...neural_fields.spacetime.flow import IntegrationError, Solver
from ...neural_fields.spacetime.surface_velocity import CarriedVelocity
from ...neural_fields.tracing.sphere import project_to_surface
from ..training.folder import TEXTURE_FILE, find_field, load_motion
from .spread import CELL, SpreadColors
from .train import texture_of

# Points (N, 3) to display colours (N, 3).
Colors = Callable[[Tensor], Tensor]
# Points (N, 3) of a moment to where they were at another time, (N, 3).
Backward = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class TransportOptions:
    """How colours are carried; resolutions are cells along the mesher's box."""

    # of Runge-Kutta 4 along the surface's own velocity; fixed, or it vanishes near changes of topology
    step: float = 0.05
    learned_step: float = 1 / 12  # along a velocity that was learnt, which is smooth
    rows: int = 8192  # points that are carried along that at once
    carried: int = 48  # resolution of the mesh whose vertices are carried
    neighbors: int = 8  # of these, which a point between them looks to
    ridge: float = 1e-3  # share of the neighbours' spread that regularises the affine map across their plane
    checked: int = 48  # resolution of the mesh on which a texture is compared with the start
    # mean distance of its vertices from the texture's surface up to which they are the same, in field units
    astray: float = 0.03
    spread: int = 128  # resolution of the mesh from which colours are spread


TRANSPORT = TransportOptions()


def start_colors(run: str | Path, field: Field) -> Colors | None:
    """The colours beside a run, of its ``field`` or, if that moves, of its surface at time 0; None without a texture.

    Raises:
        InputError: the texture is damaged or belongs to another field.
    """
    texture = texture_of(run, field if field.in_dim == 3 else moment(field, 0.0))
    return None if texture is None else texture_colors(texture)


def borrowed_colors(run: str | Path, field: Field, similarity: Similarity) -> Colors:
    """The colours of a run that does not move, for the start of a motion.

    ``similarity`` is the way from input coordinates to those of the four-dimensional ``field``. Errors are those of
    `shape_colors`.
    """
    geometry, own, _ = load_field(find_field(run), device=field.deltas.device)
    placed = own.within(similarity)

    def home(points: Tensor) -> Tensor:
        return (points - points.new_tensor(placed.center)) / placed.scale

    return shape_colors("--colors", run, geometry, field, 0.0, home)


def shape_colors(flag: str, run: str | Path, geometry: Field, field: Field, time: float, home: Backward) -> Colors:
    """The colours of a run with this ``geometry``, for the ``time`` 0 or 1 of a ``field`` that moves.

    ``home`` brings points ``(N, 3)`` of the motion at that time into the run's coordinates.

    Raises:
        InputError: it has no texture, or its surface is not that of the field then; the message names the ``flag``.
    """
    texture = texture_of(find_field(run), geometry) if geometry.in_dim == 3 else None
    if texture is None:
        raise InputError(f"{flag} {run}: has no texture; make one with `mplicits texture {run} COLORS`")
    colors = texture_colors(texture)
    if (mesh := surface_of(moment(field, time), resolution=TRANSPORT.checked)) is not None:
        points = home(torch.from_numpy(mesh.vertices).to(field.like))
        points = points[points.norm(dim=-1) < 1]  # what the texture's fit says elsewhere is no surface of anything
        if not len(points) or float(geometry.value(points).abs().mean()) > TRANSPORT.astray:
            which = ("starts", "first") if time == 0 else ("ends", "last")
            raise InputError(f"{flag} {run}: is not where the motion {which[0]}; name the run of its {which[1]} shape")
    return lambda points: colors(home(points))


class TransportedPoints:
    """Where points of a surface that moves were at time 0, or will be at another.

    They go along the velocity (``motion``) that the run has learnt, or else along the normal speeds
    (`CarriedVelocity`).
    """

    def __init__(self, field: Field, *, level: int = -1, motion: VectorField | None = None) -> None:
        self._field, self._level, self._motion = field, level, motion

    @torch.no_grad()
    def home(self, time: float, to: float = 0.0) -> Backward:
        """The way from one time to another, for points ``(N, 3)`` of the surface at the first.

        Where surface is made or vanishes on the way they arrive beside the other surface. InputError: they cannot be
        followed.
        """
        if time == to:
            return lambda points: points
        if (motion := self._motion) is not None:
            return lambda points: torch.cat(
                [
                    flow(motion, part, time, to, solver=Solver("rk4", step=TRANSPORT.learned_step))
                    for part in points.split(TRANSPORT.rows)
                ]
                or [points]
            )
        mesh = surface_of(moment(self._field, time), resolution=TRANSPORT.carried, level=self._level)
        if mesh is None:
            return lambda points: points  # there is nothing that could have come from anywhere
        vertices = torch.from_numpy(mesh.vertices).to(self._field.like)
        try:
            solver = Solver("rk4", step=TRANSPORT.step)
            displacement = flow(self._velocity, vertices, time, to, solver=solver) - vertices
        except IntegrationError as error:
            raise InputError(f"colours cannot be transported to time {time:.3g} ({error}); leave them out") from error
        interpolation = _Interpolation(mesh.vertices, displacement.double().cpu().numpy())
        return lambda points: points + torch.from_numpy(interpolation(points.double().cpu().numpy())).to(points)

    @cached_property
    def _velocity(self) -> CarriedVelocity:
        return CarriedVelocity(self._field, level=self._level)


class TransportedColors:
    """The colours of a surface that moves: those that its points had ``first``, at time 0.

    ``last`` are colours at time 1, for a blend: they weigh t, those of the start 1 − t. ``motion`` is the velocity that
    was learnt; see `TransportedPoints`.
    """

    def __init__(
        self,
        field: Field,
        first: Colors,
        *,
        last: Colors | None = None,
        level: int = -1,
        motion: VectorField | None = None,
    ) -> None:
        self._points = TransportedPoints(field, level=level, motion=motion)
        self._ends = [_Pinned(field, 0.0, first, level)]
        if last is not None:
            self._ends.append(_Pinned(field, 1.0, last, level))

    def at(self, time: float) -> Colors:
        """The colours of points of the surface at a time; InputError if the points cannot be followed."""
        shares = [1.0] if len(self._ends) == 1 else [1 - time, time]
        for end in self._ends:
            if time == end.time:
                return end.colors
        parts = [(share, end, self._points.home(time, end.time)) for share, end in zip(shares, self._ends, strict=True)]

        @torch.no_grad()
        def colors(points: Tensor) -> Tensor:
            return torch.stack([share * end(home(points)) for share, end, home in parts]).sum(dim=0)

        return colors


class _Pinned:
    """Colours that a surface has at one moment, and of places beside it."""

    def __init__(self, field: Field, time: float, colors: Colors, level: int) -> None:
        self._still, self.time, self.colors, self._level = moment(field, time), time, colors, level

    def __call__(self, points: Tensor) -> Tensor:
        """Colours ``(N, 3)`` of points ``(N, 3)``, on the surface or about there."""
        if not len(points):
            return self.colors(points)
        away = self._still.value(points, level=self._level).abs()
        feet, arrived = project_to_surface(self._still, points, level=self._level)
        own = self.colors(feet)
        if self._spread is None:
            return own
        # Within half a cell the texture speaks, from one cell on the average.
        share = (2 * away / CELL - 1).clamp(0, 1).masked_fill(~arrived, 1.0)
        share = (share.square() * (3 - 2 * share))[:, None]
        return torch.lerp(own, self._spread(points, away).to(own), share)

    @cached_property
    def _spread(self) -> SpreadColors | None:
        """None without a surface."""
        mesh = surface_of(self._still, resolution=TRANSPORT.spread, level=self._level)
        if mesh is None:
            return None
        points = project_to_surface(self._still, torch.from_numpy(mesh.vertices).to(self._still.like))[0]
        return SpreadColors(points, self.colors(points))


def texture_colors(texture: TextureField) -> Colors:
    """The colours of a texture at points ``(N, 3)`` near its surface."""
    return lambda points: map_colors(texture, points).values


class _Interpolation:
    """Displacements interpolated from those of points ``(V, 3)``, by weighted affine least squares."""

    def __init__(self, points: NDArray[np.floating], displacement: NDArray[np.float64]) -> None:
        self._tree, self._points, self._displacement = KDTree(points), np.asarray(points, np.float64), displacement

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacements ``(N, 3)`` of points ``(N, 3)``."""
        away, near = self._tree.query(x, k=min(TRANSPORT.neighbors, len(self._points)), workers=-1)
        away, near = np.reshape(away, (len(x), -1)), np.reshape(near, (len(x), -1))
        weights = 1 / (away**2 + 0.1 * away[:, -1:] ** 2 + 1e-20)
        weights = (weights / weights.sum(axis=1, keepdims=True))[..., None]
        places, shifts = self._points[near], self._displacement[near]
        place, shift = (weights * places).sum(axis=1), (weights * shifts).sum(axis=1)
        across = places - place[:, None]
        spread = np.einsum("nki,nkj->nij", weights * across, across)
        spread += (TRANSPORT.ridge * np.trace(spread, axis1=1, axis2=2) + 1e-20)[:, None, None] * np.eye(3)
        slope = np.linalg.solve(spread, np.einsum("nki,nkj->nij", weights * across, shifts - shift[:, None]))
        return shift + np.einsum("ni,nij->nj", x - place, slope)


def colors_of_run(run: str | Path, field: Field, time: float | None) -> Colors | None:
    """The colours of what `load_still` has loaded, or None; ``time`` is the moment of a field that moves, else None.

    Raises:
        InputError: the texture is damaged or belongs to another field.
    """
    if not find_field(run).with_name(TEXTURE_FILE).is_file():
        return None
    moving = None if time is None else load_field(find_field(run), device=field.deltas.device).field
    colors = start_colors(run, field if moving is None else moving)
    if colors is None or moving is None or time is None:
        return colors
    motion = load_motion(find_field(run))
    return TransportedColors(moving, colors, motion=None if motion is None else motion.to(moving.like)).at(time)
