"""Evolution laws, the right side of ∂f/∂t = F(x, t, ∇f, …), and losses that train a field to obey them.

After Novello et al. 2023, "Neural Implicit Surface Evolution". A `Law` is F. Laws are added and scaled like speeds:

    law = transport(motion.velocity) + mean_curvature(0.02)
    loss = law_loss(spacetime_jet(field, x, order=law.order), law).mean()

Under most laws a solution does not stay a distance, and an eikonal loss contradicts the law off the surface. With
``extend=True`` a law takes the speed of the surface point x − f ∇f / |∇f| (extension velocities, Adalsteinsson and
Sethian 1999): the surface moves the same, and the distance stays one. Use it only near the surface (`near_surface`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..fields.field import Field, Jet
from .field import SpaceTimeJet, at_time

# Positions (..., 3) and times (...,) to velocities (..., 3), in units of space per unit of time.
VectorField = Callable[[Tensor, Tensor], Tensor]
# Positions (..., 3) and times (...,) to speeds (...,) along the outward normal.
SpeedField = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Law:
    """The right side of ∂f/∂t = F(jet).

    Attributes:
        rate: F, from a `SpaceTimeJet` to ``(...,)``.
        order: of the jet that it needs: 1, or 2 if it uses the Hessian.

    Example:
        A surface that swells with unit speed while it turns:

        >>> import torch
        >>> swell = Law(lambda jet: -jet.gradient.norm(dim=-1))
        >>> turn = transport(lambda x, t: torch.linalg.cross(x.new_tensor([0.0, 0.0, 3.0]).expand(x.shape), x))
        >>> (swell + 0.5 * turn).order
        1
    """

    rate: Callable[[SpaceTimeJet], Tensor]
    order: int = 1

    def residual(self, jet: SpaceTimeJet) -> Tensor:
        """``∂f/∂t − F`` ``(...,)``, zero where the field obeys; ValueError if the jet lacks second derivatives."""
        if self.order > 1 and not jet.hessian.shape[-1]:
            raise ValueError("this law needs second derivatives; take the jet with order=law.order")
        return jet.rate - self.rate(jet)

    def __add__(self, other: Law) -> Law:
        """Both at once: the speeds add."""
        return Law(lambda jet: self.rate(jet) + other.rate(jet), max(self.order, other.order))

    def __mul__(self, factor: float) -> Law:
        """The same motion, ``factor`` times as fast."""
        return Law(lambda jet: factor * self.rate(jet), self.order)

    __rmul__ = __mul__


def transport(velocity: VectorField, *, extend: bool = False) -> Law:
    """The surface is carried by a vector field V: ``∂f/∂t = −⟨∇f, V(x, t)⟩``.

    With ``extend`` V is taken at the surface point below, so that a distance stays one (a rigid motion keeps it
    anyway).
    """

    def rate(jet: SpaceTimeJet) -> Tensor:
        return -(jet.gradient * velocity(_point_below(jet) if extend else jet.position, jet.time)).sum(dim=-1)

    return Law(rate)


def normal_speed(speed: SpeedField, *, extend: bool = False) -> Law:
    """The surface moves along its outward normal with speed v: ``∂f/∂t = −v(x, t) |∇f|``.

    With ``extend`` v is taken at the surface point below, so that a distance stays one.
    """

    def rate(jet: SpaceTimeJet) -> Tensor:
        return -speed(_point_below(jet) if extend else jet.position, jet.time) * _length(jet.gradient)

    return Law(rate)


def morph(guide: Field, *, extend: bool = False) -> Law:
    """Level-set morphing: a guide g(x, t), not trained, sets the normal speed ``−∂g/∂t``, so ``∂f/∂t = |∇f| ∂g/∂t``.

    With `Keyframes` for the guide this is ``∂f/∂t = |∇f| (f_{k+1} − f_k) / (t_{k+1} − t_k)``: a point of the first
    shape moves outward where it is inside of the second. The law is the same when time runs backward. Novello et al.
    (and Breen and Whitaker 2001) take ``f_{k+1} − f``, which prefers one end; both are driven to their ends by
    `key_loss`. For ``extend`` see `normal_speed`.
    """

    @torch.no_grad()
    def speed(x: Tensor, t: Tensor) -> Tensor:
        return -guide.to(x.device).jet(at_time(x, t)).gradient[..., 3]

    return normal_speed(speed, extend=extend)


def mean_curvature(alpha: float, *, extend: bool = False, least: float = 0.1) -> Law:
    """Smoothing by mean curvature: ``∂f/∂t = α |∇f| κ`` with ``κ = div(∇f / |∇f|)``, the sum of both curvatures.

    A sphere shrinks as ``r(t) = √(r₀² − 4αt)``. Negative α sharpens, and is ill posed.

    Args:
        alpha: α, squared units of space per unit of time.
        extend: take the curvature of the surface point below, so that a distance stays one. A principal curvature k of
            a parallel surface at the distance f is k / (1 − f k) below; assumes |∇f| ≈ 1.
        least: bound from below on the product of both ``1 − f k``, which vanishes where normals meet.
    """

    def rate(jet: SpaceTimeJet) -> Tensor:
        total = tangential_laplacian(jet)
        if not extend:
            return alpha * total
        # With the trace T and the determinant D of the Hessian in the tangent plane:
        # k₁ / (1 − f k₁) + k₂ / (1 − f k₂) = (T − 2 f D) / (1 − f T + f² D)
        determinant = _tangential_determinant(jet)
        spread = (1 - jet.value * total + jet.value**2 * determinant).clamp(min=least)
        return alpha * (total - 2 * jet.value * determinant) / spread

    return Law(rate, order=2)


def tangential_laplacian(jet: SpaceTimeJet, *, eps: float = 1e-12) -> Tensor:
    """``|∇f| κ = Δf − ⟨n, H n⟩`` with ``n = ∇f / |∇f|``: the trace of the Hessian in the tangent plane. ``(...,)``."""
    gradient, hessian = jet.gradient, jet.hessian
    normal_part = (gradient * (hessian @ gradient[..., None])[..., 0]).sum(dim=-1)
    total = hessian.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    return total - normal_part / (gradient.square().sum(dim=-1) + eps)


def curvature(jet: SpaceTimeJet, *, eps: float = 1e-12) -> Tensor:
    """``κ = div(∇f / |∇f|)``, the sum of both principal curvatures; 2/r on a sphere. ``(...,)``."""
    return tangential_laplacian(jet, eps=eps) / _length(jet.gradient, eps)


def law_loss(jet: SpaceTimeJet, law: Law, *, eps: float = 1e-4) -> Tensor:
    """``(∂f/∂t − F)² / |∇f|²`` ``(...,)``: the squared error of the normal speed.

    Its units do not depend on the slope of f, so one weight serves all laws. The slope is not differentiated: a steeper
    field must not count as obeying better.
    """
    return law.residual(jet).square() / (jet.gradient.detach().square().sum(dim=-1) + eps)


def key_loss(jet: Jet | SpaceTimeJet, target: Jet, *, length: float = 0.05) -> Tensor:
    """``(f − f_k)² + ℓ² |∇f − ∇f_k|²`` ``(...,)`` at the time of a known shape f_k, squared field units; ∇ is by space.

    ``length`` ℓ weighs normals: surfaces that agree in a point may drift apart by so much before it counts.
    """
    return (jet.value - target.value).square() + length**2 * (jet.gradient - target.gradient).square().sum(dim=-1)


def near_surface(value: Tensor, width: float) -> Tensor:
    """Weights ``exp(−(f / w)² / 2)`` ``(...,)``, without a gradient, that restrict a law to the surface."""
    return (-0.5 * (value.detach() / width).square()).exp()


def _point_below(jet: SpaceTimeJet) -> Tensor:
    """``x − f ∇f / |∇f|²``, detached: no gradient flows through the place of a speed."""
    gradient = jet.gradient.detach()
    slope = gradient.square().sum(dim=-1, keepdim=True).clamp(min=1e-4)
    return jet.position.detach() - jet.value.detach()[..., None] * gradient / slope


def _tangential_determinant(jet: SpaceTimeJet, eps: float = 1e-12) -> Tensor:
    """k₁ k₂ |∇f|² from ⟨n, adj(H) n⟩, the Gaussian curvature of an implicit surface (Goldman 2005)."""
    a, b, c = jet.hessian.unbind(dim=-2)
    adjugate = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), dim=-2)
    gradient = jet.gradient
    return (gradient * (adjugate @ gradient[..., None])[..., 0]).sum(dim=-1) / (gradient.square().sum(dim=-1) + eps)


def _length(gradient: Tensor, eps: float = 1e-12) -> Tensor:
    """|∇f| with a finite derivative where it vanishes."""
    return (gradient.square().sum(dim=-1) + eps).sqrt()
