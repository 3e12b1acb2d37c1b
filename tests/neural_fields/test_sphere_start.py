"""SIRENs that begin as spheres."""

import pytest
import torch
from mplicits.neural_fields import Siren
from mplicits.neural_fields.sphere_start import fit_sphere


def ball(count: int = 4000) -> torch.Tensor:
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=1)
    return directions * torch.rand(count, 1)


@pytest.mark.parametrize("radius", [0.3, 0.5, 0.8])
def test_a_siren_becomes_the_distance_of_a_sphere(radius: float) -> None:
    network = Siren(32, 2, omega=10.0)
    x = ball()
    with torch.no_grad():
        before = (network.value(x) - (x.norm(dim=1) - radius)).abs().mean()
    fit_sphere(network, radius)
    with torch.no_grad():
        jet = network.jet(x)
    error = jet.value - (x.norm(dim=1) - radius)
    assert float(error.square().mean().sqrt()) < 0.03
    assert float(error.abs().mean()) < 0.2 * float(before)
    off = (x.norm(dim=1) - radius).abs() > 0.08
    assert torch.equal(jet.value[off] > 0, x.norm(dim=1)[off] > radius)
    away = x.norm(dim=1) > 0.15  # the distance has a kink in the middle, a network has none
    cosine = torch.nn.functional.cosine_similarity(jet.gradient[away], x[away], dim=1)
    assert float(cosine.mean()) > 0.98
    assert abs(float(jet.gradient[away].norm(dim=1).mean()) - 1) < 0.1


def test_the_sphere_reaches_the_rim_of_the_unit_ball() -> None:
    network = Siren(32, 2, omega=10.0)
    fit_sphere(network, 0.5)
    rim = torch.nn.functional.normalize(torch.randn(2000, 3), dim=1)
    with torch.no_grad():
        assert float((network.value(rim) - 0.5).abs().max()) < 0.2
        assert float(network.value(rim).min()) > 0.3


def test_the_same_random_state_gives_the_same_start() -> None:
    weights = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        network = Siren(16, 1, omega=10.0)
        fit_sphere(network, steps=5, batch=64)
        weights.append(network.output.weight.detach().clone())
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_features_are_left_as_they_were() -> None:
    """Only distances are trained; the features' own weights see no gradient."""
    network = Siren(16, 2, omega=10.0, num_features=4)
    fit_sphere(network, steps=5, batch=64)
    assert network.jet(torch.zeros(3, 3)).features.shape == (3, 4)
    assert all(bool(parameter.isfinite().all()) for parameter in network.parameters())


@pytest.mark.parametrize("radius", [0.0, -1.0])
def test_a_sphere_without_a_radius_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match=f"radius={radius}: expected > 0"):
        fit_sphere(Siren(16, 1, omega=10.0), radius)
