"""One training by several processes, started by torch's own launcher: ``torchrun --nproc-per-node 2 -m …``.

Every process holds all data and the whole network, and draws the same batches from the same generator; of each
it looks at its share. Gradients are averaged before every step, so that all networks stay equal, and equal to that of
a single process up to rounding. Outside a `team` every function here does what one process alone needs: nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
import torch.distributed as dist
from torch import Tensor

__all__ = [
    "agreed",
    "apart",
    "as_the_leader",
    "average_gradients",
    "gathered",
    "is_alone",
    "is_leader",
    "mean_of_all",
    "my_share",
    "own_generator",
    "team",
    "whole_batch",
]

_APART = ContextVar("apart", default=False)


@contextmanager
def team(*, device: str = "auto") -> Iterator[bool]:
    """Join the processes that ``torchrun`` started beside this one, if it did → whether to write and print here.

    On a CUDA device they talk through NCCL, each with the GPU of its local rank, else through gloo.

    Args:
        device: as in `FitConfig`; ``auto`` is CUDA where there is a GPU.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or "RANK" not in os.environ:
        yield True
        return
    cuda = device.startswith("cuda") or (device == "auto" and torch.cuda.is_available())
    if cuda:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    dist.init_process_group("nccl" if cuda else "gloo")
    try:
        yield is_leader()
    finally:
        dist.destroy_process_group()


def is_alone() -> bool:
    """Whether no team was joined, or what is done is done `apart` from it."""
    return _APART.get() or not dist.is_initialized()


@contextmanager
def apart() -> Iterator[None]:
    """A block that this process does without the others: its trainings wait for nobody."""
    token = _APART.set(True)
    try:
        yield
    finally:
        _APART.reset(token)


def is_leader() -> bool:
    """Whether this process is the one that writes: rank 0, or alone."""
    return is_alone() or dist.get_rank() == 0


@torch.no_grad()
def as_the_leader(tensors: Iterable[Tensor]) -> None:
    """Give all processes the leader's numbers, in place: what several GPUs compute alike may differ by rounding."""
    if not is_alone():
        for tensor in tensors:
            dist.broadcast(tensor, src=0)


def whole_batch(count: int) -> int:
    """``count``, rounded up to a multiple of the number of processes: all shares are then equal."""
    size = 1 if is_alone() else dist.get_world_size()
    return -(-count // size) * size


def my_share(index: Tensor) -> Tensor:
    """Of what all have drawn, ``(n,)``, the part that this process looks at."""
    return index if is_alone() else index[dist.get_rank() :: dist.get_world_size()]


def own_generator(generator: torch.Generator) -> torch.Generator:
    """Random numbers for a part of the work of which nobody knows how many it takes, as light decides it.

    Alone, those of ``generator``. In a team a generator of this process, whose seed follows from what all share, so
    that the shared one is left in the same state everywhere.
    """
    if is_alone():
        return generator
    seed = int(torch.randint(1 << 62, (), generator=generator))
    return torch.Generator().manual_seed(seed + dist.get_rank())


def gathered(share: Tensor) -> Tensor:
    """The shares ``(n, …)`` of all processes, one behind the other, ``(N n, …)``; all must be equally long."""
    if is_alone():
        return share
    parts = [torch.empty_like(share) for _ in range(dist.get_world_size())]
    dist.all_gather(parts, share.contiguous())
    return torch.cat(parts)


def mean_of_all(value: Tensor) -> Tensor:
    """The mean of a tensor over all processes; no gradient comes through."""
    return value if is_alone() else gathered(value.detach()[None]).mean(dim=0)


def average_gradients(parameters: Iterable[Tensor]) -> None:
    """Replace gradients by their mean over all processes, in one message.

    A parameter that a process's share does not depend on counts as 0 there. What no share depends on stays without.
    """
    if is_alone():
        return
    every = list(parameters)
    gradients = [torch.zeros_like(each) if each.grad is None else each.grad for each in every]
    known = torch.tensor([each.grad is not None for each in every]).to(gradients[0])
    flat = torch.cat([*(gradient.flatten() for gradient in gradients), known])
    dist.all_reduce(flat)
    *means, known = (flat / dist.get_world_size()).split([*(each.numel() for each in every), len(every)])
    for parameter, mean, share in zip(every, means, known.tolist(), strict=True):
        parameter.grad = mean.view_as(parameter) if share else None


def agreed(stop: bool, elapsed: float, device: torch.device) -> tuple[bool, float]:
    """Whether any process was asked to stop, and the longest time: all must take the same number of steps."""
    if is_alone():
        return stop, elapsed
    facts = torch.tensor([float(stop), elapsed], device=device)
    dist.all_reduce(facts, op=dist.ReduceOp.MAX)
    return bool(facts[0] > 0), float(facts[1])
