"""Rendered rays against exact surfaces, a loop over rays and samples, and every kind of field."""

from typing import Any

import pytest
import torch
from fields import FIELDS
from mplicits.neural_fields import ColorNetwork, Jet, MultiscaleSDF, Plane, Siren, Sphere, render_volume
from mplicits.neural_fields.backend.fixed_shapes import fixed_shapes
from mplicits.neural_fields.fields.field import as_field
from mplicits.neural_fields.networks.colors import BackgroundField
from mplicits.neural_fields.networks.grids import ValueGrid
from mplicits.neural_fields.volume.render import Rendered, Samples, Sampling, render_samples, sample_depths, sample_rays
from mplicits.neural_fields.volume.weights import sphere_span
from torch import Tensor

from benchmarks.costs.speed import counted


def rays(count: int, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Rays from distance 2 towards points near the centre."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) * 2
    targets = (torch.rand(count, 3, generator=generator) - 0.5) * 0.8
    return origins, torch.nn.functional.normalize(targets - origins, dim=1)


def position_color(x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
    return 0.5 + 0.5 * x


def test_a_sharp_sphere_is_seen_where_it_is() -> None:
    sphere = Sphere(radius=0.5)
    origins, directions = rays(200)
    seen = render_volume(sphere, position_color, origins, directions, inv_std=2000.0, background=torch.ones(3))
    near, far = sphere_span(origins, directions, radius=0.5)
    hit = (far - near) > 0.2
    assert int(hit.sum()) > 50
    point = origins + near[:, None] * directions
    torch.testing.assert_close(seen.depth[hit], near[hit], atol=2e-3, rtol=0)
    torch.testing.assert_close(seen.color[hit], 0.5 + 0.5 * point[hit], atol=2e-3, rtol=0)
    torch.testing.assert_close(seen.normal[hit], point[hit] / 0.5, atol=6e-3, rtol=0)
    assert float(seen.opacity[hit].min()) > 0.999
    missed = sphere.value(origins - (origins * directions).sum(1, keepdim=True) * directions) > 0.02
    assert float(seen.opacity[missed].max()) < 1e-6
    torch.testing.assert_close(seen.color[missed], torch.ones(int(missed.sum()), 3))


def test_agrees_with_a_loop_over_rays_and_samples() -> None:
    field = Siren(24, 2, omega=4.0).double().requires_grad_(False)
    origins, directions = (part.double() for part in rays(5))
    sampling = Sampling(uniform=12, importance=8, rounds=2)
    seen = render_volume(field, position_color, origins, directions, inv_std=20.0, sampling=sampling)
    near, far = sphere_span(origins, directions)
    edges = sample_depths(field, origins, directions, near, far, sampling)
    for ray in range(5):
        light, color, depth = 1.0, torch.zeros(3, dtype=torch.float64), 0.0
        for start, end in zip(edges[ray, :-1], edges[ray, 1:], strict=True):
            t = (start + end) / 2
            x = (origins[ray] + t * directions[ray]).requires_grad_()
            f = field.value(x)
            slope = float(torch.autograd.grad(f, x)[0] @ directions[ray])
            f = f.detach()
            step = min(slope, 0.0) * float(end - start) / 2
            entering, leaving = (torch.sigmoid(20 * (f - sign * step)) for sign in (1, -1))
            alpha = float(1 - leaving / entering)
            color, depth = color + light * alpha * (0.5 + 0.5 * x.detach()), depth + light * alpha * float(t)
            light *= 1 - alpha
        torch.testing.assert_close(seen.color[ray], color)
        assert float(seen.depth[ray]) == pytest.approx(depth, abs=1e-9)
        assert float(seen.opacity[ray]) == pytest.approx(1 - light, abs=1e-9)


@pytest.mark.parametrize("name", [name for name in FIELDS if FIELDS[name]().in_dim == 3])
def test_every_field_renders_and_trains(name: str) -> None:
    field = FIELDS[name]()
    features = field.jet(torch.zeros(1, 3)).features.shape[-1]
    color, inv_std = ColorNetwork(features, width=16, depth=1), torch.tensor(20.0, requires_grad=True)
    sampling = Sampling(uniform=8, importance=4, rounds=2)
    seen = render_volume(field, color, *rays(6), inv_std=inv_std, sampling=sampling)
    assert seen.color.shape == (6, 3)
    assert seen.weights.shape == seen.depths.shape == (6, 13)
    (seen.color.sum() + seen.jet.gradient.square().sum()).backward()
    for parameter in (inv_std, *field.parameters(), *color.parameters()):
        assert not parameter.requires_grad or bool(parameter.grad.isfinite().all())


def test_no_rays_are_legal() -> None:
    seen = render_volume(Sphere(), position_color, torch.empty(0, 3), torch.empty(0, 3), inv_std=10.0)
    assert seen.color.shape == (0, 3)


@pytest.mark.parametrize("spare", [None, 0, 7, -1])
def test_in_fixed_shapes_rays_see_the_same_if_capacity_suffices(spare: int | None) -> None:
    torch.manual_seed(0)
    field = MultiscaleSDF.from_widths([(16, 1), (16, 1)], omegas=[4, 8], deltas=[0.02], taper=0.5, num_features=3)
    color, around = ColorNetwork(3, width=8, depth=1), BackgroundField(width=8, depth=1)
    field, color, around = field.double(), color.double(), around.double()
    parameters = [*field.parameters(), *color.parameters(), *around.parameters()]
    origins, directions = (part.double() for part in rays(40))

    def render() -> list[Tensor]:
        thresholds = {"early_stop_eps": 0.05, "alpha_threshold": 0.05, "sampling": Sampling(12, 8, 2)}
        seen = render_volume(field, color, origins, directions, inv_std=300.0, outside=around, **thresholds)
        loss = seen.color.square().sum() + (seen.counts * seen.jet.gradient.square().sum(dim=-1)).sum()
        grown = torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True)
        return [seen.color, seen.counts, seen.opacity, seen.depth, seen.normal, seen.weights, *seen.jet, *grown]

    usual = render()
    with fixed_shapes() as shapes:
        fixed = render()
    requested = {name: int(number) for name, number in shapes.named_requested.items()}
    assert requested["samples"] == int((usual[1] > 0).sum()) < usual[1].numel()
    assert 0 < requested["colors"] < requested["samples"]
    assert 0 < requested["outside"] < 40
    (band,) = (int(number) for number in shapes.requested)
    assert 0 < band < requested["samples"]
    if spare is not None:
        named = {name: count + spare for name, count in requested.items()}
        with fixed_shapes([band + spare], named_capacity=named) as shapes:
            fixed = render()
        if spare < 0:  # the overflow is reported, and one ray lacks a sample
            assert int(shapes.named_requested["samples"]) == requested["samples"]
            assert not torch.equal(fixed[0], usual[0])
            return
    for one, same in zip(usual, fixed, strict=True):
        torch.testing.assert_close(same, one, rtol=1e-10, atol=1e-10)  # float64 sums of some hundred numbers


def test_earlier_names_of_arguments_warn() -> None:
    with pytest.warns(DeprecationWarning, match="least_weight is now called early_stop_eps"):
        before = render_volume(Sphere(), position_color, *rays(4), inv_std=100.0, least_weight=1e-3)
    now = render_volume(Sphere(), position_color, *rays(4), inv_std=100.0, early_stop_eps=1e-3)
    assert torch.equal(before.color, now.color)


def test_sampling_and_rendering_are_two_calls() -> None:
    origins, directions = rays(5)
    samples = sample_rays(Sphere(), origins, directions, inv_std=100.0)
    assert torch.equal(samples.t_starts[:, 1:], samples.t_ends[:, :-1])
    edges = torch.tensor([[1.0, 1.25, 2.0]])
    own = Samples(edges[:, :-1], edges[:, 1:], torch.ones(1, 2), skipped=False)
    eye, ahead = torch.tensor([[0.0, 0, 2]]), torch.tensor([[0.0, 0, -1]])
    seen = render_samples(Plane(offset=0.5), position_color, eye, ahead, own, inv_std=4.0)
    # From f = 0.5 at the first depth to -0.5 at the last: the light left is the ratio of sigmoids.
    expected = torch.sigmoid(torch.tensor(-2.0)) / torch.sigmoid(torch.tensor(2.0))
    torch.testing.assert_close(1 - seen.opacity[0], expected)


class TestBands:
    def field(self) -> MultiscaleSDF:
        return MultiscaleSDF(Sphere(radius=0.5), [Siren(16, 2, omega=5.0, output_gain=0.01)], [0.05], taper=0.3)

    def test_samples_outside_the_band_never_reach_the_residual(self) -> None:
        field = self.field()
        wrapped, (base, residual) = counted(field)
        origins, directions = rays(100)
        seen = render_volume(wrapped, position_color, origins, directions, inv_std=100.0)
        points = origins[:, None] + seen.depths[..., None] * directions[:, None]
        inside = int((field.value(points, level=0).abs() < 0.05).sum())
        assert 0 < inside < 0.7 * seen.depths.numel()
        assert residual.jets == inside
        assert residual.values == 0
        assert base.jets == seen.depths.numel()

    def test_samples_cover_the_band_where_the_finer_surface_may_lie(self) -> None:
        # Were the weights that place samples as sharp as they get, all samples would sit on the coarse surface.
        origins, directions = rays(50)
        near, far = sphere_span(origins, directions)
        edges = sample_depths(self.field(), origins, directions, near, far, Sampling(importance=64, sharpness=1e4))
        values = Sphere(radius=0.5).value(origins[:, None] + edges[..., None] * directions[:, None])
        hit = (values < 0).any(dim=1)
        assert float((values[hit].abs() < 0.04).float().mean()) > 0.3
        assert float((values[hit].abs() < 0.001).float().mean()) < 0.2

    def test_light_samples_get_no_colour(self) -> None:
        evaluated: list[int] = []

        def color(x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
            evaluated.append(len(x))
            return position_color(x, direction, jet)

        field = self.field()
        everywhere = render_volume(field, color, *rays(50), inv_std=200.0)
        only = render_volume(field, color, *rays(50), inv_std=200.0, early_stop_eps=1e-4)
        assert evaluated[1] < 0.6 * evaluated[0]
        torch.testing.assert_close(only.color, everywhere.color, atol=1e-4 * 129, rtol=0)
        assert float((only.color - everywhere.color).detach().abs().max()) > 0


def red(x: Tensor, direction: Tensor, jet: Jet) -> Tensor:
    return torch.tensor([1.0, 0, 0]).expand_as(x)


def fog(inverted: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """A dense green background."""
    assert inverted.shape[-1] == 4
    return torch.full(inverted.shape[:1], 1e3), torch.tensor([0.0, 1.0, 0.0]).expand(len(inverted), 3)


# Rays through the middle, past the sphere, and away from it.
EYES = torch.tensor([[0.0, 0.0, 2.0], [1.5, 0.0, 2.0], [0.0, 0.0, 2.0]])
ALONG = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def test_the_outside_is_seen_past_the_sphere_only() -> None:
    seen = render_volume(Sphere(radius=0.5), red, EYES[:2], ALONG[:2], inv_std=1000.0, outside=fog)
    torch.testing.assert_close(seen.color, torch.tensor([[1.0, 0, 0], [0, 1, 0]]), atol=1e-3, rtol=0)


@pytest.mark.parametrize("skip", [0.0, 1e-3])
def test_sections_of_rays_that_miss_the_sphere_stand_for_nothing(skip: float) -> None:
    options = {"inv_std": 50.0, "outside": fog, "alpha_threshold": skip, "skip_share": 0.5}
    field = MultiscaleSDF.from_widths([(8, 1), (8, 1)], omegas=[5, 10], deltas=[0.2])

    def seen(rows: list[int]) -> Rendered:
        generator = torch.Generator().manual_seed(0)
        return render_volume(field, red, EYES[rows], ALONG[rows], generator=generator, **options)

    both = seen([0, 1, 2])
    assert (both.counts > 0).any(dim=1).tolist() == [True, False, False]
    assert both.opacity[1:].tolist() == [0.0, 0.0]
    nothing = seen([1, 2])  # no sample at all is evaluated
    assert not nothing.counts.any()
    assert bool(torch.isfinite(nothing.color).all())
    nothing.color.sum().backward()


def test_what_is_behind_something_opaque_is_not_evaluated() -> None:
    evaluated = []

    def mist(inverted: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        evaluated.append(direction)
        return torch.ones(len(inverted)), torch.ones(len(inverted), 3)

    options = {"inv_std": 1000.0, "outside": mist, "background": torch.zeros(3), "sampling": Sampling(outside=4)}
    seen = render_volume(Sphere(radius=0.5), red, EYES, ALONG, early_stop_eps=1e-4, **options)
    assert torch.equal(evaluated[0], ALONG[1:].repeat_interleave(4, dim=0))
    expected = render_volume(Sphere(radius=0.5), red, EYES, ALONG, **options)
    # A ray of S samples loses 1e-4 of each at most, and of the light that is left.
    torch.testing.assert_close(seen.color, expected.color, rtol=0, atol=1e-4 * (expected.weights.shape[1] + 1))


def test_gradients_reach_the_field_through_the_weights() -> None:
    # Growing the sphere brings its surface nearer: ∂depth/∂bias of f = |x| − r is +1 along the axis.
    class Shifted(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.bias = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))

        def forward(self, x: Tensor) -> Tensor:
            return x.norm(dim=-1) - 0.5 + self.bias

    shifted, eye = Shifted(), EYES[:1].double()
    field, sampling = as_field(shifted), Sampling(uniform=256, importance=256)
    seen = render_volume(field, position_color, eye, -eye / 2, inv_std=100.0, sampling=sampling)
    (slope,) = torch.autograd.grad(seen.depth.sum(), shifted.bias)
    assert float(slope) == pytest.approx(1, abs=0.02)


class TestSkipping:
    def field(self) -> MultiscaleSDF:
        """The finer surface lies 0.01 inside the coarser one, where the weights are estimated."""
        inside = as_field(lambda x: 0.01 + 0 * x[..., 0])
        return MultiscaleSDF(Sphere(radius=0.5), [inside], [0.08], taper=0.3).double()

    def seen(self, **options: Any) -> Rendered:
        origins, directions = (part.double() for part in rays(300))
        options |= {"inv_std": 150.0, "background": torch.ones(3, dtype=torch.float64)}
        return render_volume(self.field(), position_color, origins, directions, **options)

    @pytest.mark.parametrize("skip", [1e-2, 1e-4])
    def test_colours_are_off_by_the_skipped_weight_at_most(self, skip: float) -> None:
        full, some = self.seen(), self.seen(alpha_threshold=skip)
        assert torch.equal(full.depths, some.depths)
        skipped = some.counts == 0
        lost = (full.weights * skipped).sum(dim=1)
        assert float(skipped.double().mean()) > 0.3
        assert float(lost.max()) > 0
        error = (some.color - full.color).abs().amax(dim=1)
        assert bool((error <= lost + 1e-12).all())
        torch.testing.assert_close(some.weights.sum(dim=1) + (1 - some.opacity), torch.ones(300).double())
        assert float(some.weights[skipped].abs().max()) == 0
        # Each neighbourhood that was found light has less than its estimate; 129 intervals are on a ray.
        assert float(lost.max()) < 129 * skip

    def test_nothing_changes_where_nothing_is_skipped(self) -> None:
        full = self.seen(generator=torch.Generator().manual_seed(1))
        every = self.seen(alpha_threshold=1e-3, skip_share=1.0, generator=torch.Generator().manual_seed(1))
        assert bool((torch.stack((full.counts, every.counts)) == 1).all())
        torch.testing.assert_close(every.color, full.color, atol=1e-12, rtol=0)
        torch.testing.assert_close(every.jet.gradient, full.jet.gradient, atol=1e-12, rtol=0)

    def test_those_kept_by_chance_stand_for_the_others(self) -> None:
        counts = self.seen(alpha_threshold=1e-3, skip_share=0.25, generator=torch.Generator().manual_seed(1)).counts
        assert {*counts.unique().tolist()} == {0.0, 1.0, 4.0}
        light = counts[counts != 1]
        # Each is 4 with a probability of 1/4, so of n the mean is 1 with a variance of 3/n.
        assert abs(float(light.mean()) - 1) < 5 * (3 / len(light)) ** 0.5
        assert {*self.seen(alpha_threshold=1e-3, skip_share=0.25).counts.unique().tolist()} == {0.0, 1.0}

    def test_rays_that_miss_keep_where_they_come_nearest(self) -> None:
        field, origins = Sphere(radius=0.5), torch.tensor([[0.0, 0.7, 2.0], [0.0, 0.9, 2.0]])
        seen = render_volume(field, position_color, origins, ALONG[:2], inv_std=1e3, alpha_threshold=1e-3)
        assert (seen.counts == 1).sum(dim=1).tolist() == [1, 1]
        assert bool((seen.depths[seen.counts == 1] - 2.0).abs().max() < 0.05)

    def test_an_sdf_grid_places_samples_without_the_network(self) -> None:
        field = self.field().float()
        wrapped, (base, residual) = counted(field)
        origins, directions = rays(100)
        grid = ValueGrid(48)
        grid.refresh(field)
        options = {"inv_std": 150.0, "alpha_threshold": 1e-4, "sdf_grid": grid}
        by_grid = render_volume(wrapped, position_color, origins, directions, **options)
        assert base.values == residual.values == 0
        assert base.jets == int((by_grid.counts > 0).sum())
        full = render_volume(field, position_color, origins, directions, inv_std=150.0)
        # Both place samples of their own around the same surface: 1/s is what they may differ by in depth.
        assert float((by_grid.color - full.color).abs().max()) < 1 / 150
