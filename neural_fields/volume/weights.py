"""Volume rendering of a signed distance field, as in NeuS (Wang et al. 2021): pure functions of rays and samples.

A ray x(t) = o + t v is cut into intervals. Let Φ_s(f) = 1 / (1 + e^{−s f}). An interval along which f falls from f_in
to f_out stops the share α = max(0, 1 − Φ_s(f_out) / Φ_s(f_in)) = 1 − e^{−τ} of the light. Its optical depth is
τ = softplus(−s f_out) − softplus(−s f_in). Transmittances are T_i = exp(−Σ_{j<i} τ_j), the weights w_i = T_i α_i, so
Σ w_i + T_end = 1 without products that underflow.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

from ..backend.devices import uniform
from ..fields.similarity import ball_chord


def neus_optical_depth(
    value: Tensor, slope: Tensor, interval: Tensor, inv_std: Tensor | float, *, cos_anneal: Tensor | float = 1.0
) -> Tensor:
    """Optical depth τ ≥ 0 of intervals, from the field at their middles (NeuS, Eq. 13, in logarithms).

    The field is extended along the ray by its slope c: f_in, f_out = f ∓ c Δ / 2. Early in training a half-open slope
    keeps gradients non-zero where the surface faces away: c′ = −((1 − a) relu(½ − ½c) + a relu(−c)).

    Args:
        value: ``(...,)`` f at the middle of each interval.
        slope: ``(...,)`` c = ⟨∇f, v⟩ there, for unit directions v.
        interval: ``(...,)`` length Δ of each interval.
        inv_std: s, a number or 0-d tensor; 1/s is the width of the surface's uncertainty.
        cos_anneal: a in [0, 1], a number or 0-d tensor: 0 at the start of training, 1 is the true slope.

    Example:
        >>> import torch
        >>> f, c, step = torch.tensor(0.0), torch.tensor(-1.0), torch.tensor(2.0)
        >>> round(float(neus_optical_depth(f, c, step, 1.0)), 4)  # softplus(1) − softplus(−1)
        1.0
    """
    falling = -torch.relu(-slope)
    if isinstance(cos_anneal, Tensor) or cos_anneal < 1:  # the host does not read a tensor
        falling = cos_anneal * falling - (1 - cos_anneal) * torch.relu(0.5 - 0.5 * slope)
    half = 0.5 * interval * falling
    return softplus(-inv_std * (value + half)) - softplus(-inv_std * (value - half))


def neus_alpha(
    value: Tensor, slope: Tensor, interval: Tensor, inv_std: Tensor | float, *, cos_anneal: Tensor | float = 1.0
) -> Tensor:
    """Opacity α = 1 − e^{−τ} in [0, 1) of intervals; the arguments are those of `neus_optical_depth`."""
    return -torch.expm1(-neus_optical_depth(value, slope, interval, inv_std, cos_anneal=cos_anneal))


def transmittance_weights(optical_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w_i ``(R, S)`` of intervals from their optical depths ``(R, S)``, and the light left behind all ``(R,)``.

    Example:
        >>> import torch
        >>> weights, remaining = transmittance_weights(-torch.tensor([[0.5, 0.5]]).log())  # α = 0.5 twice
        >>> weights.tolist(), remaining.tolist()
        ([[0.5, 0.25]], [0.25])
    """
    passed = optical_depth.cumsum(dim=-1)
    weights = (optical_depth - passed).exp() * -torch.expm1(-optical_depth)
    if optical_depth.shape[-1] == 0:
        return weights, optical_depth.new_ones(optical_depth.shape[:-1])
    return weights, (-passed[..., -1]).exp()


def composite(weights: Tensor, values: Tensor) -> Tensor:
    """Σ_i w_i v_i: weights ``(R, S)`` and values ``(R, S, C)`` → ``(R, C)``."""
    return torch.einsum("rs,rsc->rc", weights, values)


def ray_points(origins: Tensor, directions: Tensor, depths: Tensor) -> Tensor:
    """The points o + t v: ``(R, 3)``, ``(R, 3)`` and depths ``(R, S)`` → ``(R, S, 3)``."""
    return origins[:, None] + depths[..., None] * directions[:, None]


