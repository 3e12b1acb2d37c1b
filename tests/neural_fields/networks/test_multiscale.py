from collections.abc import Callable

import pytest
import torch
from bounds import assert_within, rounding
from fields import Watched, cube, small_multiscale
from mplicits.neural_fields import Field, FunctionField, Moving, MultiscaleSDF, RigidMotion, Siren, Sphere, TimeSlice
from mplicits.neural_fields.networks.multiscale import fit_sphere
from torch import Tensor


def watched_levels() -> tuple[MultiscaleSDF, list[Watched]]:
    residuals = [FunctionField(lambda x, c=constant: 0 * x[..., 0] + c) for constant in (0.01, 0.02)]
    levels = [Watched(field) for field in (Sphere(radius=0.5), *residuals)]
    return MultiscaleSDF(levels[0], levels[1:], [0.1, 0.05]), levels


def test_sum_of_the_paper_is_the_field() -> None:
    sdf = small_multiscale().double()
    x = cube(500)
    base, *residuals = sdf.levels
    f = base.value(x)
    inside = torch.ones(len(x), dtype=torch.bool)
    for residual, delta in zip(residuals, sdf.deltas, strict=True):
        inside = inside & (f.abs() < delta)
        f = torch.where(inside, f + residual.value(x), f)
    assert_within(sdf.value(x), f, 2 * rounding(sdf, x, lambda field, x: [field.value(x)])[0])


METHODS: dict[str, Callable[[Field, Tensor, int], object]] = {
    "value": lambda field, x, level: field.value(x, level=level),
    "level_values": lambda field, x, level: field.level_values(x, level=level),
    "in_band": lambda field, x, level: field.in_band(x, level=level),
    "jet": lambda field, x, level: field.jet(x, level=level),
    "second_jet": lambda field, x, level: field.second_jet(x, level=level),
}
WRAPPED: dict[str, Callable[[MultiscaleSDF], tuple[Field, int]]] = {
    "as it is": lambda sdf: (sdf, 3),
    "moving": lambda sdf: (Moving(sdf, RigidMotion()), 4),
    "a slice": lambda sdf: (TimeSlice(Moving(sdf, RigidMotion()), 0.5), 3),
}


@pytest.mark.parametrize("wrapped", WRAPPED)
@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("method", METHODS)
def test_every_level_is_evaluated_once_and_only_in_its_band(method: str, level: int, wrapped: str) -> None:
    sdf, levels = watched_levels()
    field, dim = WRAPPED[wrapped](sdf)
    x = 2 * torch.rand(10_000, dim) - 1
    distance = x[:, :3].norm(dim=-1) - 0.5
    in_first = distance.abs() < 0.1
    in_both = in_first & ((distance + 0.01).abs() < 0.05)
    rows = [len(x), int(in_first.sum()), int(in_both.sum())]
    assert 0 < rows[2] < rows[1] < 1000
    METHODS[method](field, x, level)
    # The band of a level is that of the coarser ones.
    needed = level if method == "in_band" else level + 1
    requested = [count if index < needed else 0 for index, count in enumerate(rows)]
    jets = method in ("jet", "second_jet")
    assert [watched.counts() for watched in levels] == [(0, count) if jets else (count, 0) for count in requested]


def test_no_row_in_the_band() -> None:
    sdf = small_multiscale()
    far = MultiscaleSDF(Sphere(radius=0.5), sdf.levels[1:], [1e-6, 1e-6])
    x = torch.rand(10, 3) + 5
    assert torch.equal(far.value(x), far.base.value(x))


def test_taper_makes_value_and_gradient_continuous_at_the_edge() -> None:
    """Across |f| = δ the hard gate jumps by the residual; the tapered one by nothing."""
    residual = Siren(16, 2, omega=5.0).double()
    step = 1e-9
    radii = torch.tensor([0.625 - step, 0.625 + step], dtype=torch.float64)
    direction = torch.nn.functional.normalize(torch.randn(200, 1, 3, dtype=torch.float64), dim=-1)
    x = direction * radii[:, None]
    for taper, continuous in ((0.0, False), (0.3, True)):
        sdf = MultiscaleSDF(Sphere(radius=0.5), [residual], [0.125], taper=taper).double()
        jet = sdf.jet(x)
        value_jump = (jet.value[:, 1] - jet.value[:, 0]).abs().max()
        gradient_jump = (jet.gradient[:, 1] - jet.gradient[:, 0]).norm(dim=-1).max()
        # A continuous value changes by its slope times the way, and the slope of the gate by 6 / (0.3 δ)² times it.
        assert (value_jump < 10 * 2 * step) == continuous
        assert (gradient_jump < 10 * 6 / (0.3 * 0.125) ** 2 * 2 * step) == continuous


def test_with_level_shares_the_levels() -> None:
    base, residual = Siren(8, 1), Siren(8, 2)
    one = MultiscaleSDF(base, [], [])
    two = one.with_level(residual, delta=0.2)
    assert (two.base, two.num_levels) == (base, 2)
    assert torch.equal(two.deltas, torch.tensor([0.2]))
    x = torch.rand(20, 3)
    assert torch.equal(two.value(x, level=0), one.value(x))


def test_training_reaches_every_level() -> None:
    sdf = small_multiscale(0.3)
    sdf.jet(2 * torch.rand(500, 3) - 1).gradient.square().sum().backward()
    assert all(p.grad is not None and bool((p.grad != 0).any()) for n, p in sdf.named_parameters() if "weight" in n)


@pytest.mark.parametrize("radius", [0.3, 0.5, 0.8])
def test_a_siren_becomes_the_distance_of_a_sphere(radius: float) -> None:
    network = Siren(32, 2, omega=10.0)
    x = torch.nn.functional.normalize(torch.randn(4000, 3), dim=1) * torch.rand(4000, 1)
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


def test_a_trained_start_does_not_depend_on_units() -> None:
    found = []
    for units in ((1.0, 1.0), (0.5, 0.25)):
        torch.manual_seed(4)
        network = Siren(16, 2, omega=10.0)
        network.set_units(*units)
        fit_sphere(network, steps=5, batch=64)
        assert network.units == units
        found.append(network.state_dict())
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
