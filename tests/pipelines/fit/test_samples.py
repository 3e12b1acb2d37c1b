"""Samples of a sphere's cloud against what the sphere says."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from mplicits.datasets import sample_torus
from mplicits.datasets.clouds.cleaning.orientation import fibonacci_directions
from mplicits.neural_fields import Field, MultiscaleSDF, Siren, Sphere, Torus, Union
from mplicits.neural_fields.fields.losses import pseudo_huber
from mplicits.neural_fields.fields.primitives import Evaluated
from mplicits.pipelines.fit import samples as module
from mplicits.pipelines.fit.cloud import CLOUD, CloudDistance
from mplicits.pipelines.training.settings import FitConfig
from torch import Tensor

from benchmarks.paper.base import train_level

RADIUS = 0.6
CPU = torch.device("cpu")


def sphere_points(count: int, radius: float = RADIUS) -> tuple[Tensor, Tensor]:
    """Nearly uniform points on a sphere, and their normals."""
    normals = torch.from_numpy(fibonacci_directions(count)).float()
    return radius * normals, normals


@pytest.fixture(scope="module")
def cloud() -> CloudDistance:
    return CloudDistance(*sphere_points(20_000))


def sphere_below(top: float, count: int = 20_000, **options: float) -> CloudDistance:
    """A sphere whose cap above ``top`` of its radius was not scanned."""
    points, normals = sphere_points(count)
    seen = normals[:, 2] < top
    return CloudDistance(points[seen], normals[seen], **options)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_spacing_and_distance_of_a_sphere(cloud: CloudDistance) -> None:
    area = 4 * np.pi * RADIUS**2
    assert cloud.areas.sum() == pytest.approx(area, rel=0.1)
    assert cloud.spacing == pytest.approx((area / 20_000) ** 0.5, rel=0.1)
    x = 2 * torch.rand(20_000, 3, generator=generator()) - 1
    expected, found = x.norm(dim=1) - RADIUS, cloud.signed(x)
    clear = expected.abs() > 1e-4
    assert torch.equal(found.sign()[clear], expected.sign()[clear])
    assert (found - expected).abs().max() < 2e-3
    # The distance to the nearest point alone is too long by up to the spacing of the cloud.
    nearest = torch.from_numpy(cloud.nearest(x.numpy()))
    assert (found - expected).abs().mean() < 0.3 * (nearest - expected.abs()).abs().mean()


def test_winding_numbers_tell_inside_from_outside_through_a_hole() -> None:
    points, normals = sphere_points(20_000)
    open_below = points[:, 2] > -0.9 * RADIUS
    cloud = CloudDistance(points[open_below], normals[open_below])
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -0.4], [0.0, 0.0, -0.9], [0.7, 0.0, 0.0], [0.3, 0.3, 0.0]])
    inside = [True, True, False, False, True]
    assert (cloud.winding_number(x.numpy()) > 0.5).tolist() == inside
    assert (cloud.signed(x) < 0).tolist() == inside


def test_beside_the_rim_of_a_hole_discs_that_agree_go_on_where_the_surface_ends() -> None:
    """A bowl: in its opening winding numbers are one half, whatever is beside the rim."""
    bowl = sphere_below(0.0, 40_000)
    beside = torch.tensor([[0.95, 0.0, 0.03], [0.0, 0.95, 0.03], [-0.92, 0.0, 0.05]]) * RADIUS  # within the sphere
    doubt = 0.5 - bowl.winding_number(beside.numpy())
    assert ((doubt > 0) & (doubt < CLOUD.doubt)).all()
    assert (bowl.signed(beside) < 0).all()
    # Not of points that fill a sparse cloud in, which may go on beyond an edge.
    assert (sphere_below(0.0, 40_000, given=1).signed(beside) > 0).all()
    # Beyond the rim's reach, and where its discs are seen edge-on, nothing is better than winding numbers.
    distant = torch.tensor([[0.1, 0.0, 0.05], [0.0, 0.5, -0.05]]) * RADIUS
    turn = torch.linspace(0, 2 * np.pi, 50)
    edge_on = RADIUS * torch.stack((0.99 * turn.cos(), 0.99 * turn.sin(), 0.08 + 0 * turn), dim=1)
    for places in (distant, edge_on):
        assert torch.equal(bowl.signed(places) < 0, torch.from_numpy(bowl.winding_number(places.numpy())) > 0.5)


def test_distance_samples_cover_the_domain_and_the_surface(cloud: CloudDistance) -> None:
    samples = module.distance_samples(cloud, 4000, generator=generator())
    assert len(samples) == 4000
    assert samples.points.abs().max() <= 1.05
    torch.testing.assert_close(samples.distance, samples.points.norm(dim=1) - RADIUS, rtol=0, atol=2e-3)
    assert (samples.distance.abs() < 0.1).float().mean() > 0.4
    assert (samples.points.abs() > 0.9).any(dim=1).float().mean() > 0.1


def test_free_lengths_stop_halfway_to_the_next_sheet() -> None:
    """Between two spheres 0.1 apart a point can move 0.05 towards the other sheet, and δ away from it."""
    inner, inner_normals = sphere_points(20_000, 0.5)
    outer, outer_normals = sphere_points(20_000, 0.6)
    cloud = CloudDistance(torch.cat((inner, outer)), torch.cat((-inner_normals, outer_normals)))
    rows = np.arange(40_000)
    outward, inward = (
        module.free_lengths(cloud, 0.08, rows, np.full(40_000, side), steps=16) for side in (False, True)
    )
    some = np.array([39_999, 3, 3, 25_000])
    ways = np.array([True, False, True, False])
    expected = torch.stack((outward, inward))[ways.astype(int), some]
    torch.testing.assert_close(module.free_lengths(cloud, 0.08, some, ways, steps=16), expected)
    assert inward.min() >= 0.04
    assert inward.max() <= 0.06  # the test of 0.9 t allows 0.0526
    assert (outward[20_000:] == 0.08).all()


def test_offset_samples_have_the_distance_and_normal_they_claim(cloud: CloudDistance) -> None:
    samples = module.offset_samples(cloud, 0.05, 5000, generator=generator())
    jet = Sphere(radius=RADIUS).jet(samples.points)
    torch.testing.assert_close(samples.distance, jet.value, rtol=0, atol=1e-5)
    torch.testing.assert_close(samples.normal, jet.gradient, rtol=0, atol=1e-4)
    assert samples.distance.max() > 0.04
    assert samples.distance.min() < -0.04


def test_band_samples_are_rejected_outside_the_band(cloud: CloudDistance) -> None:
    delta = 0.03
    raw = module.band_samples(cloud, delta, 8000, generator=generator())
    kept = module.with_previous(raw, Sphere(radius=RADIUS), delta, device=CPU)
    assert raw.distance is None
    assert 0.3 < len(kept) / len(raw) < 0.9
    assert (kept.value.abs() < delta).all()
    torch.testing.assert_close(kept.value, kept.points.norm(dim=1) - RADIUS)
    torch.testing.assert_close(kept.gradient, torch.nn.functional.normalize(kept.points, dim=1))


def test_previous_levels_reject_by_every_band() -> None:
    field = MultiscaleSDF(Sphere(radius=RADIUS), [Siren(8, 1)], [0.05])
    with torch.no_grad():
        for parameter in field.levels[1].parameters():
            parameter.zero_()
    x = 2 * torch.rand(5000, 3, generator=generator()) - 1
    kept = module.with_previous(module.Samples(x), field, 0.2, device=CPU)  # the second band is wider than the first
    assert len(kept) == int(((x.norm(dim=1) - RADIUS).abs() < 0.05).sum())


def test_signed_distance_of_a_torus_cloud() -> None:
    torus, sampled = Torus(major=0.6, minor=0.25), sample_torus(40_000, major=0.6, minor=0.25)
    cloud = CloudDistance(torch.from_numpy(sampled.points).float(), torch.from_numpy(sampled.normals))
    x = 2 * torch.rand(5000, 3, generator=generator()) - 1
    expected, found = torus.value(x), cloud.signed(x)
    clear = expected.abs() > 0.01
    assert torch.equal(found.sign()[clear], expected.sign()[clear])
    assert (found - expected).abs().mean() < 1e-3


def test_signs_on_both_sides_of_a_sheet_two_spacings_thick() -> None:
    """A flat ellipsoid, 0.006 thick at most, of points 0.004 apart: neither side outvotes the other."""
    axes = torch.tensor([0.3, 0.1, 0.003])
    lattice, _ = sphere_points(12_000, 1.0)
    points = lattice * axes
    cloud = CloudDistance(points, torch.nn.functional.normalize(points / axes**2, dim=1))
    # Of a sheet so flat the area is that of both sides; each side's points have only their own side to themselves.
    assert cloud.spacing == pytest.approx((2 * np.pi * 0.3 * 0.1 / 12_000) ** 0.5, rel=0.1)
    directions = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator()), dim=1)
    for scale, inside in ((0.3, True), (0.7, True), (1.5, False), (3.0, False)):
        x = directions * axes * scale
        assert ((cloud.signed(x) < 0) == inside).float().mean() > 0.995


def bar(half: float, spacing: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a square bar of the length 1 along x, without its ends, and their normals."""
    x, y = (torch.arange(-reach + spacing / 2, reach, spacing) for reach in (0.5, half))
    along, across = (axis.flatten() for axis in torch.meshgrid(x, y, indexing="ij"))
    top = torch.stack((along, across, torch.full_like(along, half)), 1)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(top), 3)
    turns = [torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    return torch.cat([top @ turn.T for turn in turns]), torch.cat([up @ turn.T for turn in turns])


def test_points_of_a_bar_do_not_share_their_area_with_its_other_sides() -> None:
    """A bar four spacings thick: many of a point's sixteen neighbours are round the corner."""
    half, spacing = 0.02, 0.01
    cloud = CloudDistance(*bar(half, spacing))
    # Beside an edge the eighth like neighbour is twice as far as the first, so that such points count more than others.
    assert cloud.areas.mean() == pytest.approx(spacing**2, rel=0.4)
    along, across = torch.rand(2000, generator=generator()) - 0.5, torch.rand(2000, 2, generator=generator()) - 0.5
    inside = torch.cat((0.8 * along[:, None], 2 * (half - spacing / 2) * across), 1)
    outside = inside * torch.tensor([1.0, 3.0, 3.0])
    outside = outside[outside[:, 1:].abs().amax(dim=1) > half + spacing / 2]
    assert (cloud.signed(inside) < 0).all()
    assert (cloud.signed(outside) > 0).all()


def test_a_normal_with_the_wrong_sign_counts_as_much_as_others() -> None:
    """Few neighbours face its way; with the area of all those that do not, it would outweigh them."""
    points, normals = sphere_points(20_000)
    wrong = torch.rand(20_000, generator=generator()) < 0.1
    cloud = CloudDistance(points, torch.where(wrong[:, None], -normals, normals))
    flipped, others = (float(cloud.areas[some.numpy()].mean()) for some in (wrong, ~wrong))
    assert flipped < 1.2 * others
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.8 * RADIUS], [0.0, 0.0, 1.2 * RADIUS]])
    assert (cloud.signed(x) < 0).tolist() == [True, True, False]