def sphere_span(origins: Tensor, directions: Tensor, *, radius: float = 1.0) -> tuple[Tensor, Tensor]:
    """Depths ``(R,)`` at which rays with unit directions enter and leave a sphere around 0.

    The span of a ray that misses the sphere, or leaves it behind itself, has no length. Rays inside begin at depth 0.
    """
    middle, half = ball_chord(origins, directions, radius)
    far = (middle + half).clamp(min=0)
    return (middle - half).clamp(min=0).minimum(far), far


def stratified_depths(near: Tensor, far: Tensor, count: int, *, generator: torch.Generator | None = None) -> Tensor:
    """``count`` increasing depths ``(R, count)`` from near to far ``(R,)``: one in each of as many equal strata.

    With a generator the depths of a ray are shifted together by a random part of a stratum; else they are the middles.
    """
    shift = uniform((len(near), 1), generator, near.device) if generator else 0.5
    strata = (torch.arange(count, device=near.device) + shift) / count
    return near[:, None] + (far - near)[:, None] * strata.to(near.dtype)


def secant_weights(
    depths: Tensor, values: Tensor, inv_std: Tensor | float, *, cos_anneal: Tensor | float = 1.0
) -> Tensor:
    """Weights ``(R, S − 1)`` of intervals from the values ``(R, S)`` at their ends, the increasing depths ``(R, S)``.

    The slope is the steeper one of the interval's own secant and the one before, so that an interval which the surface
    enters through its end is found as well (NeuS, suppl. "hierarchical sampling").
    """
    interval = depths.diff(dim=1)
    secant = values.diff(dim=1) / interval.clamp(min=1e-9)
    previous = torch.cat((torch.zeros_like(secant[:, :1]), secant[:, :-1]), dim=1)
    # Secants over tiny intervals are not bounded by the network's Lipschitz constant.
    slope = torch.minimum(secant, previous).clamp(-10.0, 0)
    middle = 0.5 * (values[:, 1:] + values[:, :-1])
    return transmittance_weights(neus_optical_depth(middle, slope, interval, inv_std, cos_anneal=cos_anneal))[0]


def importance_depths(
    depths: Tensor, values: Tensor, count: int, inv_std: Tensor | float, *, generator: torch.Generator | None = None
) -> Tensor:
    """``count`` more depths on each ray near its surface, ``(R, count)``, sorted: quantiles of the `secant_weights`.

    A ``generator`` draws stratified quantiles; without, they are the middles of ``count`` equal parts.
    """
    interval = depths.diff(dim=1)
    weights = secant_weights(depths, values, inv_std)
    # The least density, as a share of a uniform one: empty rays are sampled evenly.
    density = weights + 1e-3 * interval / (depths[:, -1:] - depths[:, :1]).clamp(min=1e-9) + 1e-9
    cumulative = torch.nn.functional.pad(density.cumsum(dim=1), (1, 0))
    cumulative = cumulative / cumulative[:, -1:]
    quantiles = stratified_depths(torch.zeros_like(depths[:, 0]), torch.ones_like(depths[:, 0]), count)
    if generator:
        shifts = uniform(quantiles.shape, generator, depths.device).to(depths.dtype)
        quantiles = quantiles + (shifts - 0.5) / count
    right = torch.searchsorted(cumulative, quantiles.contiguous()).clamp(1, depths.shape[1] - 1)
    low, high = cumulative.gather(1, right - 1), cumulative.gather(1, right)
    share = ((quantiles - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return torch.lerp(depths.gather(1, right - 1), depths.gather(1, right), share)


def outside_depths(far: Tensor, count: int, *, generator: torch.Generator | None = None) -> Tensor:
    """Depths ``(R, count)`` behind the region of interest, evenly spaced in 1/t from ``far`` towards infinity."""
    shares = stratified_depths(torch.zeros_like(far), torch.ones_like(far), count, generator=generator)
    # One ray in a million has its last share rounded to 1, which would be at infinity.
    shares = shares.clamp(max=1 - 2.0**-20)
    return far[:, None].clamp(min=1e-6) / (1 - shares)


def invert_outside(points: Tensor) -> Tensor:
    """(x, y, z) outside the unit sphere → (x, y, z) / r and 1 / r, four numbers in [−1, 1] (NeRF++, Sec. 4).

    Points inside the unit sphere are taken as if on it.
    """
    radius = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp(min=1)
    return torch.cat((points / radius, 1 / radius), dim=-1)
