import math
from collections.abc import Callable

import pytest
import torch
from mplicits.neural_fields.fields import losses
from mplicits.neural_fields.fields.losses import eikonal_loss, normal_loss, pseudo_huber
from torch import Tensor

AXES = [[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [-1.0, 0.0, 0.0]]
COLORS = [[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]], [[0.5, 0.5, 0.5], [0.4, 0.0, 0.3]]


@pytest.mark.parametrize(
    ("loss", "arguments", "expected"),
    [
        (losses.data_loss, ([0.3, -0.2],), [0.09, 0.04]),
        (losses.data_loss, ([0.5], [0.2]), [0.09]),
        (losses.normal_loss, (AXES, [[1.0, 0.0, 0.0]] * 3), [0.0, 1.0, 2.0]),  # of the angle only
        (losses.eikonal_loss, ([[0.0, 0.6, 0.8], [3.0, 0.0, 0.0]],), [0.0, 4.0]),
        (losses.color_loss, COLORS, [0.0, (0.36 + 0.09) / 3]),
        (lambda x: losses.tangential_loss(x, 0.1), ([[3.0, 0.0, -4.0], [0.0, 0.0, 0.0]],), [0.01 * 25 / 3, 0.0]),
    ],
)
def test_losses(loss: Callable[..., Tensor], arguments: tuple, expected: list[float]) -> None:
    found = loss(*map(torch.tensor, arguments))
    torch.testing.assert_close(found, torch.tensor(expected), rtol=1e-6, atol=1e-6)


def test_pseudo_huber_is_a_square_of_small_angles_and_linear_in_large_ones() -> None:
    scale = 1e-3
    # √(1 + 2c/s) is 1, 2, 3 and 9 at these.
    loss = torch.tensor([0.0, 1.5, 4.0, 40.0], dtype=torch.float64) * scale
    assert pseudo_huber(loss, scale).allclose(torch.tensor([0.0, 1.0, 2.0, 8.0], dtype=torch.float64) * scale)
    assert pseudo_huber(loss, math.inf) is loss
    angle = torch.tensor([1e-4, 1.0], dtype=torch.float64, requires_grad=True)
    pseudo_huber(angle.square() / 2, scale).sum().backward()
    assert float(angle.grad[0]) == pytest.approx(1e-4, rel=1e-5)  # a
    assert float(angle.grad[1]) == pytest.approx(scale**0.5, rel=scale)  # √s, less s/2 of it


def test_derivatives_stay_finite_at_a_vanishing_gradient() -> None:
    gradient = torch.zeros(1, 3, requires_grad=True)
    (eikonal_loss(gradient) + normal_loss(gradient, torch.tensor([[0.0, 0.0, 1.0]]))).sum().backward()
    assert torch.isfinite(gradient.grad).all()
