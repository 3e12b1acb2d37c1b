"""Evaluations of fixed shape: the usual results, no waits, and the overflow."""

import copy

import fake_accelerator
import pytest
import torch
from bounds import assert_within, rounding
from fields import cube, small_multiscale, small_spacetime
from mplicits.neural_fields import Field, MultiscaleSDF, Similarity, Sphere, TimeSlice, Union
from mplicits.neural_fields.backend.fixed_shapes import fixed_shapes
from mplicits.neural_fields.fields.csg import Placed
from torch import Tensor


def sdf(taper: float = 0.3) -> MultiscaleSDF:
    return small_multiscale(taper).double()


@pytest.mark.parametrize("taper", [0.0, 0.3])
@pytest.mark.parametrize("capacity", [None, [400, 400], [300]])
def test_results_are_the_usual_ones(taper: float, capacity: list[int] | None) -> None:
    field, x = sdf(taper), cube(400)
    usual = field.second_jet(x)
    with fixed_shapes(capacity) as shapes:
        fixed = field.second_jet(x)
        values, value = field.level_values(x), field.value(x.reshape(4, 100, 3))
    assert shapes.overflow is None or not bool(shapes.overflow.any())
    bounds = rounding(field, x, lambda field, x: field.second_jet(x))
    assert_within(fixed, usual, bounds, times=2)
    assert_within(value.flatten(), usual.value, 2 * bounds[0])
    assert_within(values[-1], usual.value, 2 * bounds[0])
    inside = field.level_values(x)[0].abs() < field.deltas[0]
    assert 0 < int(shapes.requested[0]) == int(inside.sum()) < len(x)


def test_gradients_are_the_usual_ones() -> None:
    x, grown = cube(400), []
    for shaped in (False, True):
        torch.manual_seed(0)
        field, y = sdf(), x.clone().requires_grad_()
        with fixed_shapes([350, 400]) if shaped else torch.enable_grad():
            jet = field.jet(y)
        (jet.value.square().sum() + jet.gradient.square().sum() + jet.features.sum()).backward()
        grown.append([y.grad, *(parameter.grad for parameter in field.parameters())])
    torch.testing.assert_close(*grown, rtol=1e-10, atol=1e-10)  # float64 sums of a few hundred numbers


@pytest.mark.parametrize("capacity", [0, 1, 17])
def test_overflow_has_the_value_of_the_level_before(capacity: int) -> None:
    field, x = sdf(), cube(400)
    values = field.level_values(x)
    inside = values[0].abs() < field.deltas[0]
    with fixed_shapes([capacity]) as shapes:
        found = field.value(x, level=1)
    admitted = inside & (inside.cumsum(0) <= capacity)
    assert int(admitted.sum()) == capacity
    assert torch.equal(shapes.overflow, inside & ~admitted)
    bound = rounding(field, x, lambda field, x: field.jet(x, level=1))[0]
    assert_within(found, torch.where(admitted, values[1], values[0]), 2 * bound)


def test_points_that_are_masked_out_stay_coarse() -> None:
    field, x = sdf(), cube(400)
    mask = torch.arange(len(x)) % 2 == 0
    with fixed_shapes() as shapes:
        shapes.mask = mask
        found = field.value(x)
    usual = field.level_values(x)
    bound = rounding(field, x, lambda field, x: field.jet(x))[0]
    assert_within(found, torch.where(mask, usual[-1], usual[0]), 2 * bound)


def test_the_outermost_is_not_touched_by_those_inside() -> None:
    field, x = sdf(), cube(400)
    with fixed_shapes() as outer:
        with fixed_shapes() as inner:
            field.value(x)
        assert inner.requested
        assert not outer.requested


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_points(count: int) -> None:
    field, x = sdf(), cube(count)
    with fixed_shapes([3, 3]):
        jet = field.jet(x)
    assert jet.gradient.shape == (count, 3)


def assert_no_wait(field: Field, x: Tensor, capacity: list[int] | None) -> dict[str, int]:
    """Launches on the fake accelerator."""
    field, x = copy.deepcopy(field).to(fake_accelerator.NAME), x.to(fake_accelerator.NAME)
    with fake_accelerator.counted() as book, fixed_shapes(capacity):
        field.value(x)
        field.jet(x)
    assert book.synchronisations == 0, book.report()
    return book.launches


@fake_accelerator.needed
@pytest.mark.parametrize("capacity", [None, [50, 20]])
def test_no_wait_and_the_same_kernels_for_any_points(capacity: list[int] | None) -> None:
    near, far = (assert_no_wait(sdf(), reach * cube(400), capacity) for reach in (1, 3))
    assert near == far


def composed(name: str) -> Field:
    """Fields of fields of levels, whose bands are those of their parts."""
    if name == "slice":
        return TimeSlice(small_spacetime(0.4), 0.3).double().requires_grad_(False)
    other = Placed(small_multiscale(0.3), Similarity((0.3, 0.0, 0.1), 1.1))
    return Union(sdf(), other, Sphere(radius=0.3)).double().requires_grad_(False)


@pytest.mark.parametrize("capacity", [None, [60, 20]])
@fake_accelerator.needed
@pytest.mark.parametrize("name", ["union", "slice"])
def test_fields_of_fields_need_no_wait_either(name: str, capacity: list[int] | None) -> None:
    field, x = composed(name), cube(400)
    usual = field.jet(x)
    with fixed_shapes(capacity) as shapes:
        found = field.jet(x)
    there = torch.ones(len(x), dtype=torch.bool) if shapes.overflow is None else ~shapes.overflow
    assert (int(there.sum()) < len(x)) == (capacity is not None)
    for a, b in zip(found, usual, strict=True):
        # The same products with other rows beside them, of 16 terms in float64.
        assert_within(a[there], b[there], 1e-11)
    assert_no_wait(field, x, capacity)
