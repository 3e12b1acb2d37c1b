"""`torch.compile` around fields and host shells: the same numbers, and gradients, as without it."""

from collections.abc import Callable, Iterator

import pytest
import torch
from fields import FIELDS, small_multiscale
from hosts import NeuSHost, rays
from mplicits.neural_fields import Field, NeuSGeometry
from torch import Tensor

BACKENDS = ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)]
QUICK = ("multiscale-tapered", "encoded")  # compiling takes seconds
NAMES = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in FIELDS]
# The compiler warns of what it does itself.
pytestmark = [pytest.mark.filterwarnings(f"ignore::{kind}") for kind in ("UserWarning", "DeprecationWarning")]


@pytest.fixture(autouse=True)
def compiles_anew() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def numbers(field: Field, x: Tensor) -> list[Tensor]:
    """All that a field says of points, as one function for the compiler."""
    value, features = field.value_features(x)
    jet, second = field.jet(x), field.second_jet(x)
    return [field.value(x), value, features, *jet, *second]


def weighed(tensors: list[Tensor]) -> Tensor:
    """A loss in which every number counts, each one otherwise."""
    torch.manual_seed(2)
    return torch.stack([(tensor * torch.randn_like(tensor)).sum() for tensor in tensors]).sum()


def assert_agree(run: Callable[[], Tensor | list[Tensor]], parameters: list[Tensor], backend: str) -> None:
    """The outputs, and the gradients of a loss."""
    found = []
    for each in (run, torch.compile(run, backend=backend)):
        outputs = each()
        outputs = outputs if isinstance(outputs, list) else [outputs]
        loss = weighed(outputs)
        found.append((outputs, torch.autograd.grad(loss, parameters, allow_unused=True)))
    torch.testing.assert_close(found[1], found[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", NAMES)
def test_compiled_fields_say_what_they_say(name: str, backend: str) -> None:
    torch.manual_seed(1)
    field = FIELDS[name]()
    x = (2 * torch.rand(40, field.in_dim) - 1).requires_grad_()
    learnt = [parameter for parameter in field.parameters() if parameter.requires_grad]
    assert_agree(lambda: numbers(field, x), [x, *learnt], backend)


@pytest.mark.parametrize("backend", BACKENDS)
def test_compiled_host_learns_the_same(backend: str) -> None:
    host = NeuSHost(NeuSGeometry(small_multiscale(0.5)), 2)
    origins, directions, depths, wanted = rays()
    finer = host.finer_depths(origins, directions, depths)
    assert_agree(lambda: host.loss(origins, directions, finer, wanted), host.parameters(), backend)
