"""Colours that ride along with a surface that moves: a texture is asked where a point was at the start.

Where it was is integrated back in time for the vertices of a coarse mesh of the moment. What lies between them moves by
the affine map that fits the nearest ones best, and is then laid onto the surface of the start: displacements are
smooth, colours need not be.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ...neural_fields import (
    Field,
    InputError,
    IntegrationError,
    Similarity,
    Solver,
    TextureField,
    extract_mesh,
    flow,
    load_field,
    map_colors,
)
from ...neural_fields.attributes import project_to_surface
from ...neural_fields.carried import CarriedVelocity
from ...neural_fields.dynamic_tracing import moment
from ...neural_fields.evolution import VectorField
from ...neural_fields.meshing import NoSurfaceError
from ..run.folder import find_field
from ..run.motion import load_motion
from .train import texture_of

__all__ = [
    "RIDE",
    "Colors",
    "Homeward",
    "RidingColors",
    "RidingPoints",
    "borrowed_texture",
    "colors_of_run",
    "start_texture",
]

# Points (N, 3) to display colours (N, 3).
Colors = Callable[[Tensor], Tensor]
# Points (N, 3) of a moment to where they were at time 0, (N, 3).
Homeward = Callable[[Tensor], Tensor]
# A fixed step: near a change of topology adaptive ones would shrink to nothing, for the sake of a few points.
RIDE = Solver(method="rk4", step=0.05)
# Along a velocity that was learnt: smooth, so that in float32 more steps are no nearer; so many points at once.
ALONG, ROWS = Solver(method="rk4", step=1 / 12), 8192
# The mesh whose vertices are carried, in cells along the box, and how many of them a point looks to.
CARRIED = 48
NEIGHBORS = 8
# Neighbours lie nearly in a plane: across it the affine map is held back by this share of their spread.
RIDGE = 1e-3
# Whether a texture is that of the start is looked at on so coarse a mesh; its vertices may be this far off on average.
CHECKED = 48
ASTRAY = 0.03


def start_texture(run: str | Path, field: Field) -> TextureField | None:
    """The texture beside a run, of its surface or, if that moves, of its surface at time 0; None without one.

    Args:
        run: run directory or .safetensors file.
        field: its field, three- or four-dimensional.

    Raises:
        InputError: the texture is damaged or belongs to another field.
    """
    return texture_of(run, field if field.in_dim == 3 else moment(field, 0.0))


def borrowed_texture(run: str | Path, field: Field, similarity: Similarity) -> tuple[TextureField, Similarity]:
    """The texture of a run that does not move, for the start of a motion.

    Args:
        run: run directory or .safetensors file.
        field: four-dimensional.
        similarity: the way from its coordinates to input coordinates.

    Returns:
        The texture, on the field's device, and the similarity that brings its coordinates into the field's.

    Raises:
        InputError: it has no texture, or its surface is not that of the field at time 0.
    """
    file = find_field(run)
    geometry, own, _ = load_field(file, device=field.deltas.device)
    texture = texture_of(file, geometry) if geometry.in_dim == 3 else None
    if texture is None:
        raise InputError(f"--colors {run}: has no texture; make one with `mplicits texture {run} COLORS`")
    center = (np.asarray(own.center) - similarity.center) / similarity.scale
    placed = Similarity((center[0], center[1], center[2]), own.scale / similarity.scale)
    try:
        start = extract_mesh(moment(field, 0.0), resolution=CHECKED, normals=False).vertices
    except NoSurfaceError:
        return texture, placed  # there is nothing to be coloured yet
    points = torch.from_numpy(placed.to_unit(start)).to(field.like)
    points = points[points.norm(dim=-1) < 1]  # what the texture's fit says elsewhere is no surface of anything
    if not len(points) or float(geometry.value(points).abs().mean()) > ASTRAY:
        raise InputError(f"--colors {run}: is not where the motion starts; name the run of its first shape")
    return texture, placed


class RidingPoints:
    """Where points of a surface that moves were at time 0.

    They go along the velocity that the run has learnt, or else along what the normal speeds say (`CarriedVelocity`).

    Args:
        field: four-dimensional.
        level: whose surface.
        motion: the velocity that was learnt.
    """

    def __init__(self, field: Field, *, level: int = -1, motion: VectorField | None = None) -> None:
        self._field, self._level, self._motion = field, level, motion

    @torch.no_grad()
    def home(self, time: float) -> Homeward:
        """The way back from a time, for points ``(N, 3)`` of its surface.

        Raises:
            InputError: the points cannot be followed back.
        """
        if time == 0:
            return lambda points: points
        if self._motion is not None:
            return self._along(self._motion, time)
        try:
            mesh = extract_mesh(moment(self._field, time), resolution=CARRIED, level=self._level, normals=False)
        except NoSurfaceError:
            return lambda points: points  # there is nothing that could have come from anywhere
        vertices = torch.from_numpy(mesh.vertices).to(self._field.like)
        try:
            displacement = flow(self._velocity, vertices, time, 0.0, solver=RIDE) - vertices
        except IntegrationError as error:
            raise InputError(f"colours cannot ride along to time {time:.3g} ({error}); leave them out") from error
        between = _Between(mesh.vertices, displacement.double().cpu().numpy())

        def moved(points: Tensor) -> Tensor:
            return points + torch.from_numpy(between(points.double().cpu().numpy())).to(points)

        return self._onto_start(moved)

    def _along(self, motion: VectorField, time: float) -> Homeward:
        def moved(points: Tensor) -> Tensor:
            return torch.cat([flow(motion, part, time, 0.0, solver=ALONG) for part in points.split(ROWS)])

        return self._onto_start(moved)

    def _onto_start(self, moved: Homeward) -> Homeward:
        """What has moved nearly to the surface of the start, on it."""
        start = moment(self._field, 0.0)

        @torch.no_grad()
        def home(points: Tensor) -> Tensor:
            return project_to_surface(start, moved(points), level=self._level)[0] if len(points) else points

        return home

    @cached_property
    def _velocity(self) -> CarriedVelocity:
        return CarriedVelocity(self._field, level=self._level)


class RidingColors:
    """The colours of a surface that moves: those that its points had at time 0.

    Args:
        field: four-dimensional.
        texture: of its surface at time 0.
        placed: from the texture's coordinates to the field's.
        level: whose surface.
        motion: the velocity that was learnt; see `RidingPoints`.
    """

    def __init__(
        self,
        field: Field,
        texture: TextureField,
        *,
        placed: Similarity | None = None,
        level: int = -1,
        motion: VectorField | None = None,
    ) -> None:
        self._points, self._texture = RidingPoints(field, level=level, motion=motion), texture
        self._placed = placed or Similarity.identity()

    def at(self, time: float) -> Colors:
        """The colours of points of the surface at a time.

        Raises:
            InputError: the points cannot be followed back.
        """
        home = self._points.home(time)
        return lambda points: self._of_start(home(points))

    @torch.no_grad()
    def _of_start(self, points: Tensor) -> Tensor:
        """The colours of points of the surface at time 0."""
        center = points.new_tensor(self._placed.center)
        return map_colors(self._texture, (points - center) / self._placed.scale).values


class _Between:
    """Displacements between the points ``(V, 3)`` at which they are known: weighted affine least squares."""

    def __init__(self, points: NDArray[np.floating], displacement: NDArray[np.float64]) -> None:
        self._tree, self._points, self._displacement = KDTree(points), np.asarray(points, np.float64), displacement

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacements ``(N, 3)`` of points ``(N, 3)``."""
        away, near = self._tree.query(x, k=min(NEIGHBORS, len(self._points)), workers=-1)
        away, near = np.reshape(away, (len(x), -1)), np.reshape(near, (len(x), -1))
        weights = 1 / (away**2 + 0.1 * away[:, -1:] ** 2 + 1e-20)
        weights = (weights / weights.sum(axis=1, keepdims=True))[..., None]
        places, shifts = self._points[near], self._displacement[near]
        place, shift = (weights * places).sum(axis=1), (weights * shifts).sum(axis=1)
        across = places - place[:, None]
        spread = np.einsum("nki,nkj->nij", weights * across, across)
        spread += (RIDGE * np.trace(spread, axis1=1, axis2=2) + 1e-20)[:, None, None] * np.eye(3)
        slope = np.linalg.solve(spread, np.einsum("nki,nkj->nij", weights * across, shifts - shift[:, None]))
        return shift + np.einsum("ni,nij->nj", x - place, slope)


def colors_of_run(run: str | Path, field: Field, time: float | None) -> Colors | None:
    """The colours of what `load_still` has loaded, or None.

    Args:
        run: run directory or .safetensors file.
        field: the field that does not move, or the moment of one that does.
        time: that moment; None for a field that does not move.

    Raises:
        InputError: the texture is damaged or belongs to another field.
    """
    moving = None if time is None else load_field(find_field(run), device=field.deltas.device).field
    texture = start_texture(run, field if moving is None else moving)
    if texture is None:
        return None
    if moving is None or time is None:
        return lambda points: map_colors(texture, points).values
    motion = load_motion(find_field(run))
    return RidingColors(moving, texture, motion=None if motion is None else motion.to(moving.like)).at(time)
