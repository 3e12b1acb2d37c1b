"""A sphere-like start for SIRENs, which softplus networks have by initialisation (Atzmon and Lipman 2020)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ..backend._checks import positive
from ..fields.losses import data_loss, eikonal_loss, normal_loss
from .siren import Siren, forward

__all__ = ["fit_sphere", "solve_sphere"]

REACH = 1.05  # how far out it is trained: a little further than the unit sphere
DATA_WEIGHT = 100.0  # of squared distances, beside cosines and slopes of order one

# Largest phase per coordinate in the first layer of a solved start. Higher ones fit the sphere worse (it is smooth);
# much lower ones better, but by large weights that cancel, which the first steps of a training break.
PHASE = 1.7
POINTS_PER_WEIGHT = 8
SLOPE_WEIGHT = 0.1  # of squared slopes, beside squared distances
RIDGE = 1e-6  # in mean squares of a sine


def fit_sphere(
    network: Siren, radius: float = 0.5, *, steps: int = 200, batch: int = 1024, learning_rate: float = 3e-3
) -> None:
    """Train a SIREN in place to |x| − radius on the unit ball, for training from images.

    A few seconds on a CPU. torch's random state is used; units stay as they were. The weights that come of it are small
    enough for hosts without a warm-up: where all of them move to the same side by NeuS's full rate, as in Adam's first
    step, the surface of (128, 4) at ω₀ = 10 moves by 0.14, that of NeuS's own network by 0.36.

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
        lengths = REACH * torch.rand(batch, 1).to(place)
        jet = network.jet(direction * lengths)
        data = data_loss(jet.value, lengths[:, 0] - radius)
        loss = DATA_WEIGHT * data + normal_loss(jet.gradient, direction) + eikonal_loss(jet.gradient)
        for group in adam.param_groups:
            group["lr"] = learning_rate * (1 - step / steps)
        adam.zero_grad(set_to_none=True)
        loss.mean().backward()
        adam.step()
    network.set_units(*units)


@torch.no_grad()
def solve_sphere(network: Siren, radius: float = 0.5) -> None:
    """Begin as |x| − radius on the unit ball, by one linear solve: a fit in place of `fit_sphere`'s training.

    The first layer is turned down to phases of at most PHASE per coordinate, the layers after it stay as they were
    drawn, and the output's weights w and bias b for the value are those of least

        Σ (w·h(x) + b − |x| + r)² + SLOPE_WEIGHT |Jᵀw − x / |x||² + RIDGE n |w|²

    over n points in the ball, h being the last sines and J their Jacobian. (128, 4) at ω₀ = 10 is then off by 0.01, and
    its slopes by 0.1: root mean squares over the ball, of the slopes without the middle, where the distance has a kink.
    No random numbers are drawn; features stay as they were. The output's weights are seven times those of `fit_sphere`,
    and cancel: a first step of Adam at NeuS's full rate would move this sphere by five times its radius. So only for
    trainings that warm up slowly, or in which the field is not trained by Adam.

    Args:
        network: untrained; the coarse level.
        radius: of the sphere.

    Raises:
        ValueError: the radius is not positive.

    Example:
        >>> import torch
        >>> from mplicits.neural_fields import Siren
        >>> from mplicits.neural_fields.networks.sphere_init import solve_sphere
        >>> _ = torch.manual_seed(0)
        >>> siren = Siren(128, 4, omega=10.0)
        >>> solve_sphere(siren, radius=0.4)
        >>> bool((siren.value(0.4 * torch.eye(3)).abs() < 0.05).all())
        True
    """
    positive(radius=radius)
    units = network.units
    network.set_units()
    first = network.layers[0]
    assert isinstance(first, nn.Linear)
    # Of numbers uniform up to a bound the root mean square is the bound over √3.
    first.weight.mul_(PHASE / (3**0.5 * network.omega) / first.weight.double().square().mean().sqrt())
    direction, lengths = _ball(POINTS_PER_WEIGHT * (network.width + 1), network)
    sines, slopes = _last_sines((direction * lengths).to(first.weight), network)
    flat = slopes.new_zeros(network.in_dim, len(lengths), 1)
    rows = torch.cat(
        (torch.cat((sines, torch.ones_like(lengths)), dim=1), *SLOPE_WEIGHT**0.5 * torch.cat((slopes, flat), dim=2))
    )
    wanted = torch.cat((lengths[:, 0] - radius, *(SLOPE_WEIGHT**0.5 * direction.t())))
    ridge = torch.full((network.width + 1,), RIDGE * len(lengths), dtype=rows.dtype, device=rows.device)
    ridge[-1] = 0  # a bias may be as large as it likes
    solved = torch.linalg.solve(rows.t() @ rows + ridge.diag(), rows.t() @ wanted).to(first.weight)
    network.output.weight[0] = solved[:-1]
    network.output.bias[0] = solved[-1]
    network.set_units(*units)


def _ball(count: int, network: Siren) -> tuple[Tensor, Tensor]:
    """Directions ``(N, d)`` and lengths ``(N, 1)`` up to REACH in float64, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(count, network.in_dim, generator=generator, dtype=torch.float64)
    lengths = REACH * torch.rand(count, 1, generator=generator, dtype=torch.float64).sqrt()
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
