"""Blocks on several threads: the same bits as on one, whatever happens in a block, and nothing left behind."""

import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import fake_accelerator
import pytest
import torch
from mplicits.neural_fields import Siren
from mplicits.neural_fields.backend.devices import LEAST_BLOCKS, LEAST_ROWS, one_thread, over_blocks
from torch import Tensor
from torch.overrides import BaseTorchFunctionMode

from benchmarks.costs.speed import operations_split

ROWS = LEAST_BLOCKS * LEAST_ROWS  # the fewest that are shared


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def recorded(rows: int, size: int, like: Tensor) -> tuple[list[slice], set[str]]:
    """The blocks that steps were given, in the order of the rows, and the names of their threads."""
    blocks, names = [], set()

    def step(part: slice) -> None:
        blocks.append(part)
        names.add(threading.current_thread().name)

    over_blocks(rows, size, lambda _: step, like=like)
    return sorted(blocks, key=lambda part: part.start), names


@pytest.mark.parametrize("rows", [0, 1, LEAST_ROWS + 1, ROWS - 1, ROWS, ROWS + 1, 20 * LEAST_ROWS + 7])
@pytest.mark.parametrize("size", [256, 2048])
def test_every_row_is_in_one_block(rows: int, size: int, threads: int) -> None:
    blocks, names = recorded(rows, size, torch.empty(0))
    assert [row for part in blocks for row in range(rows)[part]] == list(range(rows))
    assert all(part.stop - part.start <= size for part in blocks)
    assert len(names) <= max(1, threads)


@fake_accelerator.needed
def test_an_accelerator_is_given_as_much_as_it_may_have_at_once() -> None:
    """A CPU gets a block for each of its cores; elsewhere each block would be launches of its own."""
    rows = 20 * LEAST_ROWS
    assert len(recorded(rows, rows, torch.empty(0))[0]) > 1
    assert recorded(rows, rows, torch.empty(0, device=fake_accelerator.NAME))[0] == [slice(0, rows)]


def step_of(network: Siren, x: Tensor) -> list[Tensor]:
    """Value, jet, and all that the backward pass of a jet gives."""
    with torch.no_grad():
        found = [network.value(x), *network.jet(x)]
    moved = x.clone().requires_grad_()
    jet = network.jet(moved)
    loss = ((jet.gradient.norm(dim=-1) - 1) ** 2).sum() + jet.value.abs().sum() + jet.features.square().sum()
    return [*found, jet.value, jet.gradient, *torch.autograd.grad(loss, [moved, *network.parameters()])]


@pytest.mark.parametrize("rows", [1, LEAST_ROWS, ROWS + 3])
def test_the_same_bits_for_any_number_of_threads(rows: int, threads: int) -> None:
    torch.manual_seed(0)
    network, x = Siren(48, 3, num_features=2), torch.rand(rows, 3)
    found = step_of(network, x)
    # Few rows are left to the operations, which split a product of this size themselves: rounding may differ.
    with operations_split() if rows < ROWS else one_thread():
        expected = step_of(network, x)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_parts_of_a_derivative_add_up() -> None:
    """Against plain operations, in float64 with more blocks than parts and a last one that is not whole."""
    torch.manual_seed(1)
    network, x = Siren(400, 1).double(), torch.rand(17 * 655 + 5, 3, dtype=torch.float64)
    jet = network.jet(x)
    found = torch.autograd.grad(jet.value.square().sum() + jet.gradient.square().sum(), list(network.parameters()))
    moved = x.clone().requires_grad_()
    value = network.output(torch.sin(network.omega * network.layers[0](moved)))[:, 0]
    (gradient,) = torch.autograd.grad(value.sum(), moved, create_graph=True)
    expected = torch.autograd.grad(value.square().sum() + gradient.square().sum(), list(network.parameters()))
    for a, b in zip(found, expected, strict=True):
        # A sum over N terms loses at most N roundings of its largest partial sum; here all terms are of one size.
        torch.testing.assert_close(a, b, rtol=0, atol=float(b.abs().max()) * len(x) * 2.0**-52)


def test_what_a_step_raises_ends_the_work(threads: int) -> None:
    seen = []

    def step(part: slice) -> None:
        seen.append(part.start)
        if part.start == 2 * LEAST_ROWS:
            raise KeyError("planted")

    rows = 64 * LEAST_ROWS
    with pytest.raises(KeyError, match="planted"):
        over_blocks(rows, LEAST_ROWS, lambda _: step, like=torch.empty(0))
    # Each of the others finishes what it has, and may have taken one more before it could know.
    assert len(seen) <= 3 + 2 * threads + 2
    assert torch.get_num_threads() == threads


def test_grad_and_inference_mode_reach_every_thread(threads: int) -> None:
    network, x = Siren(16, 2), torch.rand(ROWS, 3)
    with torch.inference_mode():
        assert network.jet(x).gradient.is_inference()
    with torch.no_grad():
        assert not network.jet(x).gradient.requires_grad
    assert network.jet(x).gradient.requires_grad


def test_modes_see_all_operations() -> None:
    like = torch.empty(0)
    with BaseTorchFunctionMode():
        assert recorded(ROWS, LEAST_ROWS, like)[1] == {threading.current_thread().name}
    assert recorded(ROWS, LEAST_ROWS, torch.empty(0, device="meta"))[1] == {threading.current_thread().name}


def test_callers_from_several_threads(threads: int) -> None:
    torch.manual_seed(0)
    network, x = Siren(32, 2).requires_grad_(False), torch.rand(4 * ROWS, 3)
    expected = network.jet(x)

    def jet(_: int) -> bool:
        torch.set_num_threads(threads)
        return all(torch.equal(a, b) for a, b in zip(network.jet(x), expected, strict=True))

    with ThreadPoolExecutor(3) as pool:
        assert all(pool.map(jet, range(12)))


@pytest.mark.skipif(sys.platform == "win32", reason="fork is of POSIX")
def test_a_forked_process_makes_threads_of_its_own() -> None:
    code = f"""
import os, torch
from mplicits.neural_fields import Siren
torch.set_num_threads(2)
network, x = Siren(16, 1).requires_grad_(False), torch.rand({ROWS}, 3)
expected = network.value(x)
child = os.fork()
if not child:
    torch.set_num_threads(2)
    os._exit(0 if torch.equal(network.value(x), expected) else 3)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", code], timeout=120, check=False).returncode == 0
