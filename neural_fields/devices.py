"""What the host should know of a device that works behind its back: when to look, and how to hand it something."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["few_numbers", "makes_wait", "precise", "upload"]


def makes_wait(device: torch.device) -> bool:
    """Whether a look at a number of ``device`` keeps the host from giving it more to do: on any but the CPU."""
    return device.type != "cpu"


def upload(tensor: Tensor, device: torch.device | str) -> Tensor:
    """A tensor of the host on ``device``, without waiting until the device has done what it was asked for before.

    From pinned memory, which PyTorch keeps until the copy is done; a copy from other memory would wait.
    """
    device = torch.device(device)
    if device.type in ("cpu", "mps"):  # these share the host's memory
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def few_numbers(numbers: Sequence[float], like: Tensor) -> Tensor:
    """A vector of some numbers of the host, where and as ``like`` is: filled in there, which nobody waits for."""
    return torch.stack([like.new_full((), number) for number in numbers])


def precise(device: torch.device) -> torch.dtype:
    """Float64 where the device has it: what the host computes with, for numbers that stay on the device."""
    return torch.float32 if device.type == "mps" else torch.float64
