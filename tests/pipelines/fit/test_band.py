"""Bands: Eq. 5, strays, and places on the wrong side."""

import pytest
import torch
from mplicits.datasets import sample_sphere
from mplicits.neural_fields import Field, Sphere, Union
from mplicits.neural_fields.fields.primitives import Evaluated
from mplicits.pipelines.fit.cloud import CloudDistance
from mplicits.pipelines.fit.samples import BAND, Band, band_of, delta_of, with_wrong_sides


def test_delta_is_equation_5() -> None:
    errors = torch.tensor([0.01, -0.02, 0.005, 0.0])
    assert delta_of(errors, epsilon=0.3, quantile=1.0) == pytest.approx(1.3 * 0.02)
    assert delta_of(errors, epsilon=0.3, quantile=0.75) == pytest.approx(1.3 * 0.01)
    stray = torch.cat((torch.full((9999,), 0.01), torch.tensor([1.0])))
    assert delta_of(stray, epsilon=0.3, quantile=1.0) == pytest.approx(1.3)
    for quantile in (0.999, None):
        assert delta_of(stray, epsilon=0.3, quantile=quantile) == pytest.approx(1.3 * 0.01)
    normal = torch.randn(50_000, generator=torch.Generator().manual_seed(0))
    assert delta_of(normal, epsilon=0.3, quantile=None) == pytest.approx(1.3 * float(normal.abs().max()))


def test_many_strays_do_not_widen_a_band() -> None:
    """More than one in a hundred: the 99th percentile is itself a stray's."""
    strays = torch.cat((torch.linspace(0, 0.01, 9500), torch.linspace(0.4, 1, 500)))
    band = band_of(strays, epsilon=0.3, quantile=None)
    assert band.delta == pytest.approx(1.3 * 0.01)
    assert (band.rule, band.outside) == ("maximum but for strays", 500)


def test_bands_say_what_chose_them() -> None:
    errors = torch.tensor([0.01, -0.02, 0.005, 0.0])
    assert band_of(errors, epsilon=0.3, quantile=None).rule == "maximum"
    by_quantile = band_of(errors, epsilon=0.3, quantile=0.75)
    assert (by_quantile.rule, by_quantile.outside) == ("quantile", 1)
    assert band_of(torch.zeros(5), epsilon=0.3, quantile=None).delta == 1e-6


def widened(field: Field, delta: float) -> Band:
    """The band of a field that was fitted to a sphere of radius 0.5."""
    sphere = sample_sphere(10_000)
    assert sphere.normals is not None
    cloud = CloudDistance(torch.from_numpy(sphere.points).float(), torch.from_numpy(sphere.normals).float())
    where = {"count": 400_000, "seed": 0, "device": torch.device("cpu")}
    return with_wrong_sides(Band(delta, "maximum", 1), torch.tensor([delta]), cloud, field, epsilon=0.05, **where)


def test_a_level_that_is_right_keeps_the_band_of_its_points() -> None:
    for field in (Sphere(radius=0.5), Sphere(radius=0.52), Sphere(radius=0.48)):
        assert widened(field, 0.03).delta == 0.03


@pytest.mark.parametrize(
    ("delta", "expected"),
    [(0.12, 1.05 * 0.2), (0.06, BAND.widest * 0.06), pytest.param(0.21, 0.21, marks=pytest.mark.slow)],
)
def test_a_band_holds_what_a_level_puts_on_the_wrong_side(delta: float, expected: float) -> None:
    """A ball of radius 0.2 hangs beside the sphere: 0.2 deep. Of the places in it the deepest is asked, nearly."""
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