FAR = 0.02  # of leaves of dipoles, each seen as one
PHANTOM = Sphere(radius=0.1, center=(0.85, 0.0, 0.0))


def off_surface(cloud: CloudDistance, field: Field, delta: float = 0.05) -> module.OffSurface:
    """Clear and unseen places of the band around a field."""
    band = module.band_samples(cloud, delta, 40_000, generator=generator())
    band = module.with_previous(band, field, delta, device=CPU)
    return module.off_surface_samples(cloud, field, band, delta, 40_000, generator=generator(), device=CPU)


def test_clear_places_have_their_distance_and_are_drawn_by_the_error_there(cloud: CloudDistance) -> None:
    delta = 0.09  # the gap between points is about 0.015
    for field in (Sphere(radius=RADIUS), Sphere(radius=RADIUS + 0.02), Union(Sphere(radius=RADIUS), PHANTOM)):
        found = off_surface(cloud, field, delta).clear
        assert len(found) > 1000
        gaps = torch.from_numpy(cloud.nearest_gap(found.points.numpy())[1])
        exact = found.points.norm(dim=1) - RADIUS
        assert (exact.abs() > 0.9 * module.SAMPLING.clear * gaps).all()
        assert torch.allclose(found.distance, exact.clamp(-2 * delta, 2 * delta), atol=5e-3)
        error = (found.value - module.nearest_known(found.value, found.distance, 0.5 * delta)).abs()
        torch.testing.assert_close(found.area, error + module.SAMPLING.right * error.mean())
    invented = PHANTOM.value(found.points) < exact - 0.01
    assert invented.sum() > 30
    assert found.area[invented].mean() > 5 * found.area[~invented].mean()
    sparse = CloudDistance(*sphere_points(300))  # between its points the band is far from all of them
    assert len(off_surface(sparse, Sphere(radius=RADIUS), delta=0.01).clear) == 0


