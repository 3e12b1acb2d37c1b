"""Figures that bend and twist, in closed form: where each point of the surface is at every time is known exactly.

A motion takes points X of the rest shape to x = Φ(X, t). The shape at a time is the zero set of g(Φ⁻¹(x, t)), g the
rest shape's field, so surface, correspondence and velocity have no error but rounding.

- `Bending` bends a beam along z about an elbow: between −h and h the middle line becomes an arc of curvature
  κ = θt / 2h in the x-z plane, what lies above turns rigidly by θt. With a = clamp(Z, −h, h) + h,
  b = Z − clamp(Z, −h, h) and φ = κa

      x = a (1 − cos φ) / φ + X cos φ + b sin φ,   z = −h + a sin φ / φ − X sin φ + b cos φ.

- `Twisting` turns each section about z by τ t a / 2h: it leaves volumes as they are, exactly.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from mplicits.datasets.synthetic import solids
from mplicits.neural_fields import Field, FunctionField, Jet
from mplicits.neural_fields.fields.field import OneLevelField
from torch import Tensor

# Where a beam is so little bent (times the length of the arc: radians) its curvature is taken for this one; that shifts
# points by 1e-6, at t = 0, where all are to rest, as at any other time, so that forward and inverse still agree.
_STRAIGHT = 1e-6
_SERIES = 0.05  # below it φ² / 100 of a term would be lost in float32; a series has 1e-9 there


class Motion(Protocol):
    """A motion of space that is known in closed form, both ways; times are one number, or ``(...,)``."""

    def forward(self, x: Tensor, t: Tensor | float) -> Tensor:
        """Where points ``(..., 3)`` of the rest shape are at a time."""
        ...

    def inverse(self, x: Tensor, t: Tensor | float) -> Tensor:
        """Where points ``(..., 3)`` of a time are in the rest shape."""
        ...

    def gradient(self, home: Tensor, t: Tensor | float, covector: Tensor) -> Tensor:
        """J⁻ᵀ g ``(..., 3)`` at points ``home`` of the rest shape: what a gradient there becomes at a time."""
        ...

    def velocity(self, home: Tensor, t: Tensor | float) -> Tensor:
        """∂Φ/∂t ``(..., 3)`` of points ``home`` of the rest shape."""
        ...


class Bending:
    """A beam along z that bends about an elbow; see the module.

    It can be inverted this side of the arc's centre, x < 1/κ: bodies may reach to 2h / θ, and no further.

    Args:
        angle: θ in (0, 2.5], radians that the end has turned by at t = 1.
        half: h, half the length of the arc.

    Raises:
        ValueError: a number is out of range.

    Example:
        >>> import torch
        >>> moved = Bending(angle=torch.pi / 2, half=0.25).forward(torch.tensor([0.0, 0.0, 0.25]), 1.0)
        >>> [round(float(x), 3) for x in moved]
        [0.318, 0.0, 0.068]
    """

    def __init__(self, *, angle: float = 1.6, half: float = 0.3) -> None:
        if not 0 < angle <= 2.5:
            raise ValueError(f"angle={angle}: expected a number in (0, 2.5]")
        if not half > 0:
            raise ValueError(f"half={half}: expected a number above 0")
        self.angle, self.half = float(angle), float(half)

    def __repr__(self) -> str:
        return f"Bending(angle={self.angle}, half={self.half})"

    def forward(self, x: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.forward`."""
        kappa = self._curvature(x, t)
        across, along, beyond = self._parts(x)
        phi = kappa * along
        sine, cosine = phi.sin(), phi.cos()
        side, up = arc(phi)
        moved_x = along * side + across * cosine + beyond * sine
        moved_z = along * up - across * sine + beyond * cosine - self.half
        return torch.stack((moved_x, x[..., 1].expand(moved_x.shape), moved_z), dim=-1)

    def inverse(self, x: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.inverse`; behind the arc's centre it is that of the end that has turned."""
        kappa = self._curvature(x, t)
        home_x, home_z = straightened(x[..., 0], x[..., 2], kappa, self.half)
        return torch.stack((home_x, x[..., 1].expand(home_x.shape), home_z), dim=-1)

    def gradient(self, home: Tensor, t: Tensor | float, covector: Tensor) -> Tensor:
        """See `Motion.gradient`: J is a turn by φ after a stretch of 1 − κX along the arc."""
        kappa = self._curvature(home, t)
        across, along, _ = self._parts(home)
        phi, inside = kappa * along, home[..., 2].abs() < self.half
        stretch = torch.where(inside, 1 - kappa * across, torch.ones_like(phi))
        sine, cosine = phi.sin(), phi.cos()
        x, lengthwise = covector[..., 0], covector[..., 2] / stretch
        return torch.stack((x * cosine + lengthwise * sine, covector[..., 1], lengthwise * cosine - x * sine), dim=-1)

    def velocity(self, home: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.velocity`."""
        across, along, beyond = self._parts(home)
        phi = self._curvature(home, t) * along
        sine, cosine = phi.sin(), phi.cos()
        side, up = arc_slopes(phi)
        rate = self.angle / (2 * self.half) * along  # ∂φ/∂t
        x = rate * (along * side - across * sine + beyond * cosine)
        z = rate * (along * up - across * cosine - beyond * sine)
        return torch.stack((x, torch.zeros_like(x), z), dim=-1)

    def _curvature(self, x: Tensor, t: Tensor | float) -> Tensor:
        time = torch.as_tensor(t, dtype=x.dtype, device=x.device).expand(x.shape[:-1])
        return (self.angle * time / (2 * self.half)).clamp(min=_STRAIGHT)

    def _parts(self, home: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """X, a and b."""
        height = home[..., 2]
        inside = height.clamp(-self.half, self.half)
        return home[..., 0], inside + self.half, height - inside


class Twisting:
    """A bar along z whose sections turn about it; see the module.

    Args:
        angle: τ, radians that its upper end has turned by at t = 1.
        half: h; the twist is spread over −h ≤ z ≤ h.

    Raises:
        ValueError: ``half`` is not positive.
    """

    def __init__(self, *, angle: float = 1.8, half: float = 0.6) -> None:
        if not half > 0:
            raise ValueError(f"half={half}: expected a number above 0")
        self.angle, self.half = float(angle), float(half)

    def __repr__(self) -> str:
        return f"Twisting(angle={self.angle}, half={self.half})"

    def forward(self, x: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.forward`."""
        return _turned(x, self._share(x) * self._angle(x, t))

    def inverse(self, x: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.inverse`."""
        return _turned(x, -self._share(x) * self._angle(x, t))

    def gradient(self, home: Tensor, t: Tensor | float, covector: Tensor) -> Tensor:
        """See `Motion.gradient`: sections turn, and shear over each other."""
        angle = self._angle(home, t)
        inside = home[..., 2].abs() < self.half
        per_height = torch.where(inside, angle / (2 * self.half), torch.zeros_like(angle))
        along = covector[..., 2] - per_height * (home[..., 0] * covector[..., 1] - home[..., 1] * covector[..., 0])
        leaning = torch.cat((covector[..., :2], along[..., None]), dim=-1)
        return _turned(leaning, self._share(home) * angle)

    def velocity(self, home: Tensor, t: Tensor | float) -> Tensor:
        """See `Motion.velocity`."""
        x = self.forward(home, t)
        rate = self.angle * self._share(home)
        return torch.stack((-rate * x[..., 1], rate * x[..., 0], torch.zeros_like(rate)), dim=-1)

    def _share(self, x: Tensor) -> Tensor:
        return (x[..., 2].clamp(-self.half, self.half) + self.half) / (2 * self.half)

    def _angle(self, x: Tensor, t: Tensor | float) -> Tensor:
        return self.angle * torch.as_tensor(t, dtype=x.dtype, device=x.device).expand(x.shape[:-1])


class DeformingField(Field):
    """A shape on an exact motion: f(x, t) = g(Φ⁻¹(x, t)).

    The surface is exact; f is a distance only where Φ is rigid.

    Args:
        field: g, three-dimensional, of the rest shape.
        motion: Φ.

    Raises:
        ValueError: the field is not three-dimensional.
    """

    defined_by = ("motion",)

    def __init__(self, field: Field, motion: Motion) -> None:
        super().__init__()
        if field.in_dim != 3:
            raise ValueError(f"field.in_dim={field.in_dim}: expected a static field, three-dimensional")
        self.field, self.motion = field, motion
        self.in_dim, self.num_levels = 4, field.num_levels

    @property
    def deltas(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Half-widths of the bands, those of the rest shape."""
        return self.field.deltas

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.check_points(x)
        return self.field.value(self.motion.inverse(x[..., :3], x[..., 3]), level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; ∂f/∂t = −⟨∇f, ∂Φ/∂t⟩."""
        self.check_points(x)
        home, time = self.motion.inverse(x[..., :3], x[..., 3]), x[..., 3]
        value, covector, features = self.field.jet(home, level=level)
        gradient = self.motion.gradient(home, time, covector)
        rate = -(gradient * self.motion.velocity(home, time)).sum(dim=-1)
        return Jet(value, torch.cat((gradient, rate[..., None]), dim=-1), features)


def bending_arm() -> DeformingField:
    """An arm along z with a thumb and a bump at its shoulder, that bends by 1.6 radians about its elbow."""
    return DeformingField(FunctionField(_arm), Bending(angle=1.6, half=0.3))


def twisting_bar() -> DeformingField:
    """A rounded bar along z with a knob at one side, that twists by 1.8 radians."""
    return DeformingField(FunctionField(_bar), Twisting(angle=1.8, half=0.6))


def _arm(x: Tensor) -> Tensor:
    p = x.reshape(-1, 3)
    upper = solids.round_cone(p, (0.0, 0.0, -0.65), (0.0, 0.0, 0.0), 0.16, 0.12)
    lower = solids.round_cone(p, (0.0, 0.0, 0.0), (0.0, 0.0, 0.5), 0.12, 0.09)
    hand = solids.ellipsoid(p, (0.0, 0.0, 0.65), (0.07, 0.13, 0.16))
    thumb = solids.round_cone(p, (0.0, 0.08, 0.6), (0.03, 0.22, 0.66), 0.05, 0.035)
    bump = solids.ellipsoid(p, (-0.1, 0.0, -0.6), (0.14, 0.12, 0.12))
    whole = solids.smooth_union(upper, lower, 0.05)
    for part in (hand, thumb, bump):
        whole = solids.smooth_union(whole, part, 0.04)
    return whole.reshape(x.shape[:-1])


def _bar(x: Tensor) -> Tensor:
    p = x.reshape(-1, 3)
    bar = solids.rounded_box(p, (0.0, 0.0, 0.0), (0.12, 0.24, 0.7), 0.06)
    knob = solids.ellipsoid(p, (0.0, 0.24, 0.5), (0.09, 0.12, 0.09))
    return solids.smooth_union(bar, knob, 0.04).reshape(x.shape[:-1])


def straightened(x: Tensor, z: Tensor, kappa: Tensor, half: float) -> tuple[Tensor, Tensor]:
    """Where points of a beam along z were before it was bent by a curvature κ > 0 between −h and h; see the module.

    Args:
        x: across the beam, ``(...,)``.
        z: along it.
        kappa: κ, ``(...,)``.
        half: h.
    """
    height = z + half
    u, w = 1 - kappa * x, kappa * height
    turn, end = torch.atan2(w, u), 2 * half * kappa
    below = (height < 0) & (u > 0)
    above = ~below & (torch.where(turn < 0, turn + 2 * math.pi, turn) > end)
    # In the arc: the radius 1/κ − X, and the angle κa.
    radius = torch.hypot(u, w)
    arc_x = (2 * x - kappa * (x**2 + height**2)) / (1 + radius)
    arc_z = turn / kappa - half
    side, up = arc(end)
    dx, dz = x - 2 * half * side, height - 2 * half * up
    sine, cosine = end.sin(), end.cos()
    end_x, end_z = dx * cosine - dz * sine, half + dx * sine + dz * cosine
    home_x = torch.where(below, x, torch.where(above, end_x, arc_x))
    return home_x, torch.where(below, z, torch.where(above, end_z, arc_z))


def arc(phi: Tensor) -> tuple[Tensor, Tensor]:
    """(1 − cos φ) / φ and sin φ / φ, for φ of 0 too."""
    half = torch.sinc(phi / (2 * math.pi))
    return phi / 2 * half.square(), torch.sinc(phi / math.pi)


def arc_slopes(phi: Tensor) -> tuple[Tensor, Tensor]:
    """The derivatives of both by φ; near 0 by their series."""
    small = phi.abs() < _SERIES
    safe = torch.where(small, torch.ones_like(phi), phi)
    side, up = arc(safe)
    square = phi.square()
    near_side = 0.5 - square / 8 + square.square() / 144
    near_up = phi * (-1 / 3 + square / 30 - square.square() / 840)
    return (
        torch.where(small, near_side, (safe.sin() - side) / safe),
        torch.where(small, near_up, (safe.cos() - up) / safe),
    )


def _turned(x: Tensor, angle: Tensor) -> Tensor:
    """Points or vectors ``(..., 3)`` turned about z."""
    sine, cosine = angle.sin(), angle.cos()
    a, b = x[..., 0], x[..., 1]
    return torch.stack((cosine * a - sine * b, sine * a + cosine * b, x[..., 2].expand(angle.shape)), dim=-1)


class ShrinkingSphere(OneLevelField):
    """The sphere that mean curvature shrinks, |x| = √(r₀² − 4αt), as a distance or as a solution.

    The distance f = |x| − √(r₀² − 4αt) obeys ∂f/∂t = α|∇f|κ on its surface only. ``exact_law=True`` gives the field
    f = √(|x|² + 4αt) − r₀ with the same surface, which obeys it everywhere but is a distance at t = 0 only.

    ``radius`` is r₀, ``alpha`` α (negative: it grows). ValueError if r₀ is not positive, or the sphere vanishes before
    t = 1.
    """

    defined_by = ("radius", "alpha", "exact_law")

    def __init__(self, *, radius: float = 0.8, alpha: float = 0.1, exact_law: bool = False) -> None:
        super().__init__(in_dim=4)
        if not (radius > 0 and radius**2 > 4 * alpha):
            raise ValueError(f"radius={radius}, alpha={alpha}: expected radius > 0 and radius² > 4 alpha")
        self.radius, self.alpha, self.exact_law = radius, alpha, exact_law

    def radius_at(self, t: Tensor) -> Tensor:
        """r(t) = √(r₀² − 4αt); NaN once the sphere is gone."""
        return (self.radius**2 - 4 * self.alpha * t).sqrt()

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.jet(x, level=level).value

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        self.resolve_level(level)
        position, time = self.check_points(x)[..., :3], x[..., 3]
        if self.exact_law:
            length = (position.square().sum(dim=-1) + 4 * self.alpha * time).sqrt()
            value, rate = length - self.radius, 2 * self.alpha / length
        else:
            length, now = position.norm(dim=-1), self.radius_at(time)
            value, rate = length - now, 2 * self.alpha / now
        gradient = torch.cat((position / length[..., None], rate[..., None]), dim=-1)
        return Jet(value, gradient, x.new_empty((*x.shape[:-1], 0)))
