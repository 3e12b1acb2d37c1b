"""SIRENs that begin as spheres."""

import pytest
import torch
from mplicits.neural_fields import Siren
from mplicits.neural_fields.networks.multiscale import fit_sphere, solve_sphere


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


def solved(radius: float = 0.35) -> Siren:
    network = Siren(128, 4, omega=10.0, num_features=3)
    solve_sphere(network, radius)
    return network


@pytest.mark.parametrize("radius", [0.2, 0.35, 0.7])
def test_a_solved_start_is_a_sphere_as_near_as_it_says(radius: float) -> None:
    """Off by 0.01, and its slopes by 0.1, in the root mean square, as the function's description has it."""
    for seed in range(3):
        torch.manual_seed(seed)
        network = solved(radius)
        direction = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1)
        x = direction * torch.rand(4000, 1) ** (1 / 3)
        with torch.no_grad():
            jet = network.jet(x)
        error = (jet.value - (x.norm(dim=1) - radius)).square().mean().sqrt()
        assert float(error) < 1.5 * 0.01
        away = x.norm(dim=1) > 0.15  # the distance has a kink in the middle, a network has none
        slopes = (jet.gradient - direction)[away].square().sum(dim=1).mean().sqrt()
        assert float(slopes) < 1.5 * 0.1


def test_no_other_output_is_nearer() -> None:
    """At the least of a sum of squares nothing is gained to first order, whichever weight is changed."""
    network = solved().double()
    torch.manual_seed(0)
    solve_sphere(network, 0.35)
    generator = torch.Generator().manual_seed(0)
    count = 8 * 129
    direction = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    direction = torch.nn.functional.normalize(direction, dim=1)
    lengths = 1.05 * torch.rand(count, 1, generator=generator, dtype=torch.float64).sqrt()
    jet = network.jet(direction * lengths)
    misses = (jet.value - lengths[:, 0] + 0.35).square() + 0.1 * (jet.gradient - direction).square().sum(dim=1)
    total = misses.sum() + 1e-6 * count * network.output.weight[0].square().sum()
    slope = torch.autograd.grad(total, [network.output.weight, network.output.bias])
    size = float(total.detach()) * count  # sums of so many terms, each below one
    assert float(slope[0][0].abs().max()) < 1e4 * size * torch.finfo(torch.float64).eps
    assert abs(float(slope[1][0])) < 1e4 * size * torch.finfo(torch.float64).eps


def test_a_solved_start_draws_nothing_and_leaves_features_and_units() -> None:
    torch.manual_seed(4)
    network = Siren(16, 2, omega=10.0, num_features=2)
    network.set_units(0.5, 0.25)
    state = torch.get_rng_state()
    kept = network.output.weight[1:].clone()
    solve_sphere(network, 0.5)
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(network.output.weight[1:], kept)
    assert network.units == (0.5, 0.25)
    first = network.state_dict()
    solve_sphere(network, 0.5)  # once more is the same
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(tensor, first[name], rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="radius=0"):
        solve_sphere(network, 0)


def test_a_trained_start_does_not_depend_on_units() -> None:
    """Powers of two round nothing, so that the same numbers come to the bit."""
    found = []
    for units in ((1.0, 1.0), (0.5, 0.25)):
        torch.manual_seed(4)
        network = Siren(16, 2, omega=10.0)
        network.set_units(*units)
        fit_sphere(network, steps=5, batch=64)
        assert network.units == units
        found.append(network.state_dict())
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
