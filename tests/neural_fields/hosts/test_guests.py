"""Fields in the hands of others: wrong arguments, `torch.func`, copies, threads, half precision, NaN."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from mplicits.neural_fields import Field, MultiscaleSDF, Siren, SpaceTimeSDF, Sphere
from torch import Tensor, func

METHODS = ("value", "jet", "second_jet", "value_features", "level_values")
EPS = {torch.float16: 2.0**-11, torch.bfloat16: 2.0**-8}  # half a unit in the last place of 1


def levels() -> MultiscaleSDF:
    torch.manual_seed(0)
    return MultiscaleSDF(Siren(8, 2, omega=5.0), [Siren(8, 1, omega=8.0)], [0.2], taper=0.3).requires_grad_(False)


def fields() -> list[Field]:
    return [levels().levels[0], levels(), MultiscaleSDF(Sphere(radius=0.5), [Siren(8, 1)], [0.1]).requires_grad_(False)]


def points(count: int = 40) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 1.6 - 0.8


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("x", "level", "error", "said"),
    [
        (np.zeros((2, 3)), -1, TypeError, r"^x is a ndarray"),
        ([[0.0, 0.0, 0.0]], -1, TypeError, r"^x is a list"),
        (None, -1, TypeError, r"^x is a NoneType"),
        (torch.zeros(2, 3, dtype=torch.int64), -1, TypeError, r"^x is torch\.int64, the network torch\.float32"),
        (torch.zeros(2, 3, dtype=torch.float64), -1, TypeError, r"^x is torch\.float64, .* x\.to\(field\.like\)$"),
        (torch.zeros(2, 3, dtype=torch.float16), -1, TypeError, r"^x is torch\.float16"),
        (torch.zeros(2, 3, dtype=torch.complex64), -1, TypeError, r"^x is torch\.complex64"),
        (torch.zeros(2, 3, device="meta"), -1, ValueError, r"^x is on meta, the network on cpu"),
        (torch.zeros(2, 4), -1, ValueError, r"^x has shape \(2, 4\); expected \(\.\.\., 3\)"),
        (torch.tensor(1.0), -1, ValueError, r"^x has shape \(\)"),
        (torch.zeros(2, 3), 1.5, TypeError, r"^level=1\.5"),
        (torch.zeros(2, 3), "0", TypeError, r"^level='0'"),
        (torch.zeros(2, 3), None, TypeError, r"^level=None"),
        (torch.zeros(2, 3), 9, ValueError, r"^level=9"),
    ],
)
def test_a_wrong_argument_is_named(method: str, x: Any, level: Any, error: type[Exception], said: str) -> None:
    for field in fields()[:2]:
        with pytest.raises(error, match=said) as raised:
            getattr(field, method)(x, level=level)
        assert "\n" not in str(raised.value)


def test_levels_may_be_whole_numbers_of_other_kinds() -> None:
    field, x = levels(), points()
    for level in (np.int64(0), True, torch.tensor(0)):
        assert torch.equal(field.value(x, level=level), field.value(x, level=int(level)))


# What vmap does to a product of matrices may change the order of its sums: of 8 terms, twice.
VMAP = {"rtol": 1e-4, "atol": 1e-5}


@pytest.mark.parametrize("index", range(3))
def test_fields_can_be_mapped_and_differentiated(index: int) -> None:
    field, x = fields()[index], points()
    value, gradient = field.value(x), field.jet(x).gradient
    torch.testing.assert_close(func.vmap(field.value)(x), value, **VMAP)
    torch.testing.assert_close(func.vmap(lambda p: field.jet(p).gradient)(x), gradient, **VMAP)
    torch.testing.assert_close(func.vmap(func.grad(field.value))(x), gradient, **VMAP)
    torch.testing.assert_close(func.vmap(func.vmap(field.value))(x.reshape(4, 10, 3)), value.reshape(4, 10), **VMAP)
    if index == 2:
        return  # second derivatives of closed forms are autograd's, which torch.func does not let in
    hessian = func.vmap(lambda p: field.second_jet(p).hessian)(x)
    torch.testing.assert_close(hessian, field.second_jet(x).hessian, **VMAP)
    divergence = func.vmap(func.jacrev(lambda p: field.jet(p).gradient))(x)
    torch.testing.assert_close(divergence, hessian, rtol=1e-3, atol=1e-3)


def test_networks_with_other_weights_are_mapped_over_them() -> None:
    members = [Siren(8, 1).requires_grad_(False) for _ in range(3)]
    parameters, buffers = func.stack_module_state(members)
    x = points()

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        return func.functional_call(members[0], (parameters, buffers), (x,))

    found = func.vmap(call)(parameters, buffers)
    torch.testing.assert_close(found, torch.stack([member.value(x) for member in members]), **VMAP)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda field: pickle.loads(pickle.dumps(field))])
def test_copies_are_the_same_to_the_bit_and_their_own(copied: Callable[[Field], Field]) -> None:
    moving = SpaceTimeSDF(MultiscaleSDF(Siren(8, 1, in_dim=4), [Siren(8, 1, in_dim=4)], [0.1]))
    for field in (*fields(), moving):
        x = torch.rand(9, field.in_dim)
        other, before = copied(field), field.value(x).detach()
        assert torch.equal(other.value(x), before)
        with torch.no_grad():
            for parameter in other.parameters():
                parameter.zero_()
        assert torch.equal(field.value(x), before)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_points_that_are_none_stay_in_their_rows(bad: float) -> None:
    for field in fields():
        clean, x = points(), points()
        x[3, 0], x[17] = bad, bad
        rows = torch.ones(len(x), dtype=torch.bool)
        rows[[3, 17]] = False
        jet, wanted = field.jet(x), field.jet(clean)
        assert torch.equal(field.value(x)[rows], field.value(clean)[rows])
        assert torch.equal(jet.gradient[rows], wanted.gradient[rows])
        assert not jet.value[~rows].isfinite().any()


@pytest.mark.parametrize("dtype", list(EPS))
def test_half_precision_errs_no_more_than_its_rounding(dtype: torch.dtype) -> None:
    """Rounding of a layer's folded weights, products and sums, carried on: |W| e + (n + 4) u (|W| (|h| + e) + |b|)."""
    torch.manual_seed(0)
    siren = Siren(16, 2, omega=3.0).requires_grad_(False).to(dtype)
    exact, u = copy.deepcopy(siren).double(), EPS[dtype]
    x = points().to(dtype)
    h, error = x.double(), torch.zeros(len(x), 3, dtype=torch.float64)
    parameters = exact.folded()
    for index in range(0, len(parameters), 2):
        weight, bias = parameters[index].abs(), parameters[index + 1].abs()
        size = h.abs() @ weight.t() + bias
        error = error @ weight.t() + (weight.shape[1] + 4) * u * (size + error @ weight.t())
        h = h @ parameters[index].t() + parameters[index + 1]
        if index < len(parameters) - 2:
            h, error = h.sin(), error + u
    found, wanted = siren.value(x), exact.value(x.double())
    assert found.dtype == dtype
    assert bool(((found.double() - wanted).abs() <= error[:, 0]).all())
    assert siren.jet(x).gradient.dtype == dtype
