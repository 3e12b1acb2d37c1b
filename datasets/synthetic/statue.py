"""The bundled sample: an owl with a staff on a fluted drum, as an implicit function."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import Jet
from ...neural_fields.fields.field import OneLevelField
from . import solids
from .solids import Solid, Vector

Float64 = NDArray[np.float64]

_STAFF_HEAD: Vector = (0.330, -0.300, 0.68)
_EYE: Vector = (0.105, -0.225, 0.435)


class Statue(OneLevelField):
    """An owl on a column, z up, facing -y, inside the unit sphere: one watertight connected solid.

    The implicit function is a smooth union of some thirty solids (see :mod:`solids`), negative inside. It is no
    distance: |∇f| is up to 1.4 on relief, and below 1 in narrow grooves. The thinnest part is the staff, of radius
    0.022.
    """

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """Implicit function at ``x`` ``(..., 3)`` → ``(...,)``."""
        self.resolve_level(level)
        return self._evaluate(self.check_points(x)).value.reshape(x.shape[:-1])

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """Implicit function and its closed-form gradient at ``x`` ``(..., 3)``."""
        self.resolve_level(level)
        solid = self._evaluate(self.check_points(x))
        value, gradient = solid.value.reshape(x.shape[:-1]), solid.gradient.reshape(x.shape)
        return Jet(value, gradient, x.new_empty((*x.shape[:-1], 0)))

    def _evaluate(self, x: Tensor) -> Solid:
        rows = x.reshape(-1, 3)
        # The temporaries of a block of this size stay in cache.
        blocks = [_statue(block) for block in rows.split(16384)] if len(rows) else [Solid(rows[:, 0], rows)]
        return Solid(torch.cat([b.value for b in blocks]), torch.cat([b.gradient for b in blocks]))

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
        distances = torch.stack([parts[name].value for name in paints])
        weights = torch.softmax(-distances / 0.004, dim=0)  # soft edges, about a hundredth wide
        mixed = (weights[..., None] * torch.stack(list(paints.values()))).sum(dim=0)
        return mixed.clamp(0, 1).float().numpy()


def _statue(p: Tensor) -> Solid:
    parts = _parts(p)
    owl = solids.smooth_union(parts["body"], parts["wings"], 0.03)
    owl = solids.smooth_union(owl, parts["face"], 0.02)
    owl = solids.smooth_union(owl, parts["eyes"], 0.008)
    whole = solids.smooth_union(owl, parts["plinth"], 0.02)
    whole = solids.smooth_union(whole, parts["staff"], 0.02)
    return solids.smooth_union(whole, parts["gilt"], 0.012)


def _parts(p: Tensor) -> dict[str, Solid]:
    """The statue's differently coloured parts."""
    folded, sign = solids.fold(p)

    def mirrored(solid: Solid) -> Solid:
        return Solid(solid.value, solid.gradient * sign)

    return {
        "body": mirrored(_body(folded)),
        "wings": solids.smooth_union(mirrored(_wing(folded)), _arm(p), 0.05),
        "face": mirrored(_face(folded)),
        "eyes": mirrored(_eye(folded)),
        "plinth": _plinth(p),
        "staff": solids.round_cone(p, (0.235, -0.265, -0.38), _STAFF_HEAD, 0.022, 0.022),
        "gilt": solids.smooth_union(mirrored(_gilt(folded)), _staff_head(p), 0.01),
    }


def _body(p: Tensor) -> Solid:
    trunk = solids.ellipsoid(p, (0.0, 0.02, -0.03), (0.29, 0.26, 0.38))
    trunk = solids.displace(trunk, _scales(p))
    head = solids.ellipsoid(p, (0.0, -0.02, 0.43), (0.265, 0.225, 0.21))
    owl = solids.smooth_union(trunk, head, 0.10)
    ears = solids.round_cone(p, (0.15, -0.05, 0.56), (0.245, -0.02, 0.80), 0.075, 0.022)
    owl = solids.smooth_union(owl, ears, 0.06)
    middle = solids.round_cone(p, (0.0, 0.20, -0.18), (0.0, 0.35, -0.56), 0.075, 0.035)
    outer = solids.round_cone(p, (0.05, 0.20, -0.18), (0.085, 0.33, -0.52), 0.065, 0.032)
    return solids.smooth_union(owl, solids.smooth_union(middle, outer, 0.01), 0.05)


def _scales(p: Tensor, *, height: float = 0.010, around: float = 10.0, up: float = 34.0) -> Solid:
    """Feathers: bumps in a quincunx, ``height · cos(around θ + up z) · cos(around θ - up z)``."""
    angle, z = around * torch.atan2(p[:, 0], -p[:, 1]), up * p[:, 2]
    a, b = torch.cos(angle + z), torch.cos(angle - z)
    da, db = -torch.sin(angle + z), -torch.sin(angle - z)
    return _around_axis(p, height * a * b, height * around * (da * b + a * db), height * up * (da * b - a * db))


def _around_axis(p: Tensor, relief: Tensor, by_angle: Tensor, by_height: Tensor, *, core: float = 0.03) -> Solid:
    """A relief in cylinder coordinates with its derivatives, faded out by ρ²/(ρ² + core²) near the axis."""
    x, y, _ = p.unbind(dim=1)
    squared = x * x + y * y
    around = by_angle / (squared + core**2)  # dθ = (-y dx + x dy) / ρ², and the fade cancels ρ²
    fade = squared / (squared + core**2)
    fading = 2 * core**2 / (squared + core**2) ** 2 * relief
    return Solid(
        fade * relief, torch.stack((x * fading - y * around, y * fading + x * around, fade * by_height), dim=1)
    )


