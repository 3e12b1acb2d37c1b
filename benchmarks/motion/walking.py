"""A figure that walks, in closed form: hips and knees bend, and the chest turns against them.

The motion of a leg is that of two beams (`figures.Bending`), in planes of constant y: first the knee bends, then the
hip. Angles depend on y only between the legs, where a weight w(y) goes from −1 to 1, so each leg has its own and its
parts are rigid:

    hip   a sin(2πt) w(y)                             forward with one leg, backward with the other
    knee  −b sin²(2πt) (1.2 + w(y) sin(2πt)) / 2.2     most of it in the leg that goes forward

With x' = Φ(x, κ(y, t)) in such a plane and J = ∂Φ/∂x, a covector g becomes J⁻ᵀ g there, and its y component loses
∂κ/∂y ⟨∂Φ/∂κ, J⁻ᵀ g⟩.
"""

from __future__ import annotations

import math

import torch
from mplicits.datasets.synthetic import solids
from mplicits.neural_fields import FunctionField
from torch import Tensor

from .figures import DeformingField, arc, arc_slopes, straightened

_WAIST = 0.06  # above it the chest turns, below it legs bend
_TURNS = (0.1, 0.4)  # heights between which the turn of the chest grows
_HIP, _KNEE = (-0.05, 0.08), (-0.38, 0.08)  # height of the middle of a joint's arc, and half its length
_BETWEEN = 0.04  # |y| from which on points belong to one leg
_STRAIGHT = 1e-6  # least curvature, as of `figures.Bending`


