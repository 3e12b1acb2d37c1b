"""A textured corner of a room: wall, floor, crate, bowl and rod, to measure surfaces from photographs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from ...neural_fields.backend.arrays import Float64
from . import solids
from .solids import Vector


@dataclass(frozen=True)
class Corner:
    """Where its parts stand, in radii of the region and radians, and the noise of its texture."""

    turn: Vector = (0.06, 0.2, 0.03)  # marching cubes would be exact on faces along the axes
    crate: Vector = (0.26, -0.21, 0.05)
    bowl: Vector = (-0.26, -0.13, 0.1)  # middle of the sphere that is taken from its block
    plain: float = 0.3  # the wall right of this has no texture
    octaves: int = 6
    lattice: int = 32  # points along a side, then the noise repeats
    finest: float = 0.006  # cell of the finest octave
    contrast: float = 0.5


CORNER = Corner()
turned = partial(solids.tilt, center=(0.0, 0.0, 0.0), angles=CORNER.turn)  # points (N, 3) in the axes of wall and floor


def corner(p: Tensor) -> Tensor:
    """Signed distance ``(...,)`` of points ``(..., 3)``, inside the unit sphere, y up, open to +z.

    Exact outside, but for the bowl, where it is a bound. The rod has a radius of 0.012, the crate edges of 0.32.
    """
    q = turned(p.reshape(-1, 3))
    block = solids.rounded_box(q, (-0.26, -0.25, 0.1), (0.17, 0.12, 0.17), 0.0)
    parts = [
        solids.rounded_box(q, (0.0, 0.05, -0.36), (0.6, 0.43, 0.06), 0.0),
        solids.rounded_box(q, (0.0, -0.4, 0.0), (0.6, 0.04, 0.42), 0.0),
        solids.rounded_box(solids.tilt(q, CORNER.crate, (0.0, 0.6, 0.0)), CORNER.crate, (0.16, 0.16, 0.16), 0.0),
        torch.maximum(block, -solids.ellipsoid(q, CORNER.bowl, (0.13, 0.13, 0.13))),
        solids.round_cone(q, (-0.02, -0.4, 0.26), (0.04, 0.3, 0.16), 0.012, 0.012),
    ]
    return torch.stack(parts).amin(dim=0).reshape(p.shape[:-1])


def corner_colors(points: Float64) -> Float64:
    """Display RGB ``(N, 3)`` of points ``(N, 3)``: smooth noise of six octaves; part of the wall is plain.

    Each octave is a cubic B-spline over random numbers on a lattice of its own direction (Perlin 1985).
    """
    sums = np.zeros_like(points)
    for octave in range(CORNER.octaves):
        random = np.random.default_rng(octave)
        axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
        grey, hue = random.normal(size=(CORNER.lattice,) * 3), random.normal(size=(3, *(CORNER.lattice,) * 3))
        places = (points @ axes / (CORNER.finest * 2**octave)).T
        for channel in range(3):
            numbers = grey + 0.4 * hue[channel]
            sums[:, channel] += ndimage.map_coordinates(numbers, places, order=3, mode="grid-wrap", prefilter=False)
    right, _, front = turned(torch.from_numpy(points)).numpy().T
    plain = (right > CORNER.plain) & (front < -0.29)
    paint = np.array((0.58, 0.52, 0.45))
    return np.where(plain[:, None], paint, paint + 0.4 * np.tanh(CORNER.contrast * sums))
