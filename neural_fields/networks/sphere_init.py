"""A sphere-like start for SIRENs, which softplus networks have by initialisation (Atzmon and Lipman 2020)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..backend.errors import positive
from ..fields.losses import data_loss, eikonal_loss, normal_loss
from .siren import Siren, forward

TRAINED_RADIUS = 1.05  # how far out it is trained: a little further than the unit sphere


def fit_sphere(
    network: Siren, radius: float = 0.5, *, steps: int = 200, batch: int = 1024, learning_rate: float = 3e-3
) -> None:
    """Train a SIREN in place to |x| − radius on the unit ball, for training from images; a few seconds on a CPU.

    torch's random state is used; units stay as they were. The weights are small enough for hosts without a warm-up.

    Args:
        network: the coarse level.
        radius: of the sphere.
        steps: of Adam, its rate falling linearly.
        batch: points per step.
        learning_rate: the first rate.

    Raises:
        ValueError: the radius is not positive.
    """
    positive(radius=radius)
    units = network.units
    network.set_units()  # else the rate would mean something else
    place = network.output.weight
    adam = torch.optim.Adam(network.parameters(), lr=learning_rate, betas=(0.9, 0.99))
    for step in range(steps):
        direction = nn.functional.normalize(torch.randn(batch, network.in_dim).to(place), dim=1)
        lengths = TRAINED_RADIUS * torch.rand(batch, 1).to(place)
        jet = network.jet(direction * lengths)
        data = data_loss(jet.value, lengths[:, 0] - radius)
        # Squared distances weigh 100, beside cosines and slopes of order one.
        loss = 100.0 * data + normal_loss(jet.gradient, direction) + eikonal_loss(jet.gradient)
        for group in adam.param_groups:
            group["lr"] = learning_rate * (1 - step / steps)
        adam.zero_grad(set_to_none=True)
        loss.mean().backward()
        adam.step()
    network.set_units(*units)


@torch.no_grad()
def solve_sphere(
    network: Siren, radius: float = 0.5, *, phase: float = 1.7, slope_weight: float = 0.1, ridge: float = 1e-6
) -> None:
    """Initialise as |x| − radius on the unit ball by one linear solve, instead of the training of `fit_sphere`.

    The first layer is scaled to phases of at most ``phase`` per coordinate: higher ones fit the sphere worse, much
    lower ones need large weights that cancel. The output's weights w and bias b minimise

        Σ (w·h(x) + b − |x| + r)² + slope_weight |Jᵀw − x / |x||² + ridge n |w|²

    over n points in the ball, h being the last sines and J their Jacobian. (128, 4) at ω₀ = 10 is then off by 0.01, and
    its slopes by 0.1 (root mean squares). No random numbers are drawn; features stay as they were. The output's weights
    are seven times those of `fit_sphere`, so use it only for trainings that warm up slowly.
    """
    positive(radius=radius)
    units = network.units
    network.set_units()
    first = network.layers[0]
    assert isinstance(first, nn.Linear)
    # Of numbers uniform up to a bound the root mean square is the bound over √3.
    first.weight.mul_(phase / (3**0.5 * network.omega) / first.weight.double().square().mean().sqrt())
    direction, lengths = _ball(8 * (network.width + 1), network)
    sines, slopes = _last_sines((direction * lengths).to(first.weight), network)
    flat = slopes.new_zeros(network.in_dim, len(lengths), 1)
    rows = torch.cat(
        (torch.cat((sines, torch.ones_like(lengths)), dim=1), *slope_weight**0.5 * torch.cat((slopes, flat), dim=2))
    )
    wanted = torch.cat((lengths[:, 0] - radius, *(slope_weight**0.5 * direction.t())))
    damping = torch.full((network.width + 1,), ridge * len(lengths), dtype=rows.dtype, device=rows.device)
    damping[-1] = 0  # a bias may be as large as it likes
    solved = torch.linalg.solve(rows.t() @ rows + damping.diag(), rows.t() @ wanted).to(first.weight)
    network.output.weight[0] = solved[:-1]
    network.output.bias[0] = solved[-1]
    network.set_units(*units)


def _ball(count: int, network: Siren) -> tuple[Tensor, Tensor]:
    """Directions ``(N, d)`` and lengths ``(N, 1)`` up to 1.05 in float64, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(count, network.in_dim, generator=generator, dtype=torch.float64)
    lengths = TRAINED_RADIUS * torch.rand(count, 1, generator=generator, dtype=torch.float64).sqrt()
    place = network.output.weight.device
    return nn.functional.normalize(direction, dim=1).to(place), lengths.to(place)


def _last_sines(x: Tensor, network: Siren) -> tuple[Tensor, Tensor]:
    """The sines ``(N, width)`` before the output, and their derivatives ``(d, N, width)`` by the coordinates."""
    parameters = network.folded()
    _, sines, phases = forward(x, parameters)
    weights, cosines = parameters[0:-2:2], [phase.cos() for phase in phases]
    tangents = weights[0].t()[:, None] * cosines[0]
    for weight, cosine in zip(weights[1:], cosines[1:], strict=True):
        tangents = (tangents @ weight.t()) * cosine
    return sines[-1].double(), tangents.double()