def test_a_clear_place_has_no_error_between_the_least_distance_and_that_of_the_points() -> None:
    value = torch.tensor([-1.0, 0.1, 0.3, 0.7, 2.0])
    for sign in (1.0, -1.0):
        distance = torch.full((5,), sign * 0.5)
        possible = module.nearest_known(sign * value, distance, 0.2)
        torch.testing.assert_close(possible, sign * torch.tensor([0.2, 0.2, 0.3, 0.5, 0.5]))
        assert torch.equal(module.nearest_known(value, distance, math.inf), distance)
        assert torch.equal(module.nearest_known(value, distance, 0.8), distance)  # the points are nearer than that


def test_places_in_less_doubt_are_clear_where_normals_are_guesses() -> None:
    """In the mouth of a bowl the winding number is between; guesses are believed from 0.2 and 0.8 on."""
    level, found = Sphere(radius=RADIUS), {}
    for guessed in (False, True):
        bowl = sphere_below(0.3, guessed=guessed)
        found[guessed] = off_surface(bowl, level)
        for places, sure in ((found[guessed].clear, True), (found[guessed].unseen, False)):
            depth = np.abs(bowl.winding_number(places.points.numpy()) - 0.5)
            # Which dipoles count one by one depends on the places of one call.
            least = (module.SAMPLING.sure_guessed if guessed else module.SAMPLING.sure) + (-FAR if sure else FAR)
            assert ((depth > least) == sure).all()
    assert len(found[True].clear) > len(found[False].clear)
    assert len(found[True].unseen) < len(found[False].unseen)


