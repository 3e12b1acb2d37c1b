"""How far a value and a gradient computed in float32 may be from the exact ones, whatever the order of their sums.

This is a running error analysis, layer by layer, in float64. An inner product of n terms is off by at most γ_n Σ|terms|
with γ_n = n u / (1 − n u) (Higham 2002, Sec. 3.1). That holds for any order, in pieces or not, with fused multiply-adds
or without. A sine is off by 4u, two units in the last place of numbers near 1 (CUDA's libdevice and the polynomial of
`tensor_tiles.py`; CPU libraries stay below). The error of the layer below goes through the absolute values of the
weights:

    e_i = ω₀(|W_i| e_{i−1} + γ_{n+4}(|W_i||h_{i−1}| + |b_i|)) + 4u

and likewise on the way back. Phases are multiplied by ω₀, or weights before: both are in the γ. So the bound is made of
rounding, depth and weights. It holds at every point, and is pessimistic, since errors cancel.

Products of float16 halves (`packing.py`) are sums of 3n terms. Each operand is off by 2⁻²² = 4u of itself and as much
is left out. That is 12u of each term, and for entries that are tiny beside the largest one u/16 of that. Tensor cores
may cut sums off in place of rounding them, once for 16 terms or less, which is within the γ of 3n terms.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

SINE_ERROR = 4.0  # in u
# Likewise of a cosine, which is the sine of a difference that is rounded once more.
COSINE_ERROR = 5.0
# Of products of float16 halves, in u: of a term, and of the largest weight of a matrix.
HALVES, SMALLEST_HALF = 12.0, 1 / 16
# Roundings of a gate, and of the sum behind it.
GATE, SUM = 8, 4
# Beside the terms of a product: the bias, ω₀ or a unit, a rounding of the weight that was multiplied by it, the store.
FURTHER = 4


def rounding_bound(
    x: Tensor,
    parameters: Sequence[Tensor],
    omega: float,
    gain: float = 1.0,
    dtype: torch.dtype = torch.float32,
    *,
    halves: bool = False,
) -> tuple[Tensor, Tensor]:
    """Bounds on the errors of f ``(N,)`` and of its gradient ``(N, d)``, in float64.

    Args:
        x: ``(N, d)``.
        parameters: (W₁, b₁, …, W_out, b_out) without ω₀, as `Siren.raw` has them.
        omega: what phases are multiplied by.
        gain: what outputs are multiplied by.
        dtype: the precision whose errors are meant.
        halves: whether products of square matrices are made of float16 halves.
    """
    u = torch.finfo(dtype).eps / 2
    x, *parameters = (tensor.detach().double() for tensor in (x, *parameters))
    h, error = x, torch.zeros_like(x)
    kept: list[tuple[Tensor, Tensor]] = []
    for weight, bias in zip(parameters[0:-2:2], parameters[1:-2:2], strict=True):
        size = (h.abs() + error) @ weight.abs().t() + bias.abs()
        off = omega * (
            error @ weight.abs().t() + _product_error(h.abs() + error, size, weight, u, halves and h is not x)
        )
        z = omega * (h @ weight.t() + bias)
        h, error = z.sin(), off + SINE_ERROR * u
        # Of ω₀ cos: the phase, the cosine itself, and the product with ω₀.
        kept.append((omega * z.cos(), omega * (off + (COSINE_ERROR + 2) * u)))
    last, constant = parameters[-2][0], parameters[-1][0]
    size = (h.abs() + error) @ last.abs() + constant.abs()
    value = gain * (error @ last.abs() + _gamma(len(last), u) * size)

    g, error = (gain * last).expand_as(h), (gain * last).abs().expand_as(h) * u
    for weight, (slope, off) in zip(reversed(parameters[0:-2:2]), reversed(kept), strict=True):
        s = g * slope
        error = error * (slope.abs() + off) + g.abs() * off
        error = error + (s.abs() + error) * u
        size = s.abs() + error
        own = _product_error(size, size @ weight.abs(), weight.t(), u, halves and weight.shape[1] == len(weight))
        g, error = s @ weight, error @ weight.abs() + own
    return value, error


def gated_bound(
    jets: Sequence[tuple[Tensor, Tensor]],
    bounds: Sequence[tuple[Tensor, Tensor]],
    deltas: Tensor,
    taper: float,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, Tensor, Tensor]:
    """Bounds for levels that are added up behind their gates, and where they hold.

    The gate γ of `networks.multiscale` has a slope of at most 3/2 by u, and γ′ one of at most 6/(δτ),
    while u is off by what f is off by over δτ, and by some roundings over τ; the rest is the product rule. Where |f| is
    nearer to δ than f is off by, rounding decides whether the next level is added at all.

    Args:
        jets: exact values ``(N,)`` and gradients ``(N, d)`` of each level by itself, at all points, in float64.
        bounds: on each, see `rounding_bound`.
        deltas: half-widths of the bands.
        taper: see `MultiscaleSDF`.
        dtype: the precision whose errors are meant.

    Returns:
        ``(N,)`` bool, where no decision is rounding's; bounds on the value ``(N,)`` and the gradient ``(N, d)``.
    """
    rounding = torch.finfo(dtype).eps / 2
    (f, g), (f_off, g_off) = jets[0], bounds[0]
    inside = torch.ones_like(f, dtype=torch.bool)
    sure = inside
    for (r, slope), (r_off, slope_off), delta in zip(jets[1:], bounds[1:], deltas.double(), strict=True):
        sure = sure & (~inside | ((f.abs() - delta).abs() > f_off))
        inside = inside & (f.abs() < delta)
        gate, fall = torch.ones_like(f), torch.zeros_like(f)
        gate_off, fall_off = fall, fall
        if taper:
            u = ((f.abs() / delta - (1 - taper)) / taper).clamp(0, 1)
            gate, fall = 1 - u * u * (3 - 2 * u), -6 * u * (1 - u) * f.sign() / (delta * taper)
            u_off = f_off / (delta * taper) + GATE * rounding / taper
            gate_off = 1.5 * u_off + GATE * rounding
            fall_off = 6 * (u_off + GATE * rounding) / (delta * taper)
        steeper = 1 + fall * r
        steeper_off = r.abs() * fall_off + (fall.abs() + fall_off) * r_off + SUM * rounding * (1 + (fall * r).abs())
        joined_off = f_off + (r.abs() + r_off) * gate_off + gate * r_off + SUM * rounding * (f.abs() + r.abs())
        columns = (gate[:, None], gate_off[:, None], steeper.abs()[:, None], steeper_off[:, None])
        joined_g_off = columns[2] * g_off + columns[3] * (g.abs() + g_off) + columns[0] * slope_off
        joined_g_off = joined_g_off + columns[1] * (slope.abs() + slope_off)
        joined_g_off = joined_g_off + SUM * rounding * (columns[2] * g.abs() + slope.abs())
        f_off, g_off = torch.where(inside, joined_off, f_off), torch.where(inside[:, None], joined_g_off, g_off)
        g = torch.where(inside[:, None], steeper[:, None] * g + gate[:, None] * slope, g)
        f = torch.where(inside, f + gate * r, f)
    return sure, f_off, g_off


def _product_error(size: Tensor, terms: Tensor, weight: Tensor, u: float, halves: bool) -> Tensor:
    """Of products with ``weight`` whose operands are of a ``size`` and whose |terms| sum up to that, as one matrix."""
    if not halves:
        return _gamma(weight.shape[1], u) * terms
    smallest = SMALLEST_HALF * u * float(weight.abs().max()) * size.sum(dim=-1, keepdim=True)
    return (_gamma(3 * weight.shape[1], u) + HALVES * u) * terms + smallest


def _gamma(terms: int, u: float) -> float:
    """γ of ``terms`` terms and of the operations beside them."""
    return (terms + FURTHER) * u / (1 - (terms + FURTHER) * u)
