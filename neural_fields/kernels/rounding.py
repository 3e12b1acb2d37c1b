"""How far a value and a gradient computed in float32 may be from the exact ones, whatever the order of their sums.

A running error analysis, layer by layer, in float64: an inner product of n terms is off by at most γ_n Σ|terms| with
γ_n = n u / (1 − n u) (Higham 2002, Sec. 3.1), for any order, in pieces or not, with fused multiply-adds or without; a
sine by 4u, two units in the last place of numbers near 1 (CUDA's libdevice; CPU libraries stay below); and what the
layer below is off by goes through the absolute values of the weights:

    e_i = ω₀(|W_i| e_{i−1} + γ_{n+4}(|W_i||h_{i−1}| + |b_i|)) + 4u

and likewise on the way back. Phases are multiplied by ω₀, or weights before: both are in the γ. So the bound is made of
rounding, depth and weights. It holds at every point, and is pessimistic, since errors cancel.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["rounding_bound"]

SINE_ERROR = 4.0  # in u
# Beside the terms of a product: the bias, ω₀ or a unit, a rounding of the weight that was multiplied by it, the store.
FURTHER = 4


def rounding_bound(
    x: Tensor, parameters: Sequence[Tensor], omega: float, gain: float = 1.0, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """Bounds on the errors of f ``(N,)`` and of its gradient ``(N, d)``, in float64.

    Args:
        x: ``(N, d)``.
        parameters: (W₁, b₁, …, W_out, b_out) without ω₀, as in `mplicits.neural_fields.kernels.launch.Network`.
        omega: what phases are multiplied by.
        gain: what outputs are multiplied by.
        dtype: the precision whose errors are meant.
    """
    u = torch.finfo(dtype).eps / 2
    x, *parameters = (tensor.detach().double() for tensor in (x, *parameters))
    h, error = x, torch.zeros_like(x)
    kept: list[tuple[Tensor, Tensor]] = []
    for weight, bias in zip(parameters[0:-2:2], parameters[1:-2:2], strict=True):
        size = (h.abs() + error) @ weight.abs().t() + bias.abs()
        off = omega * (error @ weight.abs().t() + _gamma(weight.shape[1], u) * size)
        z = omega * (h @ weight.t() + bias)
        h, error = z.sin(), off + SINE_ERROR * u
        # Of ω₀ cos: the phase, the cosine itself, and the product with ω₀.
        kept.append((omega * z.cos(), omega * (off + (SINE_ERROR + 2) * u)))
    last, constant = parameters[-2][0], parameters[-1][0]
    size = (h.abs() + error) @ last.abs() + constant.abs()
    value = gain * (error @ last.abs() + _gamma(len(last), u) * size)

    g, error = (gain * last).expand_as(h), (gain * last).abs().expand_as(h) * u
    for weight, (slope, off) in zip(reversed(parameters[0:-2:2]), reversed(kept), strict=True):
        s = g * slope
        error = error * (slope.abs() + off) + g.abs() * off
        error = error + (s.abs() + error) * u
        g, error = s @ weight, error @ weight.abs() + _gamma(len(weight), u) * ((s.abs() + error) @ weight.abs())
    return value, error


def _gamma(terms: int, u: float) -> float:
    """γ of so many terms, and of what is done beside them."""
    return (terms + FURTHER) * u / (1 - (terms + FURTHER) * u)
