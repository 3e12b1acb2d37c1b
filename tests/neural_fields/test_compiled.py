"""`torch.compile` around fields and host shells: the same numbers, and gradients, as without it."""

from collections.abc import Callable, Iterator

import pytest
import torch
from fields import FIELDS, small_multiscale
from hosts import Frustums, Heads, NeuSHost, RaySamples, rays
from mplicits.neural_fields import ColorNetwork, Field, InstantNSRGeometry, NerfstudioField, NeuSGeometry
from torch import Tensor
from torch.nn.functional import normalize

BACKENDS = ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)]
QUICK = ("multiscale-tapered", "encoded")  # compiling takes seconds
NAMES = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in FIELDS]
WARNINGS = ("UserWarning", "DeprecationWarning", "FutureWarning")
# The compiler warns of what it does itself.
pytestmark = [pytest.mark.filterwarnings(f"ignore::{kind}") for kind in WARNINGS]


@pytest.fixture(autouse=True)
def compiles_anew() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


Tensors = Callable[[], list[Tensor]]


def numbers(field: Field, x: Tensor) -> list[Tensor]:
    """All that a field says of points, as one function for the compiler."""
    value, features = field.value_features(x)
    jet, second = field.jet(x), field.second_jet(x)
    return [field.value(x), value, features, *jet, *second]


def weighed(tensors: list[Tensor]) -> Tensor:
    """A loss in which every number counts, each one otherwise."""
    torch.manual_seed(2)
    return torch.stack([(tensor * torch.randn_like(tensor)).sum() for tensor in tensors]).sum()


def neus(x: Tensor, field: Field) -> tuple[NeuSGeometry, Tensors]:
    """NeuS's calls in its order: values of a tensor, and then the gradient at it."""
    shell = NeuSGeometry(field, scale=0.7, learning_rate=5e-4)
    return shell, lambda: [shell(x), shell.gradient(x), shell.sdf(x)]


def instant_nsr(x: Tensor, field: Field) -> tuple[InstantNSRGeometry, Tensors]:
    """Every combination of outputs that instant-nsr-pl wants."""
    shell = InstantNSRGeometry(field, radius=1.5, learning_rate=5e-4)
    return shell, lambda: [*shell(x), *shell(x, with_laplace=True), *shell(x, with_grad=False), shell.forward_level(x)]


def nerfstudio(x: Tensor, field: Field) -> tuple[NerfstudioField, Tensors]:
    """What nerfstudio's models and exporters call."""
    shell = NerfstudioField(field, ColorNetwork(2, width=16, depth=1), heads=Heads, learning_rate=5e-4)
    shell.set_cos_anneal_ratio(0.5)
    lengths = torch.full((*x.shape[:-1], 1), 0.2)
    samples = RaySamples(Frustums(x, normalize(torch.ones_like(x), dim=-1), 0 * lengths), lengths, lengths.long())

    def calls() -> list[Tensor]:
        outputs = shell(samples, return_alphas=True)
        alone = [shell.get_sdf(samples), shell.forward_geonetwork(x), shell.gradient(x), shell.frontal_colors(x)]
        return [*outputs.values(), *alone]

    return shell, calls


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


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("taper", [0.5, pytest.param(0.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("build", [neus, instant_nsr, nerfstudio])
def test_compiled_shells_say_what_they_say(build: Callable, taper: float, backend: str) -> None:
    """Points inside and outside the bands; hosts mark the points late, or have them marked before."""
    torch.manual_seed(1)
    x = 2 * torch.rand(40, 3) - 1
    shell, calls = build(x, small_multiscale(taper))
    for values, delta in zip(shell.field.level_values(x * shell.scale), shell.field.deltas, strict=False):
        assert 0 < int((values.abs() < delta).sum()) < len(x)
    assert_agree(calls, list(shell.parameters()), backend)
    x.requires_grad_()
    assert_agree(calls, [x, *shell.parameters()], backend)
    torch.testing.assert_close(*(torch.no_grad()(run)() for run in (calls, torch.compile(calls, backend=backend))))
