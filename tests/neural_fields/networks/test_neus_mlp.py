"""The peers: gradients against autograd, the contract of fields, and what their papers say of them."""

import pytest
import torch
from mplicits.neural_fields.networks.neus_mlp import NeusSDF


def test_neus_has_the_gradient_of_autograd() -> None:
    field = NeusSDF(64, 4, frequencies=3, num_features=5).double()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    x = (torch.randn(100, 3, dtype=torch.float64) * 0.5).requires_grad_()
    jet = field.jet(x)
    (expected,) = torch.autograd.grad(field.value(x).sum(), x)
    torch.testing.assert_close(jet.gradient, expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(jet.value, field.value(x))
    assert jet.features.shape == (100, 5)


def test_neus_has_the_published_size_and_begins_as_a_sphere() -> None:
    torch.manual_seed(0)
    field = NeusSDF()
    assert sum(parameter.numel() for parameter in field.parameters()) == 529_076
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    with torch.inference_mode():
        assert float(field.value(0.2 * directions).max()) < 0
        assert float(field.value(0.9 * directions).min()) > 0
        gradient = torch.nn.functional.normalize(field.jet(0.6 * directions).gradient, dim=1)
    assert float((gradient * directions).sum(dim=1).mean()) > 0.9


def test_neus_trains_through_its_gradient() -> None:
    field = NeusSDF(64, 4)
    jet = field.jet(torch.randn(20, 3))
    (jet.gradient.norm(dim=1) - 1).square().mean().backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in field.layers[0].parameters())


def test_neus_too_narrow_for_its_input_is_refused() -> None:
    with pytest.raises(ValueError, match="width=30: expected at least 40"):
        NeusSDF(30)
