"""Implicit displacement fields (Wang et al. 2022): a smooth base, moved along its own normals by a second network.

Their Eqs. 5 to 9, with the base b, the displacement network d, n = ∇b / |∇b| and the largest displacement α:

    f(x) = b(y),   y = x + s(x) n(x),   s(x) = α χ(b(x)) tanh d(x),   χ(v) = 1 / (1 + (v / ν)⁴).

χ lets nothing be moved far from the base surface. With w = ∇b(y) and H the Hessian of b at x,

    ∇f = w + ⟨n, w⟩ ∇s + s H (w − ⟨n, w⟩ n) / |∇b|,
    ∇s = α (χ′ tanh d ∇b + χ (1 − tanh² d) ∇d).
"""

from __future__ import annotations

import math

import torch
from mplicits.neural_fields.backend.errors import positive
from mplicits.neural_fields.fields.field import Field, Jet
from mplicits.neural_fields.networks.siren import Siren
from torch import Tensor

# Below this the base has no normal to speak of, and nothing is moved.
LEAST_SLOPE = 1e-6


class IdfSDF(Field):
    """A base SIREN and a displacement SIREN; level 0 is the base, level 1 the displaced surface.

    The levels are alternatives, each one a field of its own everywhere: the band around the base is infinitely wide.

    Args:
        width: neurons per sine layer of either network.
        depth: sine layers of either network.
        omegas: ω₀ of base and displacement; the lower one is what makes the base smooth.
        limit: α, the furthest that a point is moved.
        reach: ν, the distance from the base at which the displacement is halved.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> from benchmarks.peers import IdfSDF
        >>> sum(p.numel() for p in IdfSDF().parameters())
        397314
    """

    defined_by = ("limit", "reach")

    def __init__(
        self,
        width: int = 256,
        depth: int = 4,
        *,
        omegas: tuple[float, float] = (15.0, 60.0),
        limit: float = 0.05,
        reach: float = 0.05,
    ) -> None:
        super().__init__()
        positive(limit=limit, reach=reach)
        self.in_dim, self.num_levels = 3, 2
        self.limit, self.reach = float(limit), float(reach)
        self.register_buffer("deltas", torch.tensor([math.inf]), persistent=False)
        self.base = Siren(width, depth, omega=omegas[0])
        self.displacement = Siren(width, depth, omega=omegas[1])

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`; two passes of the base and its gradient, one of the displacement."""
        if self.resolve_level(level) == 0:
            return self.base.value(x)
        base = self.base.jet(self.check_points(x))
        chi, _ = attenuation(base.value, self.reach)
        shift = self.limit * chi * self.displacement.value(x).tanh()
        return self.base.value(x + shift[..., None] * _unit(base.gradient))

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`; all of it, with the Hessian of the base that its normals bring in."""
        if self.resolve_level(level) == 0:
            return self.base.jet(x)
        base = self.base.second_jet(self.check_points(x))
        moved = self.displacement.jet(x)
        chi, slope = attenuation(base.value, self.reach)
        tanh = moved.value.tanh()
        shift = (self.limit * chi * tanh)[..., None]
        normal = _unit(base.gradient)
        value, there, features = self.base.jet(x + shift * normal)

        by_base, by_displacement = self.limit * slope * tanh, self.limit * chi * (1 - tanh**2)
        shift_gradient = by_base[..., None] * base.gradient + by_displacement[..., None] * moved.gradient
        along = (normal * there).sum(dim=-1, keepdim=True)
        across = there - along * normal
        turned = (base.hessian @ across[..., None])[..., 0] / _length(base.gradient)
        return Jet(value, there + along * shift_gradient + shift * turned, features)


def attenuation(value: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """χ(v) = 1 / (1 + (v / ν)⁴) and dχ/dv = −4 χ² (v / ν)³ / ν (their Eq. 9). ``(...,)`` → ``(...,)`` twice."""
    ratio = value / reach
    chi = 1 / (1 + ratio**4)
    return chi, -4 * chi**2 * ratio**3 / reach


def _length(gradient: Tensor) -> Tensor:
    return gradient.norm(dim=-1, keepdim=True).clamp(min=LEAST_SLOPE)


def _unit(gradient: Tensor) -> Tensor:
    return gradient / _length(gradient)