def test_a_level_keeps_what_was_not_scanned(cloud: CloudDistance) -> None:
    """In the hole, and only there, more than δ from its rim, with the value of the level before."""
    level, delta = Sphere(radius=RADIUS - 0.01), 0.05
    found = off_surface(sphere_below(0.8), level, delta).unseen
    assert len(found) > 1000
    assert torch.equal(found.distance, level.value(found.points))
    up = found.points[:, 2] / found.points.norm(dim=1)
    rim = np.cos(np.arccos(0.8) - np.arcsin(delta / (RADIUS + delta)))  # δ away from it, outside at the most
    assert (up > rim - 0.01).all()
    assert up.max() > 0.999
    assert len(off_surface(cloud, level, delta).unseen) == 0


def with_next_level(cloud: CloudDistance, previous: MultiscaleSDF, omega: float, steps: int) -> tuple[list[str], Field]:
    """Names of the sources of the level above ``previous``, and the field with it, trained for a moment."""
    levels = {"widths": (8, 48), "depths": (1, 1), "omegas": (30.0, omega), "learning_rates": (1e-3, 2e-3)}
    config = FitConfig(**levels, steps=(1, steps), batch=1500)
    sources = module.banded_sources(cloud, previous, 0.05, config, generator=generator())
    torch.manual_seed(0)
    siren = train_level(1, sources, config, generator=generator())
    return [source.name for source in sources], previous.with_level(siren, delta=0.05)


