"""One fit by several processes, started by torch's own launcher: ``torchrun --nproc-per-node 2 -m …``.

Every process holds the whole cloud and the whole network, and draws the same batches from the same generator; of each
it looks at its share. Gradients are averaged before every step, so that all networks stay equal, and equal to that of
a single process up to rounding. Outside a `team` every function here does what one process alone needs: nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor

__all__ = ["agreed", "average_gradients", "is_alone", "is_leader", "my_share", "team", "whole_batch"]


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
    """Whether no team was joined."""
    return not dist.is_initialized()


def is_leader() -> bool:
    """Whether this process is the one that writes: rank 0, or alone."""
    return is_alone() or dist.get_rank() == 0


def whole_batch(count: int) -> int:
    """``count``, rounded up to a multiple of the number of processes: all shares are then equal."""
    size = 1 if is_alone() else dist.get_world_size()
    return -(-count // size) * size


def my_share(index: Tensor) -> Tensor:
    """Of what all have drawn, ``(n,)``, the part that this process looks at."""
    return index if is_alone() else index[dist.get_rank() :: dist.get_world_size()]


def average_gradients(parameters: Iterable[Tensor]) -> None:
    """Replace gradients by their mean over all processes, in one message."""
    if is_alone():
        return
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    for gradient, mean in zip(gradients, flat.split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


def agreed(stop: bool, elapsed: float, device: torch.device) -> tuple[bool, float]:
    """Whether any process was asked to stop, and the longest time: all must take the same number of steps."""
    if is_alone():
        return stop, elapsed
    facts = torch.tensor([float(stop), elapsed], device=device)
    dist.all_reduce(facts, op=dist.ReduceOp.MAX)
    return bool(facts[0] > 0), float(facts[1])
