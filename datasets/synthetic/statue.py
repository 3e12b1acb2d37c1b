"""The bundled sample: an owl with a staff on a fluted drum, as an implicit function."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import FunctionField, Jet
from . import solids
from .solids import Vector

_STAFF_HEAD: Vector = (0.330, -0.300, 0.68)
_EYE: Vector = (0.105, -0.225, 0.435)


class Statue(FunctionField):
    """An owl on a column, z up, facing -y, inside the unit sphere: one watertight connected solid.

    The implicit function is a smooth union of some thirty solids (see :mod:`solids`), negative inside. It is no
    distance: |∇f| is up to 1.4 on relief, and below 1 in narrow grooves. The thinnest part is the staff, of radius
    0.022.
    """

    def __init__(self) -> None:
        super().__init__(_statue)

    @property
    def same_rows(self) -> bool:
        """True: the function evaluates no other field."""
        return True

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """Implicit function at ``x`` ``(..., 3)`` → ``(...,)``."""
        evaluate = super().value
        return torch.cat([evaluate(part, level=level) for part in self._blocks(x)]).reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """Implicit function and its gradient at ``x`` ``(..., 3)``."""
        evaluate = super().jet
        value, gradient, _ = zip(*(evaluate(part, level=level) for part in self._blocks(x)), strict=True)
        shape = x.shape[:-1]
        return Jet(torch.cat(value).reshape(shape), torch.cat(gradient).reshape(x.shape), x.new_empty((*shape, 0)))

    def _blocks(self, x: Tensor) -> tuple[Tensor, ...]:
        """The points as rows, in blocks whose temporaries stay in cache."""
        return self.check_points(x).reshape(-1, 3).split(16384)

    def colors(self, points: NDArray[np.floating]) -> NDArray[np.float32]:
        """Procedural texture ``(N, 3)`` in [0, 1] at ``points`` ``(N, 3)``: plumage, gilt, amber and marble."""
        x = torch.from_numpy(np.asarray(points, np.float64))
        parts = _parts(x)
        z, y = x[:, 2], x[:, 1]
        veins = torch.sin(9 * x[:, 0] + 6 * z + 2.5 * torch.sin(7 * y + 5 * x[:, 0]) + 2 * torch.sin(11 * z))
        paints = {
            "plinth": _mix((0.86, 0.84, 0.80), (0.55, 0.53, 0.56), veins.abs() ** 6),
            "body": _mix((0.93, 0.84, 0.66), (0.45, 0.28, 0.16), torch.sigmoid(18 * (y + 0.04)) * 0.8)
            * (0.9 + 0.1 * torch.cos(46 * z))[:, None],
            "wings": _mix((0.36, 0.22, 0.14), (0.72, 0.52, 0.32), 0.5 + 0.5 * torch.sin(60 * _along_wing(x))),
            "face": _mix((0.97, 0.93, 0.84), (0.80, 0.66, 0.46), 0.5 + 0.5 * torch.cos(70 * z)),
            "eyes": _mix((0.04, 0.03, 0.03), (0.98, 0.66, 0.08), torch.sigmoid(300 * (_pupil(x) - 0.034))),
            "gilt": _mix((0.85, 0.63, 0.20), (0.98, 0.84, 0.45), 0.5 + 0.5 * torch.sin(40 * z)),
            "staff": _mix((0.30, 0.13, 0.10), (0.46, 0.22, 0.14), 0.5 + 0.5 * torch.sin(55 * z)),
        }
        distances = torch.stack([parts[name] for name in paints])
        weights = torch.softmax(-distances / 0.004, dim=0)  # soft edges, about a hundredth wide
        mixed = (weights[..., None] * torch.stack(list(paints.values()))).sum(dim=0)
        return mixed.clamp(0, 1).float().numpy()


def _statue(p: Tensor) -> Tensor:
    parts = _parts(p)
    owl = solids.smooth_union(parts["body"], parts["wings"], 0.03)
    owl = solids.smooth_union(owl, parts["face"], 0.02)
    owl = solids.smooth_union(owl, parts["eyes"], 0.008)
    whole = solids.smooth_union(owl, parts["plinth"], 0.02)
    whole = solids.smooth_union(whole, parts["staff"], 0.02)
    return solids.smooth_union(whole, parts["gilt"], 0.012)


def _parts(p: Tensor) -> dict[str, Tensor]:
    """The statue's differently coloured parts."""
    folded = solids.fold(p)
    return {
        "body": _body(folded),
        "wings": solids.smooth_union(_wing(folded), _arm(p), 0.05),
        "face": _face(folded),
        "eyes": _eye(folded),
        "plinth": _plinth(p),
        "staff": solids.round_cone(p, (0.235, -0.265, -0.38), _STAFF_HEAD, 0.022, 0.022),
        "gilt": solids.smooth_union(_gilt(folded), _staff_head(p), 0.01),
    }


def _body(p: Tensor) -> Tensor:
    trunk = solids.ellipsoid(p, (0.0, 0.02, -0.03), (0.29, 0.26, 0.38)) - _scales(p)
    head = solids.ellipsoid(p, (0.0, -0.02, 0.43), (0.265, 0.225, 0.21))
    owl = solids.smooth_union(trunk, head, 0.10)
    ears = solids.round_cone(p, (0.15, -0.05, 0.56), (0.245, -0.02, 0.80), 0.075, 0.022)
    owl = solids.smooth_union(owl, ears, 0.06)
    middle = solids.round_cone(p, (0.0, 0.20, -0.18), (0.0, 0.35, -0.56), 0.075, 0.035)
    outer = solids.round_cone(p, (0.05, 0.20, -0.18), (0.085, 0.33, -0.52), 0.065, 0.032)
    return solids.smooth_union(owl, solids.smooth_union(middle, outer, 0.01), 0.05)


