"""A sphere-like start for SIRENs, which softplus networks have by initialisation (Atzmon and Lipman 2020)."""

from __future__ import annotations

import torch
from torch import nn

from ._checks import positive
from .losses import data_loss, eikonal_loss, normal_loss
from .siren import Siren

__all__ = ["fit_sphere"]

REACH = 1.05  # how far out it is trained: a little further than the unit sphere
DATA_WEIGHT = 100.0  # of squared distances, beside cosines and slopes of order one


def fit_sphere(
    network: Siren, radius: float = 0.5, *, steps: int = 200, batch: int = 1024, learning_rate: float = 3e-3
) -> None:
    """Train a SIREN in place to |x| − radius on the unit ball, for training from images.

    A few seconds on a CPU. torch's random state is used.

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