@pytest.mark.slow
def test_the_next_level_leaves_the_closing_of_a_hole_as_it_is() -> None:
    cloud, previous = (
        sphere_below(0.8),
        MultiscaleSDF(Sphere(radius=RADIUS + 0.02), [], []),
    )  # off by 0.02 at the points
    names, field = with_next_level(cloud, previous, 40.0, 100)
    assert names == ["surface", "offset", "band", "clear", "unseen"]
    aside = torch.nn.functional.normalize(torch.randn(500, 2, generator=generator()), dim=1)
    cap = torch.cat((0.2 * torch.rand(500, 1) * aside, torch.ones(500, 1)), dim=1)
    cap = torch.nn.functional.normalize(cap, dim=1)
    assert (field.value(cap * (RADIUS + 0.02))).abs().max() < 0.005
    assert field.value(torch.from_numpy(cloud.points)).abs().mean() < 0.005


def test_the_next_level_takes_an_invented_surface_away(cloud: CloudDistance) -> None:
    """Beside a surface that is wrong as well, as that of any level is: what is clear of it may not outweigh it."""
    previous = MultiscaleSDF(Union(Sphere(radius=RADIUS + 0.01), PHANTOM), [], [])
    names, field = with_next_level(cloud, previous, 20.0, 150)
    assert names == ["surface", "offset", "band", "clear"]
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator()), dim=1)
    shell = torch.tensor([0.85, 0.0, 0.0]) + 0.1 * directions
    outside = shell[shell.norm(dim=1) > RADIUS + 0.11]
    assert previous.value(outside).abs().max() < 1e-5
    assert field.value(outside).min() > 0.02
    assert field.value(torch.from_numpy(cloud.points)).square().mean().sqrt() < 0.01


def test_near_a_cloud_of_guessed_normals_winding_numbers_tell_the_side() -> None:
    """One in eight points inward, and its offsets would be on the wrong side; inside the winding number is 3/4."""
    points, normals = sphere_points(20_000)
    normals = torch.where((torch.arange(20_000) % 8 == 0)[:, None], -normals, normals)
    cloud, delta = CloudDistance(points, normals, noise=0.01, guessed=True), 0.05
    samples = module.near_samples(cloud, delta, 2000, generator=generator())
    assert samples.normal is None
    exact = samples.points.norm(dim=1) - RADIUS
    assert exact.abs().max() <= 3**0.5 * delta * (1 + 1e-6)  # of a cube of half-edge δ around a point
    clear = exact.abs() > cloud.noise
    assert clear.float().mean() > 0.5
    # Close to such a point it may be more than 1/4 off.
    assert (samples.distance.sign() != exact.sign())[clear].float().mean() < 0.1 / 8
    assert (samples.distance.abs() - exact.abs()).abs().max() < cloud.spacing

    config, previous = FitConfig(samples=8000), Sphere(radius=RADIUS - 0.01)
    sources = module.banded_sources(cloud, previous, delta, config, generator=generator())
    assert [source.name for source in sources] == ["surface", "near", "band"]
    weights = 0.1 * config.normal_weight, 0.2 * config.eikonal_weight
    assert {(source.normal, source.eikonal) for source in sources} == {weights}


