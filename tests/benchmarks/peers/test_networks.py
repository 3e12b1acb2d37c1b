"""BACON, IDF, BANF and the single SIREN: what their papers say of the fields, and what their recipes reach."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from mplicits.datasets import OrientedCloud, prepare_cloud, sample_sphere
from mplicits.neural_fields import Field, Siren, Sphere, Torus
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.training.trainer import Progress

# The contract, over the fields below in place of those of the common table, whose levels are nested in bands.
from test_field_contract import (  # noqa: F401
    test_jet_agrees_with_value_and_autograd,
    test_levels_count_from_both_ends_and_stop_there,
    test_results_without_a_graph_are_the_same,
    test_shapes_and_types_follow_the_input,
    test_wrong_dimension_is_refused,
)

from benchmarks.paper import networks
from benchmarks.paper.grids import BanfRecipe, InstantNgpRecipe
from benchmarks.paper.recipe import Recipe, descend
from benchmarks.peers import BaconSDF, BanfSDF, HashGridSDF, IdfSDF


def small_bacon() -> BaconSDF:
    return BaconSDF(12, bands=(1, 1, 2, 2), outputs=(1, 3))


def small_idf() -> IdfSDF:
    """An untrained displacement of a base that has the unit cube within its reach."""
    field = IdfSDF(16, 2, omegas=(2.0, 4.0), limit=0.2, reach=0.5)
    with torch.no_grad():
        field.base.output.weight.mul_(3.0)
    return field


def three_grids() -> BanfSDF:
    return BanfSDF([Torus(), HashGridSDF(levels=2, coarsest=2, finest=8, width=8), Sphere()], [4, 8, 16])


LEVELS = {"bacon": small_bacon, "idf": small_idf, "banf": three_grids}


@pytest.fixture(params=LEVELS)
def make(request: pytest.FixtureRequest) -> Callable[[], Field]:
    return LEVELS[request.param]


@pytest.fixture
def field(make: Callable[[], Field], dtype: torch.dtype, device: torch.device) -> Field:
    return make().to(device=device, dtype=dtype)


def test_levels_are_alternatives_everywhere(field: Field, dtype: torch.dtype, device: torch.device) -> None:
    x = 2 * torch.rand(500, 3, dtype=dtype, device=device) - 1
    assert field.in_band(x, level=1).all()
    assert bool((field.value(x, level=0) != field.value(x, level=1)).any())


@pytest.mark.parametrize("axis", range(3))
def test_bacon_holds_no_frequency_above_its_bound(axis: int) -> None:
    """On a line of one period an output has the harmonics up to the sum of its filters' bands, and no other."""
    field = BaconSDF(10, bands=(1, 2, 2, 3), outputs=(1, 2, 3), period=2.5).double()
    samples = 64
    line = torch.rand(1, 3, dtype=torch.float64).repeat(samples, 1)
    line[:, axis] += torch.arange(samples) * (field.period / samples)
    values = torch.stack(field.level_values(line)).detach()
    for level, bound in enumerate((3, 5, 8)):
        assert field.harmonics(level=level) == bound
        torch.testing.assert_close(values[level], field.value(line, level=level), atol=1e-13, rtol=0)
        spectrum = torch.fft.rfft(values[level]).abs() / samples
        assert float(spectrum[bound + 1 :].max()) < 1e-14
        assert float(spectrum[1 : bound + 1].max()) > 1e-3


def test_bacon_is_a_sum_of_the_sines_that_its_bound_allows() -> None:
    """One layer of one neuron by hand: sin a · (w sin b + c) = w/2 (cos(a − b) − cos(a + b)) + c sin a."""
    field = BaconSDF(1, bands=(2, 3), outputs=(1,), period=2.0).double()
    x = torch.rand(20, 3, dtype=torch.float64)
    b, a = (x @ (math.pi * field.frequencies[i, 0]) + field.phases[i] for i in range(2))
    w, c = field.layers[0].weight[0, 0], field.layers[0].bias[0]
    expected = w / 2 * ((a - b).cos() - (a + b).cos()) + c * a.sin()
    head = field.heads[0]
    torch.testing.assert_close(field.value(x), expected * head.weight[0, 0] + head.bias[0])


def test_idf_without_displacement_is_its_base() -> None:
    field = small_idf().double()
    x = 2 * torch.rand(200, 3, dtype=torch.float64) - 1
    with torch.no_grad():
        field.displacement.output.weight.zero_()
        field.displacement.output.bias.zero_()
    assert torch.equal(field.value(x), field.value(x, level=0))
    torch.testing.assert_close(field.jet(x).gradient, field.jet(x, level=0).gradient, atol=1e-14, rtol=0)


