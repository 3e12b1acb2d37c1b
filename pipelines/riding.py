"""Colours that ride along with a surface that moves: a texture is asked where a point was at the start."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..neural_fields import (
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
from ..neural_fields.attributes import project_to_surface
from ..neural_fields.carried import CarriedVelocity
from ..neural_fields.dynamic_tracing import moment
from ..neural_fields.meshing import NoSurfaceError
from .runs import find_field
from .texture import texture_of

__all__ = ["RIDE", "Colors", "RidingColors", "borrowed_texture", "colors_at", "start_texture"]

# Points (N, 3) to display colours (N, 3).
Colors = Callable[[Tensor], Tensor]
# A fixed step: near a change of topology adaptive ones would shrink to nothing, for the sake of a few points.
RIDE = Solver(method="rk4", step=0.05)
ROWS = 1 << 16
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
    points = torch.from_numpy(placed.to_unit(start)).to(field.deltas)
    if float(geometry.value(points).abs().mean()) > ASTRAY:
        raise InputError(f"--colors {run}: is not where the motion starts; name the run of its first shape")
    return texture, placed


class RidingColors:
    """The colours of a surface that moves: its points go back with it (see `CarriedVelocity`) to time 0.

    Args:
        field: four-dimensional.
        texture: of its surface at time 0.
        placed: from the texture's coordinates to the field's.
        level: whose surface.
    """

    def __init__(
        self, field: Field, texture: TextureField, *, placed: Similarity | None = None, level: int = -1
    ) -> None:
        self._field, self._texture, self._level = field, texture, level
        self._placed = placed or Similarity.identity()

    def at(self, time: float) -> Colors:
        """The colours of points of the surface at a time."""
        return lambda points: self._colors(points, time)

    @torch.no_grad()
    def _colors(self, points: Tensor, time: float) -> Tensor:
        if time == 0 or not len(points):
            return self._of_start(points)
        start = moment(self._field, 0.0)
        try:
            back = [flow(self._velocity, part, time, 0.0, solver=RIDE) for part in points.split(ROWS)]
        except IntegrationError as error:
            raise InputError(f"colours cannot ride along to time {time:.3g} ({error}); leave them out") from error
        moved = [project_to_surface(start, part, level=self._level)[0] for part in back]
        return self._of_start(torch.cat(moved))

    def _of_start(self, points: Tensor) -> Tensor:
        """The colours of points of the surface at time 0."""
        center = points.new_tensor(self._placed.center)
        return map_colors(self._texture, (points - center) / self._placed.scale).values

    @cached_property
    def _velocity(self) -> CarriedVelocity:
        return CarriedVelocity(self._field, level=self._level)


def colors_at(run: str | Path, field: Field, time: float | None) -> Colors | None:
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
    return RidingColors(moving, texture).at(time)
