"""The fake accelerator raises a GPU's errors, counts exactly, and changes no bit."""

import fake_accelerator
import numpy as np
import pytest
import torch
from fields import small_multiscale
from torch import Tensor

DEVICE = torch.device(fake_accelerator.NAME)


def on_device(*shape: int) -> Tensor:
    return torch.rand(*shape).to(DEVICE)


def test_numbers_go_there_and_come_back() -> None:
    x = torch.rand(4, 3)
    there = x.to(DEVICE)
    assert isinstance(there, fake_accelerator.FakeAcceleratorTensor)
    assert (there.device, there.is_cpu) == (torch.device(fake_accelerator.NAME, 0), False)
    assert type(there.cpu()) is Tensor
    assert there.cpu().equal(x)
    assert (there.tolist(), there[1, 2].item()) == (x.tolist(), x[1, 2].item())


def test_shells_share_what_their_views_share() -> None:
    x = torch.arange(6, device=DEVICE)
    x.view(2, 3)[1] = 7
    x[:2] += 10
    assert x.tolist() == [10, 11, 2, 7, 7, 7]
    x.unsqueeze_(0).squeeze_(0)
    assert x.shape == (6,)
    x.data = torch.zeros(6, dtype=torch.int64, device=DEVICE)
    assert x.tolist() == [0] * 6


@pytest.mark.parametrize(
    "mixed",
    [
        lambda x: x + torch.ones(3),
        lambda x: torch.ones(3) * x,
        lambda x: torch.cat((x, torch.ones(3))),
        lambda x: torch.stack((x[0], torch.ones(()))),
        lambda x: torch.ones(3).add_(x),
        lambda x: torch.ones(()).add_(x[0]),
        lambda x: x @ torch.ones(3),
        lambda x: x.index_copy(0, torch.tensor([1]), x[:1]),
        lambda x: torch.ones(3)[x.long()],
        lambda x: torch.where(torch.ones(3, dtype=torch.bool), x, x),
        lambda x: torch.searchsorted(torch.ones(3), x),
        lambda x: torch.nn.Linear(3, 1)(x),
    ],
)
def test_operands_on_two_devices_are_refused(mixed: object) -> None:
    with pytest.raises(RuntimeError, match="same device"):
        mixed(on_device(3))


def test_numbers_of_the_host_are_taken() -> None:
    x, two = on_device(3), torch.tensor(2.0)
    for result in (x * two, two * x, torch.where(x > 2, two, x), torch.maximum(x, two), x.masked_fill(x < 2, two)):
        assert result.device.type == fake_accelerator.NAME
    assert x[torch.tensor([2, 0])].tolist() == [x[2].item(), x[0].item()]


def test_numpy_is_refused() -> None:
    x = on_device(3)
    for attempt in (x.numpy, lambda: np.asarray(x), lambda: np.add(x, 1)):
        with pytest.raises(TypeError, match="cpu"):
            attempt()


def test_generators_of_the_host_are_refused() -> None:
    generator = torch.Generator().manual_seed(0)
    for draw in (
        lambda: torch.rand(3, device=DEVICE, generator=generator),
        lambda: torch.randperm(3, device=DEVICE, generator=generator),
        lambda: torch.empty(3, device=DEVICE).normal_(generator=generator),
    ):
        with pytest.raises(RuntimeError, match="for generator but found 'cpu'"):
            draw()


def test_memory_that_may_not_be_there_yet_is_refused() -> None:
    x = on_device(3)
    copies = (lambda: x.to("cpu", non_blocking=True), lambda: torch.empty(3).copy_(x, non_blocking=True))
    for attempt in (*copies, x.pin_memory):
        with pytest.raises(RuntimeError, match=r"may be read before|only dense CPU tensors can be pinned"):
            attempt()


@pytest.mark.parametrize(
    ("why", "times", "ask"),
    [
        ("item", 1, lambda x: x[0].item()),
        ("item", 1, lambda x: torch.equal(x, x)),
        ("item", 3, lambda x: [float(value) for value in x]),
        ("size", 1, lambda x: x.nonzero()),
        ("size", 1, lambda x: x[x > 0]),
        ("size", 1, lambda x: torch.where(x > 0)),
        ("size", 1, lambda x: x.masked_select(x > 0)),
        ("size", 1, lambda x: x.unique()),
        ("size", 1, lambda x: x.repeat_interleave(x.long())),
        ("size", 1, lambda x: x.clone().__setitem__(x > 0, x)),
        ("download", 1, lambda x: x.cpu()),
        ("download", 1, lambda x: torch.zeros(3).copy_(x)),
        ("upload", 1, lambda x: torch.tensor([1.0, 2.0], device=x.device)),
        ("upload", 1, lambda x: torch.ones(3).to(x)),
        ("upload", 1, lambda x: x[torch.tensor([0, 2])]),
        ("none", 0, lambda x: torch.where(x > 0, x.sin() + 2.0, 0.0).cumsum(0)[1:].clone()),
        ("none", 0, lambda x: x.clone().masked_fill_(x > 0, 1.0).sort()),
        ("none", 0, lambda x: x.clone().__setitem__(x > 0, 1.0)),
        ("none", 0, lambda x: x.repeat_interleave(2).index_select(0, torch.zeros_like(x).long())),
        ("upload", 1, lambda x: torch.ones(3).to(x, non_blocking=True)),
        ("upload", 1, lambda x: torch.ones(3).pin_memory().to(x)),
        ("none", 0, lambda x: torch.ones(3).pin_memory().to(x, non_blocking=True)),
        ("none", 0, lambda x: torch.zeros(3, device=x.device, dtype=torch.float64).fill_(2).to(torch.float32)),
    ],
)
@pytest.mark.parametrize("inference", [False, True])
def test_waits_are_counted(why: str, times: int, ask: object, inference: bool) -> None:
    """In inference mode as well, where operations come to a device before they are taken apart."""
    with torch.inference_mode(inference):
        x = torch.ones(3).to(DEVICE)
        with fake_accelerator.counted() as book:
            ask(x)
    assert {name for name, _ in book.waits} == ({why} if times else set()), book.report()
    assert book.synchronisations == times


def test_launches_are_counted_and_views_are_none() -> None:
    x = on_device(4, 3)
    with fake_accelerator.counted() as book:
        (x.t()[1:].reshape(2, 4).expand(2, 2, 4)[..., None].detach().sin() + 1).sum()
        torch.empty(3, device=DEVICE)
        torch.zeros(3, device=DEVICE).add_(1)
    assert book.launches == {"sin": 1, "add": 1, "sum": 1, "zero_": 1, "add_": 1}
    with fake_accelerator.counted() as outer:
        x.sin()
        with fake_accelerator.counted() as inner:
            x.cos()
    assert (outer.kernels, inner.kernels) == (2, 1)


def test_waits_name_the_line_that_asked() -> None:
    with fake_accelerator.counted() as book:
        on_device(3)[0].item()
    assert [where.split(":")[0] for _, where in book.waits] == ["test_fake_accelerator.py"] * 2
    field = small_multiscale().to(DEVICE)
    x = on_device(50, 3)
    with fake_accelerator.counted() as book:
        field.value(x)
    # Each residual is evaluated at the rows of its band, whose number the host has to know.
    (wait,) = [(why, where.split(":")[0]) for why, where in book.waits]
    assert wait == ("size", "neural_fields/networks/multiscale.py")
    assert book.synchronisations == field.num_levels - 1
