"""What the host should know of a device that works behind its back: when to look, and how to hand it something."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

__all__ = ["Supply", "few_numbers", "handed", "is_supplied", "makes_wait", "precise", "uniform", "upload"]


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


class Supply:
    """What the host makes for a work of a device that is done again and again, with the same operations each time.

    The first time, inside `noting`, it goes to the device as it is asked for, and how it was made is noted down. From
    then on, inside `supplied`, the work finds it in memory of the device that stays where it is, as a CUDA graph wants
    it; `renew` makes all of it once more, in the same order, and sends it in one copy for each precision.

    Args:
        device: where the work is done.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._makers: list[Callable[[], Tensor]] = []
        self._shapes: list[tuple[torch.dtype, torch.Size]] = []
        self._stores: dict[torch.dtype, Tensor] = {}
        self._places: list[Tensor] = []
        self._next: int | None = None

    @contextmanager
    def noting(self) -> Iterator[None]:
        """The work is done as if there were no supply; `handed` notes down. Once."""
        token = _supply.set(self)
        try:
            yield
        finally:
            _supply.reset(token)
        self._lay_out()

    @contextmanager
    def supplied(self) -> Iterator[None]:
        """`handed` gives what `renew` has put there, and makes nothing."""
        self._next = 0
        token = _supply.set(self)
        try:
            yield
        finally:
            _supply.reset(token)
            self._next = None

    def renew(self) -> None:
        """Make all of it anew, for the next time."""
        made = [make() for make in self._makers]
        for dtype, store in self._stores.items():
            flat = torch.cat([one.reshape(-1) for one in made if one.dtype == dtype])
            store.copy_(upload(flat, self.device), non_blocking=True)

    def _lay_out(self) -> None:
        """Memory for all that was noted down, and the place of each part in it."""
        sizes: dict[torch.dtype, int] = {}
        starts = []
        for dtype, shape in self._shapes:
            starts.append(sizes.get(dtype, 0))
            sizes[dtype] = starts[-1] + shape.numel()
        self._stores = {dtype: torch.zeros(size, dtype=dtype, device=self.device) for dtype, size in sizes.items()}
        self._places = [
            self._stores[dtype][start : start + shape.numel()].view(shape)
            for start, (dtype, shape) in zip(starts, self._shapes, strict=True)
        ]

    def give(self, make: Callable[[], Tensor]) -> Tensor:
        """See `handed`."""
        if self._next is not None:
            self._next += 1
            return self._places[self._next - 1]
        made = make()
        self._makers.append(make)
        self._shapes.append((made.dtype, made.shape))
        return upload(made, self.device)


_supply: ContextVar[Supply | None] = ContextVar("supply", default=None)


def handed(make: Callable[[], Tensor], device: torch.device) -> Tensor:
    """What the host makes, on ``device``; anew each time, where a work is done again by a `Supply`.

    Args:
        make: draws random numbers, or tells what the host knows by now; its shape is the same each time.
        device: of the work.
    """
    supply = _supply.get()
    return upload(make(), device) if supply is None else supply.give(make)


def uniform(shape: Sequence[int], generator: torch.Generator, device: torch.device) -> Tensor:
    """Random numbers from 0 to 1 that the host draws, `handed` over."""
    return handed(lambda: torch.rand(*shape, generator=generator), device)


def is_supplied() -> bool:
    """Whether this work will be done again by a `Supply`, so that numbers of the host must go through `handed`."""
    return _supply.get() is not None


def few_numbers(numbers: Sequence[float], like: Tensor) -> Tensor:
    """A vector of some numbers of the host, where and as ``like`` is: filled in there, which nobody waits for."""
    return torch.stack([like.new_full((), number) for number in numbers])


def precise(device: torch.device) -> torch.dtype:
    """Float64 where the device has it: what the host computes with, for numbers that stay on the device."""
    return torch.float32 if device.type == "mps" else torch.float64