def test_idf_moves_the_surface_by_no_more_than_its_limit() -> None:
    """A base that is a plane and a displacement that is always full: the surface is where y is on the plane."""
    field = IdfSDF(4, 1, limit=0.1, reach=0.3).double().requires_grad_(False)
    for parameter in field.parameters():
        parameter.zero_()
    # sin(1e-3 x) / 1e-3, which is x to seven digits, and tanh ± 50, which is ± 1.
    field.base.layers[0].weight[0, 0] = 1e-3 / field.base.omega
    field.base.output.weight[0, 0] = 1e3
    x = torch.zeros(41, 3, dtype=torch.float64)
    x[:, 0] = torch.linspace(-1, 1, 41)
    for sign in (1, -1):
        field.displacement.output.bias[:] = sign * 50.0
        expected = x[:, 0] + sign * 0.1 / (1 + (x[:, 0] / 0.3) ** 4)
        torch.testing.assert_close(field.value(x), expected, atol=1e-5, rtol=0)


def test_they_train_through_their_gradients(make: Callable[[], Field]) -> None:
    field = make()
    jet = field.jet(2 * torch.rand(50, 3) - 1)
    ((jet.gradient.norm(dim=1) - 1).square().mean() + jet.value.square().mean()).backward()
    assert all(p.grad is not None for name, p in field.named_parameters() if not name.startswith("heads.0"))


@pytest.fixture(scope="module")
def sphere() -> OrientedCloud:
    return prepare_cloud(sample_sphere(2000, radius=3.0))


NAMES = ("siren", "bacon", "idf")
RECIPES = (networks.SirenRecipe, networks.BaconRecipe, networks.IdfRecipe)
PRESETS = (networks.SIREN_PRESETS["smoke"], networks.BACON_PRESETS["smoke"], networks.IDF_PRESETS["smoke"])


def with_steps(steps: int) -> list[Recipe]:
    return [recipe({"smoke": replace(preset, steps=steps)}) for recipe, preset in zip(RECIPES, PRESETS, strict=True)]


def error_near_the_sphere(recipe: Recipe, cloud: OrientedCloud) -> float:
    output = recipe.train(cloud, "smoke", seed=1).outputs[-1]
    x = torch.nn.functional.normalize(torch.randn(2000, 3), dim=1) * (0.9 + 0.2 * torch.rand(2000, 1))
    return float((output.field.value(x, level=output.level) - (x.norm(dim=1) - 1)).abs().mean())


@pytest.mark.parametrize(("recipe", "untrained"), list(zip(RECIPES, with_steps(0), strict=True)), ids=NAMES)
def test_recipe_finds_a_sphere(recipe: type[Recipe], untrained: Recipe, sphere: OrientedCloud) -> None:
    after, before = error_near_the_sphere(recipe(), sphere), error_near_the_sphere(untrained, sphere)
    assert after < min(0.02, before / 5)


@pytest.mark.parametrize(
    "recipe", [InstantNgpRecipe("coarse"), InstantNgpRecipe("fine"), BanfRecipe()], ids=lambda recipe: recipe.name
)
def test_recipe_of_a_grid_finds_a_sphere(recipe: Recipe, sphere: OrientedCloud) -> None:
    assert error_near_the_sphere(recipe, sphere) < 0.015


@pytest.mark.parametrize("recipe", with_steps(4), ids=NAMES)
def test_recipe_reports_repeats_itself_and_leaves_no_trace(recipe: Recipe, sphere: OrientedCloud) -> None:
    reports: list[Progress] = []
    state = torch.get_rng_state()
    trained = recipe.train(sphere, "smoke", seed=3, progress=reports.append)
    assert torch.equal(torch.get_rng_state(), state)
    assert reports[-1].step == reports[-1].steps == trained.steps
    (output,) = trained.outputs
    assert output.parameters <= sum(p.numel() for p in output.field.parameters())
    assert not any(p.requires_grad for p in output.field.parameters())
    x = 2 * torch.rand(100, 3) - 1
    again, other = (recipe.train(sphere, "smoke", seed=seed).outputs[0].field for seed in (3, 4))
    assert torch.equal(again.value(x), output.field.value(x))
    assert not torch.equal(other.value(x), output.field.value(x))


