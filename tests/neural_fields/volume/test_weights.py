"""Volume rendering against written-out loops, closed forms and exact surfaces."""

import math

import pytest
import torch
from mplicits.neural_fields import Sphere
from mplicits.neural_fields.volume import weights as volume

F64 = torch.float64


def along_plane(offset: float, angle: float, samples: int, span: float = 2.0) -> tuple[torch.Tensor, ...]:
    """Values, slopes and lengths of the intervals of a ray that meets a plane at depth ``offset`` under an angle."""
    cosine = -math.cos(angle)
    edges = torch.linspace(0, span, samples + 1, dtype=F64)[None]
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    return cosine * (middle - offset), torch.full_like(middle, cosine), edges.diff(dim=1)


class TestOpticalDepth:
    def test_alpha_is_the_ratio_of_sigmoids(self) -> None:
        value, slope = torch.randn(50, dtype=F64) * 0.1, -torch.rand(50, dtype=F64)
        interval, s = torch.rand(50, dtype=F64) * 0.1, 30.0
        entering = torch.sigmoid(s * (value - slope * interval / 2))
        leaving = torch.sigmoid(s * (value + slope * interval / 2))
        torch.testing.assert_close(volume.neus_alpha(value, slope, interval, s), 1 - leaving / entering)
        assert not volume.neus_alpha(value, -slope, interval, s).any()  # where the field rises

    def test_annealing_goes_from_the_half_open_slope_to_the_true_one(self) -> None:
        value, interval = torch.zeros(4, dtype=F64), torch.full((4,), 0.1, dtype=F64)
        slope = torch.tensor([-1.0, -0.2, 0.3, 1.0], dtype=F64)
        start = volume.neus_alpha(value, slope, interval, 10.0, cos_anneal=0.0)
        torch.testing.assert_close(start, volume.neus_alpha(value, 0.5 * slope - 0.5, interval, 10.0))
        end = volume.neus_alpha(value, slope, interval, 10.0, cos_anneal=1.0)
        torch.testing.assert_close(end, volume.neus_alpha(value, slope, interval, 10.0))
        half = volume.neus_optical_depth(value, slope, interval, 10.0, cos_anneal=0.5)
        mixed = -0.5 * torch.relu(-slope) - 0.5 * torch.relu(0.5 - 0.5 * slope)
        torch.testing.assert_close(half, volume.neus_optical_depth(value, mixed, interval, 10.0))

    def test_far_inside_and_outside_nothing_is_infinite(self) -> None:
        value = torch.tensor([-50.0, 50.0], requires_grad=True)
        alpha = volume.neus_alpha(value, torch.tensor(-1.0), torch.tensor(0.5), 1000.0)
        alpha.sum().backward()
        assert alpha.tolist() == [1, 0]
        assert bool(value.grad.isfinite().all())


class TestWeights:
    def test_agree_with_a_loop(self) -> None:
        depth = torch.rand(3, 7, dtype=F64) * 2
        weights, remaining = volume.transmittance_weights(depth)
        for ray in range(3):
            light = 1.0
            for index in range(7):
                alpha = 1 - math.exp(-float(depth[ray, index]))
                assert float(weights[ray, index]) == pytest.approx(light * alpha, abs=1e-14)
                light *= 1 - alpha
            assert float(remaining[ray]) == pytest.approx(light, abs=1e-14)
        assert volume.transmittance_weights(depth[:, :0])[1].tolist() == [1, 1, 1]

    @pytest.mark.parametrize("angle", [0.0, 0.6, 1.2])
    def test_of_a_plane_are_the_logistic_density(self, angle: float) -> None:
        # Telescoping: the light behind depth t is Φ(f(t)) / Φ(f(0)), exactly, on any intervals.
        value, slope, interval = along_plane(0.8, angle, 37)
        s = 40.0
        weights, remaining = volume.transmittance_weights(volume.neus_optical_depth(value, slope, interval, s))
        ends = value + slope * interval / 2
        start = torch.sigmoid(s * (value - slope * interval / 2)[:, :1])
        torch.testing.assert_close(1 - weights.cumsum(dim=1), torch.sigmoid(s * ends) / start)
        torch.testing.assert_close(remaining, (torch.sigmoid(s * ends) / start)[:, -1])