class _Joint:
    """A bend of what lies below a height, in planes of x and z, by a curvature κ of any sign."""

    def __init__(self, height: float, half: float) -> None:
        self.height, self.half = height, half

    def forward(self, x: Tensor, kappa: Tensor) -> Tensor:
        across, along, beyond, phi = self._parts(x, kappa)
        side, up = arc(phi)
        down = along * up - across * phi.sin() + beyond * phi.cos() - self.half
        return self._placed(along * side + across * phi.cos() + beyond * phi.sin(), x[..., 1], down)

    def inverse(self, x: Tensor, kappa: Tensor) -> Tensor:
        kappa = _bent(kappa)
        mirror = kappa.sign()
        across, down = straightened(mirror * x[..., 0], self.height - x[..., 2], kappa.abs(), self.half)
        return self._placed(mirror * across, x[..., 1], down)

    def pushed(self, x: Tensor, kappa: Tensor, vector: Tensor) -> Tensor:
        """J v for vectors in the plane."""
        phi, stretch = self._turn_and_stretch(x, kappa)
        a, b = vector[..., 0], -stretch * vector[..., 2]
        sine, cosine = phi.sin(), phi.cos()
        return torch.stack((a * cosine + b * sine, torch.zeros_like(a), a * sine - b * cosine), dim=-1)

    def pulled(self, x: Tensor, kappa: Tensor, slope: Tensor, covector: Tensor) -> Tensor:
        """What becomes of a covector where κ has the ``slope`` ∂κ/∂y."""
        phi, stretch = self._turn_and_stretch(x, kappa)
        a, b = covector[..., 0], -covector[..., 2] / stretch
        sine, cosine = phi.sin(), phi.cos()
        moved = torch.stack((a * cosine + b * sine, covector[..., 1], a * sine - b * cosine), dim=-1)
        sideways = slope * (moved * self.by_curvature(x, kappa)).sum(dim=-1)
        return moved - torch.nn.functional.pad(sideways[..., None], (1, 1))

    def by_curvature(self, x: Tensor, kappa: Tensor) -> Tensor:
        """∂Φ/∂κ, which has no y component."""
        across, along, beyond, phi = self._parts(x, kappa)
        side, up = arc_slopes(phi)
        sine, cosine = phi.sin(), phi.cos()
        forward = along * (along * side - across * sine + beyond * cosine)
        down = along * (along * up - across * cosine - beyond * sine)
        return torch.stack((forward, torch.zeros_like(forward), -down), dim=-1)

    def _parts(self, x: Tensor, kappa: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        down = self.height - x[..., 2]
        inside = down.clamp(-self.half, self.half)
        return x[..., 0], inside + self.half, down - inside, _bent(kappa) * (inside + self.half)

    def _turn_and_stretch(self, x: Tensor, kappa: Tensor) -> tuple[Tensor, Tensor]:
        across, _, beyond, phi = self._parts(x, kappa)
        return phi, torch.where(beyond == 0, 1 - _bent(kappa) * across, torch.ones_like(phi))

    def _placed(self, across: Tensor, y: Tensor, down: Tensor) -> Tensor:
        return torch.stack((across, y.expand(across.shape), self.height - down), dim=-1)


class Walking:
    """One cycle of a walk; see the module. x points forward, z up, and legs are left and right of the plane y = 0.

    It can be inverted near the body: points between the arc of a joint and its centre of curvature, and below.

    Args:
        stride: a in [0, 0.8], radians of each hip forward and backward.
        knee: b in [0, 1], radians at the most.
        turn: radians of the chest to both sides.

    Raises:
        ValueError: a number is out of range.
    """

    def __init__(self, *, stride: float = 0.5, knee: float = 0.6, turn: float = 0.4) -> None:
        if not 0 <= stride <= 0.8:
            raise ValueError(f"stride={stride}: expected a number in [0, 0.8]")
        if not 0 <= knee <= 1:
            raise ValueError(f"knee={knee}: expected a number in [0, 1]")
        self.stride, self.knee, self.turn = float(stride), float(knee), float(turn)
        self._hip_joint, self._knee_joint = _Joint(*_HIP), _Joint(*_KNEE)

    def __repr__(self) -> str:
        return f"Walking(stride={self.stride}, knee={self.knee}, turn={self.turn})"

    def forward(self, x: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.forward`."""
        hip, knee = self._curvatures(x, t)
        leg = self._hip_joint.forward(self._knee_joint.forward(x, knee), hip)
        return _either(x, _turned(x, self._angle(x, t)), leg)

    def inverse(self, x: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.inverse`; heights of the chest stay, so that its part is known by them."""
        hip, knee = self._curvatures(x, t)
        leg = self._knee_joint.inverse(self._hip_joint.inverse(x, hip), knee)
        return _either(x, _turned(x, -self._angle(x, t)), leg)

    def gradient(self, home: Tensor, t: Tensor | float, covector: Tensor) -> Tensor:
        """See `Motion.gradient`."""
        hip, knee = self._curvatures(home, t)
        hip_slope, knee_slope = self._slopes(home, t)
        bent = self._knee_joint.forward(home, knee)
        leg = self._knee_joint.pulled(home, knee, knee_slope, covector)
        leg = self._hip_joint.pulled(bent, hip, hip_slope, leg)
        low, high = _TURNS
        grows = (home[..., 2] > low) & (home[..., 2] < high)
        per_height = torch.where(grows, self._turn(home, t) / (high - low), torch.zeros_like(hip))
        around = home[..., 0] * covector[..., 1] - home[..., 1] * covector[..., 0]
        leaning = torch.stack((covector[..., 0], covector[..., 1], covector[..., 2] - per_height * around), dim=-1)
        return _either(home, _turned(leaning, self._angle(home, t)), leg)

    def velocity(self, home: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.velocity`."""
        hip, knee = self._curvatures(home, t)
        hip_rate, knee_rate = self._rates(home, t)
        bent = self._knee_joint.forward(home, knee)
        leg = self._knee_joint.by_curvature(home, knee) * knee_rate[..., None]
        leg = self._hip_joint.pushed(bent, hip, leg)
        leg = leg + self._hip_joint.by_curvature(bent, hip) * hip_rate[..., None]
        x, rate = _turned(home, self._angle(home, t)), self.turn * self._share(home)
        rate = rate * 2 * math.pi * (2 * math.pi * _times(home, t)).cos()
        chest = torch.stack((-rate * x[..., 1], rate * x[..., 0], torch.zeros_like(rate)), dim=-1)
        return _either(home, chest, leg)

    def _curvatures(self, x: Tensor, t: Tensor | float) -> tuple[Tensor, Tensor]:
        """Of hip and knee."""
        swing, leg = (2 * math.pi * _times(x, t)).sin(), _weight(x)
        hip = self.stride * swing * leg / (2 * _HIP[1])
        return hip, -self.knee * swing.square() * (1.2 + leg * swing) / 2.2 / (2 * _KNEE[1])

    def _slopes(self, x: Tensor, t: Tensor | float) -> tuple[Tensor, Tensor]:
        """Their derivatives by y."""
        swing, u = (2 * math.pi * _times(x, t)).sin(), x[..., 1] / _BETWEEN
        slope = torch.where(u.abs() < 1, 1.5 * (1 - u.square()) / _BETWEEN, torch.zeros_like(u))
        return self.stride * swing * slope / (2 * _HIP[1]), -self.knee * swing**3 * slope / 2.2 / (2 * _KNEE[1])

    def _rates(self, x: Tensor, t: Tensor | float) -> tuple[Tensor, Tensor]:
        """Their derivatives by time."""
        phase, leg = 2 * math.pi * _times(x, t), _weight(x)
        swing, rate = phase.sin(), 2 * math.pi * phase.cos()
        knee = -self.knee * (2.4 * swing + 3 * leg * swing.square()) / 2.2 * rate / (2 * _KNEE[1])
        return self.stride * rate * leg / (2 * _HIP[1]), knee

    def _turn(self, x: Tensor, t: Tensor | float) -> Tensor:
        return self.turn * (2 * math.pi * _times(x, t)).sin()

    def _angle(self, x: Tensor, t: Tensor | float) -> Tensor:
        return self._share(x) * self._turn(x, t)

    @staticmethod
    def _share(x: Tensor) -> Tensor:
        low, high = _TURNS
        return (x[..., 2].clamp(low, high) - low) / (high - low)


def walker() -> DeformingField:
    """A figure with chest, head, stretched arms, legs and feet that walks one cycle; at t = 1 it is as at t = 0."""
    return DeformingField(FunctionField(_body), Walking())


def _body(x: Tensor) -> Tensor:
    p = x.reshape(-1, 3)
    whole = solids.round_cone(p, (0.0, 0.0, 0.27), (0.0, 0.0, 0.45), 0.14, 0.13)
    parts = [solids.ellipsoid(p, (0.02, 0.0, 0.72), (0.12, 0.11, 0.14))]
    for side in (-1.0, 1.0):
        y = 0.13 * side
        parts.append(solids.round_cone(p, (0.0, 0.1 * side, 0.46), (0.08, 0.4 * side, 0.46), 0.06, 0.045))
        parts.append(solids.round_cone(p, (0.0, y, 0.17), (0.0, y, -0.36), 0.08, 0.065))
        parts.append(solids.round_cone(p, (0.0, y, -0.36), (0.0, y, -0.78), 0.065, 0.05))
        parts.append(solids.round_cone(p, (0.0, y, -0.8), (0.14, y, -0.82), 0.05, 0.04))
    for part in parts:
        whole = solids.smooth_union(whole, part, 0.03)
    return whole.reshape(x.shape[:-1])


def _weight(x: Tensor) -> Tensor:
    u = (x[..., 1] / _BETWEEN).clamp(-1, 1)
    return u * (3 - u.square()) / 2


def _times(x: Tensor, t: Tensor | float) -> Tensor:
    return torch.as_tensor(t, dtype=x.dtype, device=x.device).expand(x.shape[:-1])


def _bent(kappa: Tensor) -> Tensor:
    """κ, moved away from 0 by so little that nothing shows."""
    return torch.where(kappa < 0, kappa.clamp(max=-_STRAIGHT), kappa.clamp(min=_STRAIGHT))


def _either(x: Tensor, chest: Tensor, leg: Tensor) -> Tensor:
    return torch.where((x[..., 2] > _WAIST)[..., None], chest, leg)


def _turned(x: Tensor, angle: Tensor) -> Tensor:
    """Points or vectors ``(..., 3)`` turned about z."""
    sine, cosine = angle.sin(), angle.cos()
    a, b = x[..., 0], x[..., 1]
    return torch.stack((cosine * a - sine * b, sine * a + cosine * b, x[..., 2].expand(angle.shape)), dim=-1)