def _along_wing(p: Tensor) -> Tensor:
    return 0.80 * p[:, 2] + 0.60 * p[:, 1]


def _wing(p: Tensor) -> Solid:
    q, back = solids.tilt(p, (0.28, 0.06, 0.0), (0.30, -0.06, 0.16))
    blade = solids.ellipsoid(q, (0.28, 0.06, -0.02), (0.075, 0.20, 0.36))
    wing = Solid(blade.value, blade.gradient @ back)
    tip = solids.round_cone(p, (0.27, 0.14, -0.12), (0.20, 0.27, -0.45), 0.07, 0.028)
    wing = solids.smooth_union(wing, tip, 0.06)
    frequency, height = 60.0, 0.006
    phase = frequency * _along_wing(p)
    slope = height * frequency * torch.cos(phase)
    return solids.displace(wing, Solid(height * torch.sin(phase), slope[:, None] * p.new_tensor((0.0, 0.60, 0.80))))


def _arm(p: Tensor) -> Solid:
    """The wing's leading edge, which holds the staff."""
    upper = solids.round_cone(p, (0.27, 0.0, 0.16), (0.345, -0.15, 0.02), 0.06, 0.045)
    lower = solids.round_cone(p, (0.345, -0.15, 0.02), (0.275, -0.285, 0.06), 0.045, 0.036)
    return solids.smooth_union(upper, lower, 0.03)


def _face(p: Tensor) -> Solid:
    disc = solids.torus(p, _EYE, (0.30, -0.9539392, 0.0), 0.088, 0.024)
    brow = solids.round_cone(p, (0.016, -0.255, 0.470), (0.215, -0.135, 0.585), 0.036, 0.026)
    toes = solids.round_cone(p, (0.11, -0.08, -0.36), (0.055, -0.285, -0.378), 0.05, 0.026)
    for end in ((0.12, -0.31, -0.378), (0.19, -0.27, -0.378)):
        toes = solids.smooth_union(toes, solids.round_cone(p, (0.11, -0.08, -0.36), end, 0.05, 0.026), 0.015)
    return solids.smooth_union(solids.smooth_union(disc, brow, 0.02), toes, 0.02)


def _pupil(p: Tensor) -> Tensor:
    """Distance ``(N,)`` from the line of sight of the nearer eye."""
    q = torch.stack((p[:, 0].abs() - _EYE[0] - 0.022, p[:, 2] - _EYE[2]), dim=1)
    return q.norm(dim=1)


def _eye(p: Tensor) -> Solid:
    ball = solids.ellipsoid(p, (_EYE[0], _EYE[1] + 0.01, _EYE[2]), (0.066, 0.066, 0.066))
    pupil = solids.ellipsoid(p, (_EYE[0] + 0.022, _EYE[1] - 0.062, _EYE[2]), (0.028, 0.028, 0.028))
    return solids.carve(ball, pupil, 0.01)


def _gilt(p: Tensor) -> Solid:
    beak = solids.round_cone(p, (0.0, -0.235, 0.415), (0.0, -0.30, 0.315), 0.045, 0.021)
    chain = solids.torus(p, (0.0, -0.02, 0.215), (0.0, 0.25881905, 0.96592583), 0.232, 0.02)
    medal = solids.ellipsoid(p, (0.0, -0.262, 0.135), (0.06, 0.026, 0.06))
    return solids.smooth_union(beak, solids.smooth_union(chain, medal, 0.015), 0.01)


def _staff_head(p: Tensor) -> Solid:
    ring = solids.torus(p, _STAFF_HEAD, (0.0, -1.0, 0.0), 0.095, 0.021)
    return solids.smooth_union(ring, solids.ellipsoid(p, _STAFF_HEAD, (0.045, 0.045, 0.045)), 0.01)


def _plinth(p: Tensor) -> Solid:
    shaft = solids.rounded_drum(p, (0.0, 0.0, -0.62), 0.25, 0.2, 0.01)
    flutes, height = 16.0, 0.011
    angle = flutes * torch.atan2(p[:, 1], p[:, 0])
    ripple = _around_axis(p, height * torch.cos(angle), -height * flutes * torch.sin(angle), torch.zeros_like(angle))
    shaft = solids.displace(shaft, ripple)
    base = solids.rounded_box(p, (0.0, 0.0, -0.845), (0.285, 0.285, 0.04), 0.015)
    top = solids.rounded_drum(p, (0.0, 0.0, -0.425), 0.36, 0.03, 0.015)
    lower = solids.torus(p, (0.0, 0.0, -0.775), (0.0, 0.0, 1.0), 0.245, 0.033)
    upper = solids.torus(p, (0.0, 0.0, -0.475), (0.0, 0.0, 1.0), 0.275, 0.03)
    column = solids.smooth_union(shaft, solids.smooth_union(lower, upper, 0.01), 0.015)
    return solids.smooth_union(column, solids.smooth_union(base, top, 0.01), 0.015)


def _mix(a: Vector, b: Vector, t: Tensor) -> Tensor:
    first, second = t.new_tensor(a), t.new_tensor(b)
    return first + t[:, None] * (second - first)