class TestDepths:
    def test_sphere_span_is_exact(self) -> None:
        origins = torch.tensor([[0.0, 0, 3], [0.6, 0, 3], [2.0, 0, 3], [0, 0, 0], [0, 0, -3]], dtype=F64)
        ahead = torch.tensor([0.0, 0, -1], dtype=F64).expand(5, 3)
        near, far = volume.sphere_span(origins, ahead)
        torch.testing.assert_close(near[:2], torch.tensor([2.0, 2.2], dtype=F64))
        torch.testing.assert_close(far[:2], torch.tensor([4.0, 3.8], dtype=F64))
        assert near[2] == far[2]  # misses
        assert (near[3:].tolist(), far[3:].tolist()) == ([0, 0], [1, 0])  # starts inside, looks away
        # From a thousand radii away, in float32.
        near, far = volume.sphere_span(torch.tensor([[0.8, 0.0, 1000.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
        assert float(far - near) == pytest.approx(1.2, abs=2e-4)

    def test_strata_hold_one_depth_each(self) -> None:
        near, far = torch.tensor([0.0, 1.0]), torch.tensor([1.0, 3.0])
        assert volume.stratified_depths(near, far, 2).tolist() == [[0.25, 0.75], [1.5, 2.5]]
        drawn = volume.stratified_depths(near, far, 8, generator=torch.Generator().manual_seed(1))
        strata = ((drawn - near[:, None]) / (far - near)[:, None] * 8).floor()
        assert strata.tolist() == [list(range(8))] * 2

    def test_importance_depths_surround_the_first_surface(self) -> None:
        sphere = Sphere(radius=0.5)
        origins, directions = torch.tensor([[0.0, 0, 2], [0.3, 0, 2]]), torch.tensor([[0.0, 0, -1]]).expand(2, 3)
        near, far = volume.sphere_span(origins, directions)
        depths = volume.stratified_depths(near, far, 16)
        values = sphere.value(volume.ray_points(origins, directions, depths))
        found = volume.importance_depths(depths, values, 32, 128.0)
        exact = torch.tensor([1.5, 2 - 0.4])
        assert float((found - exact[:, None]).abs().median(dim=1).values.max()) < 0.05
        assert bool((found.diff(dim=1) >= 0).all())

    def test_importance_depths_of_an_empty_ray_are_even(self) -> None:
        depths = torch.linspace(0, 1, 11)[None]
        found = volume.importance_depths(depths, torch.ones(1, 11), 5, 64.0)
        torch.testing.assert_close(found, torch.tensor([[0.1, 0.3, 0.5, 0.7, 0.9]]), atol=1e-4, rtol=0)

    def test_outside_depths_are_even_in_inverse_distance(self) -> None:
        depths = volume.outside_depths(torch.tensor([2.0]), 4)
        torch.testing.assert_close(1 / depths, torch.tensor([[7 / 16, 5 / 16, 3 / 16, 1 / 16]]))
        inverted = volume.invert_outside(torch.tensor([[0.0, 0.0, 4.0], [3.0, 0.0, 4.0]]))
        torch.testing.assert_close(inverted, torch.tensor([[0, 0, 1, 0.25], [0.6, 0, 0.8, 0.2]]))

    def test_no_outside_depth_is_infinite(self, monkeypatch: pytest.MonkeyPatch) -> None:
        # (31 + u) / 32 rounds to 1 where the random u is within a millionth of 1.
        monkeypatch.setattr(torch, "rand", lambda *size, **_: torch.full(size, 1 - 2.0**-24))
        far = torch.tensor([1.0, 2.0])
        depths = volume.outside_depths(far, 32, generator=torch.Generator())
        assert bool((depths.diff(dim=1) > 0).all())
        assert bool((depths[:, -1] <= far * 2**20).all())
        points = volume.ray_points(torch.zeros(2, 3), torch.nn.functional.normalize(torch.ones(2, 3), dim=1), depths)
        assert bool(torch.isfinite(volume.invert_outside(points)).all())
