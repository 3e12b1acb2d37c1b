"""Gating: where residuals act, what they cost, and the taper's continuity."""

import pytest
import torch
from fields import small_multiscale
from mplicits.neural_fields import Field, Jet, MultiscaleSDF, Siren, Sphere
from torch import Tensor


class Counting(Field):
    """A constant residual that remembers how many rows it was asked for."""

    def __init__(self, constant: float) -> None:
        super().__init__()
        self.in_dim, self.num_levels, self.constant, self.rows = 3, 1, constant, 0
        self.register_buffer("deltas", torch.empty(0))

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        self.rows += len(x)
        return x.new_full(x.shape[:-1], self.constant)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        return Jet(self.value(x), torch.zeros_like(x), x.new_empty((*x.shape[:-1], 0)))


def test_sum_of_the_paper_is_the_field() -> None:
    sdf = small_multiscale().double()
    x = 2 * torch.rand(500, 3, dtype=torch.float64) - 1
    f = sdf.base.value(x)
    inside = torch.ones(len(x), dtype=torch.bool)
    for residual, delta in zip(sdf.residuals, sdf.deltas, strict=True):
        inside = inside & (f.abs() < delta)
        f = torch.where(inside, f + residual.value(x), f)
    torch.testing.assert_close(sdf.value(x), f)


@pytest.mark.parametrize("method", ["value", "jet"])
def test_rows_outside_the_band_are_never_evaluated(method: str) -> None:
    first, second = Counting(0.01), Counting(0.02)
    sdf = MultiscaleSDF(Sphere(radius=0.5), [first, second], [0.1, 0.05])
    x = 2 * torch.rand(10_000, 3) - 1
    distance = x.norm(dim=-1) - 0.5
    getattr(sdf, method)(x)
    assert first.rows == int((distance.abs() < 0.1).sum())
    assert second.rows == int(((distance.abs() < 0.1) & ((distance + 0.01).abs() < 0.05)).sum())
    assert 0 < second.rows < first.rows < 1000
    getattr(sdf, method)(x, level=0)
    assert first.rows == int((distance.abs() < 0.1).sum())


def test_in_band_evaluates_no_finer_level() -> None:
    first, second = Counting(0.01), Counting(0.02)
    sdf = MultiscaleSDF(Sphere(radius=0.5), [first, second], [0.1, 0.05])
    x = 2 * torch.rand(1000, 3) - 1
    assert torch.equal(sdf.in_band(x, level=2), Field.in_band(sdf, x, level=2))
    first.rows = second.rows = 0
    sdf.in_band(x, level=1)
    assert first.rows == second.rows == 0


def test_no_row_in_the_band() -> None:
    sdf = small_multiscale()
    far = MultiscaleSDF(Sphere(radius=0.5), list(sdf.residuals), [1e-6, 1e-6])
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
        assert (value_jump < 1e-6) == continuous
        assert (gradient_jump < 1e-5) == continuous


def test_with_level_shares_the_levels() -> None:
    base, residual = Siren(8, 1), Siren(8, 2)
    one = MultiscaleSDF(base, [], [])
    two = one.with_level(residual, delta=0.2)
    assert two.base is base
    assert two.num_levels == 2
    assert two.deltas.tolist() == pytest.approx([0.2])
    x = torch.rand(20, 3)
    assert torch.equal(two.value(x, level=0), one.value(x))


def test_training_reaches_every_level() -> None:
    sdf = small_multiscale(0.3)
    sdf.jet(2 * torch.rand(500, 3) - 1).gradient.square().sum().backward()
    assert all(p.grad is not None and bool((p.grad != 0).any()) for n, p in sdf.named_parameters() if "weight" in n)


@pytest.mark.parametrize(
    ("residuals", "deltas", "options", "message"),
    [
        ([], [0.1], {}, "deltas has 1 entries for 0 residuals"),
        ([Siren(4, 1)], [0.0], {}, "expected numbers > 0"),
        ([Siren(4, 1)], [0.1], {"taper": 1.5}, "taper=1.5"),
        ([Siren(4, 1, in_dim=4)], [0.1], {}, r"residuals\[0\].in_dim=4"),
    ],
)
def test_bad_arguments(residuals: list[Field], deltas: list[float], options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MultiscaleSDF(Sphere(), residuals, deltas, **options)


def test_from_widths_needs_one_omega_per_level() -> None:
    with pytest.raises(ValueError, match="omegas has 1 entries for 2 sizes"):
        MultiscaleSDF.from_widths([(8, 1), (8, 1)], omegas=[30])