def _scales(p: Tensor) -> Tensor:
    """Feathers: bumps in a quincunx, ``0.01 cos(10 θ + 34 z) cos(10 θ - 34 z)``."""
    angle, z = 10.0 * torch.atan2(p[:, 0], -p[:, 1]), 34.0 * p[:, 2]
    return _off_axis(p, 0.01 * torch.cos(angle + z) * torch.cos(angle - z))


def _off_axis(p: Tensor, relief: Tensor) -> Tensor:
    """A relief in cylinder coordinates, faded out by ρ²/(ρ² + 0.03²) near the axis."""
    squared = p[:, 0] ** 2 + p[:, 1] ** 2
    return squared / (squared + 0.03**2) * relief


def _along_wing(p: Tensor) -> Tensor:
    return 0.80 * p[:, 2] + 0.60 * p[:, 1]


def _wing(p: Tensor) -> Tensor:
    tilted = solids.tilt(p, (0.28, 0.06, 0.0), (0.30, -0.06, 0.16))
    blade = solids.ellipsoid(tilted, (0.28, 0.06, -0.02), (0.075, 0.20, 0.36))
    tip = solids.round_cone(p, (0.27, 0.14, -0.12), (0.20, 0.27, -0.45), 0.07, 0.028)
    return solids.smooth_union(blade, tip, 0.06) - 0.006 * torch.sin(60.0 * _along_wing(p))


def _arm(p: Tensor) -> Tensor:
    """The wing's leading edge, which holds the staff."""
    upper = solids.round_cone(p, (0.27, 0.0, 0.16), (0.345, -0.15, 0.02), 0.06, 0.045)
    lower = solids.round_cone(p, (0.345, -0.15, 0.02), (0.275, -0.285, 0.06), 0.045, 0.036)
    return solids.smooth_union(upper, lower, 0.03)


def _face(p: Tensor) -> Tensor:
    disc = solids.torus(p, _EYE, (0.30, -0.9539392, 0.0), 0.088, 0.024)
    brow = solids.round_cone(p, (0.016, -0.255, 0.470), (0.215, -0.135, 0.585), 0.036, 0.026)
    toes = solids.round_cone(p, (0.11, -0.08, -0.36), (0.055, -0.285, -0.378), 0.05, 0.026)
    for end in ((0.12, -0.31, -0.378), (0.19, -0.27, -0.378)):
        toes = solids.smooth_union(toes, solids.round_cone(p, (0.11, -0.08, -0.36), end, 0.05, 0.026), 0.015)
    return solids.smooth_union(solids.smooth_union(disc, brow, 0.02), toes, 0.02)


def _pupil(p: Tensor) -> Tensor:
    """Distance ``(N,)`` from the line of sight of the nearer eye."""
    return torch.stack((p[:, 0].abs() - _EYE[0] - 0.022, p[:, 2] - _EYE[2]), dim=1).norm(dim=1)


def _eye(p: Tensor) -> Tensor:
    ball = solids.ellipsoid(p, (_EYE[0], _EYE[1] + 0.01, _EYE[2]), (0.066, 0.066, 0.066))
    pupil = solids.ellipsoid(p, (_EYE[0] + 0.022, _EYE[1] - 0.062, _EYE[2]), (0.028, 0.028, 0.028))
    return solids.carve(ball, pupil, 0.01)


def _gilt(p: Tensor) -> Tensor:
    beak = solids.round_cone(p, (0.0, -0.235, 0.415), (0.0, -0.30, 0.315), 0.045, 0.021)
    chain = solids.torus(p, (0.0, -0.02, 0.215), (0.0, 0.25881905, 0.96592583), 0.232, 0.02)
    medal = solids.ellipsoid(p, (0.0, -0.262, 0.135), (0.06, 0.026, 0.06))
    return solids.smooth_union(beak, solids.smooth_union(chain, medal, 0.015), 0.01)


def _staff_head(p: Tensor) -> Tensor:
    ring = solids.torus(p, _STAFF_HEAD, (0.0, -1.0, 0.0), 0.095, 0.021)
    return solids.smooth_union(ring, solids.ellipsoid(p, _STAFF_HEAD, (0.045, 0.045, 0.045)), 0.01)


def _plinth(p: Tensor) -> Tensor:
    flutes = 0.011 * torch.cos(16.0 * torch.atan2(p[:, 1], p[:, 0]))
    shaft = solids.rounded_drum(p, (0.0, 0.0, -0.62), 0.25, 0.2, 0.01) - _off_axis(p, flutes)
    base = solids.rounded_box(p, (0.0, 0.0, -0.845), (0.285, 0.285, 0.04), 0.015)
    top = solids.rounded_drum(p, (0.0, 0.0, -0.425), 0.36, 0.03, 0.015)
    lower = solids.torus(p, (0.0, 0.0, -0.775), (0.0, 0.0, 1.0), 0.245, 0.033)
    upper = solids.torus(p, (0.0, 0.0, -0.475), (0.0, 0.0, 1.0), 0.275, 0.03)
    column = solids.smooth_union(shaft, solids.smooth_union(lower, upper, 0.01), 0.015)
    return solids.smooth_union(column, solids.smooth_union(base, top, 0.01), 0.015)


def _mix(a: Vector, b: Vector, t: Tensor) -> Tensor:
    first, second = t.new_tensor(a), t.new_tensor(b)
    return first + t[:, None] * (second - first)
