"""When the second call of a pair is served from the first, and when it must not be."""

import copy
import gc
import io
import weakref
from collections.abc import Callable

import pytest
import torch
from fields import small_multiscale
from hosts import points
from mplicits.neural_fields import Field, Jet, NeuSGeometry, Siren
from torch import Tensor

from benchmarks.costs.speed import Counted


def counting() -> tuple[NeuSGeometry, Counted]:
    field = Counted(small_multiscale(0.5))
    return NeuSGeometry(field), field


def test_either_order_is_one_jet_and_each_half_is_served_once() -> None:
    shell, field = counting()
    x = points()
    gradient = shell.gradient(x)
    output = shell(x)
    assert field.jets == 50
    again = shell(x)
    assert field.jets == 100
    assert torch.equal(output, again)
    assert torch.equal(gradient, shell.gradient(x))
    assert field.jets == 100
    assert len(shell(x)) == len(shell.gradient(x.clone()))  # other points of the same values
    assert field.jets == 200


def halved(parameter: Tensor) -> None:
    with torch.no_grad():
        parameter.mul_(0.5)


def stepped(shell: NeuSGeometry) -> None:
    for parameter in shell.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.SGD(shell.parameters(), lr=0.1).step()


CHANGES: dict[str, Callable[[NeuSGeometry, Tensor], object]] = {
    "points in place": lambda shell, x: x.mul_(0.5),
    "a view of the points": lambda shell, x: x[:25].zero_(),
    "optimizer step": lambda shell, x: stepped(shell),
    "one parameter": lambda shell, x: halved(next(shell.parameters())),
    "memory of a parameter": lambda shell, x: setattr(next(shell.parameters()), "data", torch.zeros(16, 3)),
    "checkpoint": lambda shell, x: shell.load_state_dict({k: 0.5 * v for k, v in shell.state_dict().items()}),
    "band": lambda shell, x: halved(shell.get_buffer("field.inner.deltas")),
    "another field": lambda shell, x: setattr(shell, "field", small_multiscale(0.5)),
    "double precision": lambda shell, x: (shell.double(), setattr(x, "data", x.data.double())),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_between_the_calls_is_seen(change: str) -> None:
    shell, _ = counting()
    x = points()
    output = shell(x)
    before = shell.field.jet(x).gradient.detach()
    CHANGES[change](shell, x)
    gradient = shell.gradient(x)[:, 0]
    assert torch.equal(gradient, shell.field.jet(x).gradient)
    assert not torch.equal(gradient.to(before), before)
    assert len(output) == 50


# What happens to an output before the call of the gradient, and the number of jets in all.
BETWEEN: dict[str, tuple[Callable[[Tensor, Tensor], object], int]] = {
    "nothing": (lambda output, x: None, 50),
    "the points are marked": (lambda output, x: x.requires_grad_(), 50),
    "a backward pass, which frees the graph of both": (lambda output, x: output.square().sum().backward(), 100),
}


@pytest.mark.parametrize("between", BETWEEN)
def test_the_second_half_has_a_whole_graph(between: str) -> None:
    (shell, field), x, (act, jets) = counting(), points(), BETWEEN[between]
    output = shell(x)
    act(output, x)
    shell.gradient(x).square().sum().backward()
    assert field.jets == jets
    assert all(parameter.grad is not None for parameter in shell.parameters())
    part = shell(x)[:, :1]  # a slice keeps the whole output alive
    shell.gradient(x)
    assert field.jets == jets + 50
    assert part.requires_grad


def test_an_evaluation_without_graph_does_not_serve_a_training_step() -> None:
    shell, field = counting()
    x = points()
    with torch.no_grad():
        output = shell(x)
    assert field.jets == 0  # a value was enough
    assert shell.gradient(x).requires_grad
    graph = shell(x)
    with torch.no_grad():
        assert not shell.gradient(x).requires_grad
    with torch.inference_mode():
        output = shell(x)
    with torch.no_grad():
        assert not shell.gradient(x).is_inference()
    assert (output.is_inference(), graph.requires_grad) == (True, True)


def test_inference_tensors_have_no_version_and_are_evaluated_each_time() -> None:
    shell, field = counting()
    with torch.inference_mode():
        x = points()
        shell.gradient(x)
        shell.gradient(x)
    assert field.jets == 100
    shell(x).sum().backward()
    assert not x.requires_grad
    shell.gradient(x).sum().backward()


def test_parameters_thawed_in_between_are_trained() -> None:
    shell, _ = counting()
    x = points()
    shell.requires_grad_(False)
    output = shell(x)
    shell.requires_grad_(True)
    shell.gradient(x).square().sum().backward()
    assert all(parameter.grad is not None for parameter in shell.parameters())
    assert len(output) == 50


class Watched(Field):
    """Keeps weak references to what its jets return."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = Siren(16, 2, num_features=2)
        self.seen: list[weakref.ref[Tensor]] = []

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        return self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        value, gradient, features = self.inner.jet(x, level=level)
        gradient = gradient.clone()  # a tensor of its own, which lives as long as any view of it
        self.seen.append(weakref.ref(gradient))
        return Jet(value, gradient, features)

    def alive(self) -> int:
        return sum(reference() is not None for reference in self.seen)


@pytest.mark.parametrize("marked", [False, True])
@pytest.mark.parametrize("dead", ["output", "both"])
def test_nothing_outlives_what_the_caller_has(marked: bool, dead: str) -> None:
    field = Watched()
    shell = NeuSGeometry(field)
    gc.disable()  # what dies here must die by itself, not be found later as a cycle
    try:
        x = points().requires_grad_(marked)
        output = shell(x)
        assert field.alive() == 1
        del output
        if dead == "both":
            del x
        assert field.alive() == 0
        x = points().requires_grad_(marked)
        output, gradient = shell(x), shell.gradient(x)
        assert field.alive() == 1
        del gradient
        assert field.alive() == 0
        assert len(output) == 50
    finally:
        gc.enable()


def test_a_shell_with_something_waiting_can_be_copied_and_saved() -> None:
    shell, _ = counting()
    x = points()
    output, file = shell(x), io.BytesIO()
    torch.save(shell, file)
    file.seek(0)
    for other in (copy.deepcopy(shell), torch.load(file, weights_only=False)):
        assert set(shell.state_dict()) == set(other.state_dict())
        halved(next(other.parameters()))
        assert not torch.equal(other.gradient(x), shell.field.jet(x).gradient[:, None])
    assert len(output) == 50