def test_clear_places_begin_with_no_more_loss_than_the_others(cloud: CloudDistance) -> None:
    """A phantom of the size of the band, whose errors would be most of the loss."""
    previous, config = Union(Sphere(radius=RADIUS + 0.01), PHANTOM), FitConfig(samples=100_000)
    *others, found = module.banded_sources(cloud, previous, 0.05, config, generator=generator())
    assert found.name == "clear"
    value, distance = found.samples.known("value", "distance")
    missed, area = (value - module.nearest_known(value, distance, 0.025)).square(), found.samples.area
    usual = float((value - distance).square().median())
    robust = [replace(other, scales=module.RobustScales(data=1e-4)) for other in others]
    for given, scale in ((others, math.inf), (robust, usual)):  # as at level 1, and at the next ones
        clear = replace(found, data=others[0].data).held_back(given)
        assert given is robust or clear.data == found.data
        assert clear.scales.data == pytest.approx(scale)
        loss = float((area * pseudo_huber(missed, scale)).sum() / area.sum())
        begun = sum(source.begins() for source in given)
        assert others[0].data * loss > begun, "this shows nothing"
        assert clear.begins() == pytest.approx(clear.data * loss, rel=1e-5)
        assert clear.begins() == pytest.approx(begun, rel=1e-5)


@pytest.mark.parametrize(("guessed", "left"), [(True, module.SAMPLING.left), (False, 1.0)])
def test_distances_are_weighed_by_the_noise_that_is_left(guessed: bool, left: float) -> None:
    cloud, config = CloudDistance(*sphere_points(2000), noise=0.01, guessed=guessed), FitConfig()
    for error, square, noise in ((1e-3, 0.0, left * 0.01), (0.1, 0.01, 0.0)):  # far below the noise, and far above
        weight = module.level_weights(config, torch.full((2000,), error), cloud)[0]
        assert weight == pytest.approx(config.data_weight_after(square, noise))


def test_usual_errors_are_those_of_the_smooth_places() -> None:
    points, normals = sphere_points(1001)
    across = torch.nn.functional.normalize(torch.linalg.cross(normals, torch.tensor([[0.3, 0.5, -0.8]])), dim=1)
    angle, off = torch.deg2rad(torch.linspace(0, 8, 1001)), torch.linspace(0, 0.02, 1001)
    # A quarter of them, as beside edges: the medians stay.
    angle[751:], off[751:] = np.deg2rad(40), 0.09
    tilted = angle.cos()[:, None] * normals + angle.sin()[:, None] * across
    surface = module.with_previous(module.Samples(points, off, tilted), Sphere(radius=RADIUS), 0.1, device=CPU)
    band = module.Samples(points, gradient=normals * (1 + torch.linspace(0, 0.2, 1001))[:, None])
    scales = module.robust_scales(surface, band)
    assert scales.data == pytest.approx(0.01**2, rel=1e-3)
    assert scales.normal == pytest.approx(1 - np.cos(np.deg2rad(4)), rel=2e-3)  # float32 rounds by 6e-8 of 2e-3
    assert scales.eikonal == pytest.approx(0.1**2, rel=1e-3)


@pytest.mark.parametrize("robust", [True, False])
def test_the_scales_of_errors_are_those_of_the_level_before(robust: bool) -> None:
    index = CloudDistance(*sphere_points(2000))
    config = FitConfig(samples=2000, robust_normals=robust)
    sources = module.banded_sources(index, Sphere(radius=RADIUS - 0.01), 0.05, config, generator=generator())
    # The normals of the spheres are alike, their gradients of length 1. The first residual squares its distances.
    expected = (np.inf, *module.LEAST[1:]) if robust else module.SQUARES
    assert [tuple(source.scales) for source in sources] == [tuple(expected)] * 3
    nothing = Siren(8, 2, omega=10.0)
    torch.nn.init.zeros_(nothing.output.weight)
    torch.nn.init.zeros_(nothing.output.bias)
    two = MultiscaleSDF(Sphere(radius=RADIUS - 0.01), [nothing], [0.05])
    sources = module.banded_sources(index, two, 0.05, config, generator=generator())
    assert sources[0].scales.data == (pytest.approx(1e-4, rel=1e-4) if robust else np.inf)


