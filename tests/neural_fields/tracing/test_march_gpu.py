"""The march that runs ahead of the host, on the CPU, against the one that reads after every pass."""

from unittest import mock

import pytest
import torch
from fields import FIELDS, Watched, assert_depths, small_multiscale
from mplicits.neural_fields import Field, Sphere, Torus, sphere_trace
from mplicits.neural_fields.backend.fixed_shapes import current_shapes
from mplicits.neural_fields.tracing import _march_gpu as _ahead
from mplicits.neural_fields.tracing import sphere as tracing
from mplicits.neural_fields.tracing.sphere import Expected, trace_expected
from torch import Tensor
from waits import some_rays, three_levels

CLOSED = {"sphere": Sphere(radius=0.5), "torus": Torus(major=0.5, minor=0.2)}


def both(work, *arguments, **options):
    """Call a function with the one march and with the other."""
    found = []
    for ahead in (False, True):
        with mock.patch.object(tracing, "makes_wait", return_value=ahead):
            found.append(work(*arguments, **options))
    return found


def rays(dtype: torch.dtype, count: int = 200) -> tuple[Tensor, Tensor]:
    origins, directions = some_rays(count)
    return origins.to(dtype), directions.to(dtype)


def assert_same_bits(first, second) -> None:
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"near": 1.0, "far": 2.2},
        {"near": 2.0},  # behind the surface, for many
        {"max_steps": 3},
        {"max_steps": 1},
        {"max_steps": 0},
        {"resolution": 0.3, "lipschitz": 1.3},
        {"radius": None, "far": 5.0},
        {"tolerance": 1e-3},
    ],
)
def test_closed_forms_agree_to_the_last_bit(name: str, options: dict, dtype: torch.dtype) -> None:
    field, (origins, directions) = CLOSED[name].to(dtype), rays(dtype)
    assert_same_bits(*both(sphere_trace, field, origins, directions, **options))
    assert_same_bits(*both(sphere_trace, field, origins * 0.1, directions, **options))


@pytest.mark.parametrize("off", [0.0, 0.02, -0.02, 0.4])
def test_expectations_right_and_wrong(off: float) -> None:
    field, (origins, directions) = CLOSED["torus"].double(), rays(torch.float64)
    hits, slope, _ = trace_expected(field, origins, directions, None)
    unknown = torch.full_like(hits.depth, torch.inf)
    for value in (unknown, field.value(origins)):
        expected = Expected(torch.where(hits.mask, hits.depth + off, torch.inf), slope, value)
        (first, *columns), (second, *others) = both(trace_expected, field, origins, directions, expected, reach=0.1)
        assert_same_bits((*first, columns[0], *columns[1]), (*second, others[0], *others[1]))


@pytest.mark.parametrize("few", [_ahead.FEW, 20], ids=["enough", "overflow"])
def test_levels_agree_within_the_tolerance(few: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Matrix products with other rows beside them round differently; each depth is exact to the tolerance."""
    for name, number in {"FEW": few, "SHARE": 0.01, "LEAST_CAPACITY": 5, "SPARE": 0.6}.items():
        monkeypatch.setattr(_ahead, name, number)
    origins, directions = rays(torch.float64)
    for field in (three_levels().double(), small_multiscale(0.3).double()):
        first, second = both(sphere_trace, field, origins, directions, tolerance=1e-7)
        assert int(first.mask.sum()) > 20
        assert_depths(first, second, 2e-7)
        assert torch.equal(first.level[first.mask], second.level[second.mask])


@pytest.mark.parametrize("few", [_ahead.FEW, 5], ids=["enough", "overflow"])
@pytest.mark.parametrize("name", ["union", "placed", "difference-of-multiscale", "slice"])
def test_fields_of_fields(name: str, few: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_ahead, "FEW", few)
    monkeypatch.setattr(_ahead, "LEAST_CAPACITY", few)
    field: Field = FIELDS[name]().double()
    origins, directions = rays(torch.float64, 60)
    assert_depths(*both(sphere_trace, field, origins, directions, max_steps=64), 2e-5)


class Own(Watched):
    """A user's field around another, which records whether shapes are fixed."""

    same_rows = None

    def __init__(self, inner: Field, *, same_rows: bool) -> None:
        super().__init__(inner)
        self.fixed: list[bool] = []
        self.same_rows = same_rows

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        self.fixed.append(current_shapes() is not None)
        return super().value(x, level=level)


def test_a_users_field_chooses_its_path() -> None:
    origins, directions = rays(torch.float64)
    for same in (True, False):
        field = Own(three_levels().double(), same_rows=same)
        assert_depths(*both(sphere_trace, field, origins, directions, tolerance=1e-7), 2e-7)
        assert any(field.fixed) == same
    assert Sphere().same_rows
    assert not Watched(Sphere()).same_rows
    for name, same in (("difference-of-multiscale", True), ("slice", True), ("function", False)):
        assert FIELDS[name]().same_rows == same


def test_no_rays() -> None:
    nothing = torch.zeros(0, 3)
    assert_same_bits(*both(sphere_trace, CLOSED["sphere"].float(), nothing, nothing))
    away = torch.tensor([[0.0, 0.0, 3.0]])
    assert_same_bits(*both(sphere_trace, CLOSED["sphere"].float(), away, away))