def test_siren_loss_by_hand() -> None:
    """Two points on the surface, one off it; a gradient at 60 degrees to the normal has a cosine of a half."""
    value = torch.tensor([0.1, -0.3, 0.02])
    gradient = torch.tensor([[2.0, 0.0, 0.0], [0.5, math.sqrt(0.75), 0.0], [0.0, 0.0, 1.5]])
    normals = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    expected = {"surface": 0.4, "normal": 0.5, "eikonal": 1.5, "off_surface": math.exp(-2.0)}
    for name, term in expected.items():
        weights = networks.SirenWeights(**(dict.fromkeys(expected, 0.0) | {name: 3.0}))
        assert float(networks.siren_loss(value, gradient, normals, weights)) == pytest.approx(term)


@pytest.mark.slow
@pytest.mark.parametrize("omega", [networks.SIREN_PRESETS["cpu"].omega, networks.IDF_PRESETS["cpu"].omegas[0]])
def test_sphere_start_reaches_into_the_corners_of_the_cube(omega: float) -> None:
    torch.manual_seed(0)
    network = Siren(128, 4, omega=omega)
    networks.begin_as_sphere(network, 200, batch=256)
    x = 2.1 * torch.rand(20_000, 3) - 1.05
    value, distance = network.value(x).detach(), x.norm(dim=1)
    assert float((value - (distance - 0.4)).abs().mean()) < 0.02
    assert bool((value[distance > 1] > 0.2).all())


def test_laplacian_samples_have_their_spread_and_stay_in_the_period(sphere: OrientedCloud) -> None:
    distances = CloudDistance(torch.from_numpy(sphere.points), torch.from_numpy(sphere.normals))
    generator = torch.Generator().manual_seed(0)
    points, distance = networks.laplacian_samples(distances, 4000, scale=0.02, period=2.1, generator=generator)
    assert float(points.abs().max()) <= 1.05
    # Each coordinate is moved by 0.02 on average, and so is the distance, whose spread is that along a normal.
    assert float(distance.abs().mean()) == pytest.approx(0.02, rel=0.1)
    # The discs of 2,000 points lie 0.001 within the sphere.
    assert float((distance - (points.norm(dim=1) - 1)).abs().median()) < 2e-3


def test_idf_trains_on_its_own_gradient_where_the_base_is_flat() -> None:
    """With a base that is a plane and a reach without end, the terms that the training leaves out are zero."""
    field = IdfSDF(8, 1, omegas=(1.0, 5.0), limit=0.1, reach=1e4).double().requires_grad_(False)
    for parameter in field.base.parameters():
        parameter.zero_()
    field.base.layers[0].weight[0, 0] = 1e-5
    field.base.output.weight[0, 0] = 1e5
    x = 2 * torch.rand(50, 3, dtype=torch.float64) - 1
    base, jet = field.base.jet(x), field.jet(x)
    value, gradient = networks.displaced(field, x, base.value, base.gradient)
    torch.testing.assert_close(value, jet.value, atol=1e-9, rtol=0)
    torch.testing.assert_close(gradient, jet.gradient, atol=1e-6, rtol=0)
    assert bool(((jet.gradient - base.gradient).abs() > 0.01).any())


def test_descent_minimises_with_a_rate_for_each_group() -> None:
    moved, slower, still = (torch.nn.Parameter(torch.zeros(1)) for _ in range(3))
    reports: list[Progress] = []
    descend(
        [moved],
        lambda step: ((moved - 1) ** 2 + (slower - 1) ** 2 + (still - 1) ** 2).sum(),
        steps=50,
        rate=lambda done: 0.1 * (1 - done),
        stage="stage",
        progress=reports.append,
        also=[([slower], lambda done: 0.001), ([still], lambda done: 0.0)],
        report_every=30,
    )
    assert moved.item() == pytest.approx(1.0, abs=0.05)
    assert 0.03 < slower.item() < 0.06
    assert still.item() == 0.0
    assert [(report.step, report.fraction) for report in reports] == [(0, 0.0), (30, 0.6), (50, 1)]


def test_descent_clips_the_whole_gradient() -> None:
    """Adam forgets a common factor but not one step: after a step of gradient 1e6, clipped, one of 1 still counts."""
    scales = (1e6, -1.0, -1.0, -1.0)

    def end(clip: float | None) -> float:
        p = torch.nn.Parameter(torch.zeros(1))
        descend([p], lambda step: (scales[step] * p).sum(), steps=4, rate=lambda done: 0.1, stage="", clip=clip)
        return p.item()

    assert end(None) < -0.2
    assert end(1.0) > -0.15