FOUR = torch.tensor([0.01, -0.02, 0.005, 0.0])
STRAY = torch.cat((torch.full((9999,), 0.01), torch.tensor([1.0])))
# More than one in a hundred: the 99th percentile is itself a stray's.
STRAYS = torch.cat((torch.linspace(0, 0.01, 9500), torch.linspace(0.4, 1, 500)))
NORMAL = torch.randn(50_000, generator=generator())


@pytest.mark.parametrize(
    ("errors", "quantile", "largest", "rule", "outside"),
    [
        (FOUR, 1.0, 0.02, "quantile", 0),
        (FOUR, 0.75, 0.01, "quantile", 1),
        (FOUR, None, 0.02, "maximum", 0),
        (STRAY, 1.0, 1.0, "quantile", 0),
        (STRAY, 0.999, 0.01, "quantile", 1),
        (STRAY, None, 0.01, "maximum but for strays", 1),
        (STRAYS, None, 0.01, "maximum but for strays", 500),
        (NORMAL, None, float(NORMAL.abs().max()), "maximum", 0),
        (torch.zeros(5), None, 1e-6 / 1.3, "maximum", 0),
    ],
)
def test_delta_is_equation_5(errors: Tensor, quantile: float | None, largest: float, rule: str, outside: int) -> None:
    band = module.band_of(errors, epsilon=0.3, quantile=quantile)
    assert band.delta == pytest.approx(1.3 * largest)
    assert (band.rule, band.outside) == (rule, outside)


def test_a_band_is_no_wider_than_the_one_before() -> None:
    band = module.band_of(FOUR, epsilon=0.3, quantile=0.75)
    assert band.within(None, FOUR) is band.within(0.07, FOUR) is band
    assert band.within(0.006, FOUR) == module.Band(0.006, "no wider than the band before", 2)


def widened(field: Field, delta: float) -> module.Band:
    """The band of a field that was fitted to a sphere of radius 0.5."""
    cloud = CloudDistance(*sphere_points(10_000, 0.5))
    band, options = module.Band(delta, "maximum", 1), {"epsilon": 0.05, "count": 400_000, "seed": 0, "device": CPU}
    return module.with_wrong_sides(band, torch.tensor([delta]), cloud, field, **options)


@pytest.mark.parametrize("radius", [0.5, 0.52, 0.48])
def test_a_level_that_is_right_keeps_the_band_of_its_points(radius: float) -> None:
    assert widened(Sphere(radius=radius), 0.03).delta == 0.03


@pytest.mark.parametrize(
    ("delta", "expected"),
    [(0.12, 1.05 * 0.2), (0.06, module.BAND.widest * 0.06), pytest.param(0.21, 0.21, marks=pytest.mark.slow)],
)
def test_a_band_holds_what_a_level_puts_on_the_wrong_side(delta: float, expected: float) -> None:
    """A ball of radius 0.2 hangs beside the sphere: 0.2 deep. The deepest place in it decides, nearly."""
    band = widened(Union(Sphere(radius=0.5), Sphere(radius=0.2, center=(0.8, 0.0, 0.0))), delta)
    assert 0.8 * expected < band.delta <= expected * (1 + 1e-6)
    assert (band.rule == "places on the wrong side") == (delta < 0.2)
    assert band.outside == (delta > 0.2)  # the one input point is at δ: a wider band holds it


def test_a_hollow_that_a_level_invents_is_on_the_wrong_side_too() -> None:
    class Hollow(Sphere):
        def _evaluate(self, x: torch.Tensor) -> Evaluated:
            value, gradient = super()._evaluate(x)
            return torch.maximum(value, 0.2 - x.norm(dim=-1)), gradient

    assert 0.7 * 0.21 < widened(Hollow(radius=0.5), 0.12).delta <= 0.21
