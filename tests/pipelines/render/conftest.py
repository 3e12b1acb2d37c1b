"""A network whose level sets are known exactly."""

import math
from collections.abc import Callable, Sequence

import pytest
import torch
from mplicits.neural_fields import Siren


@pytest.fixture(scope="session")
def cosine_blob() -> Callable[[Sequence[float]], Siren]:
    """Makes ``(2.2 − Σ cos 2(x_i − c_i)) / 4``, which is negative around its center c."""

    def make(center: Sequence[float]) -> Siren:
        siren = Siren(3, 1, omega=2.0)
        with torch.no_grad():
            siren.layers[0].weight.copy_(torch.eye(3))
            siren.layers[0].bias.copy_(math.pi / 4 - torch.tensor(center))
            siren.output.weight.fill_(-0.25)
            siren.output.bias.fill_(0.55)
        return siren

    return make
