"""What PyTorch's operations cost beside arithmetic: launches, waits of the host, and bytes read and written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from mplicits.neural_fields.backend import devices
from mplicits.neural_fields.networks import siren
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

_aten = torch.ops.aten
_WAITS = (_aten.nonzero, _aten._local_scalar_dense)
_FREE = (_aten.empty, _aten.empty_like, _aten.new_empty, _aten.empty_strided, _aten.new_empty_strided)


class Traffic(NamedTuple):
    """Counts of PyTorch's operations.

    Attributes:
        launches: operations that compute something; each is a kernel on a GPU.
        waits: operations whose result the host needs before it can go on.
        moved: bytes that the operations read and write.
    """

    launches: int
    waits: int
    moved: int


def traffic_of(work: Callable[[], object]) -> Traffic:
    """Run ``work`` on the CPU and count its operations, with the block sizes of a GPU."""
    counter = _Counter()
    with _blocks_of_a_gpu(), counter:
        work()
    return Traffic(counter.launches, counter.waits, counter.moved)


class _Counter(TorchDispatchMode):
    """Counts operations while it is active."""

    def __init__(self) -> None:
        super().__init__()
        self.launches = self.waits = self.moved = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        packet = func.overloadpacket
        if func.is_view or packet in _FREE:
            return result
        # A boolean mask as an index becomes row numbers first, and the host has to know how many there are.
        masked = packet in (_aten.index, _aten.index_put, _aten.index_put_) and any(
            one is not None and one.dtype == torch.bool for one in args[1]
        )
        self.launches += 1
        self.waits += masked or packet in _WAITS
        self.moved += sum(one.numel() * one.element_size() for one in _tensors((args, kwargs, result)))
        return result


def _tensors(values: Any) -> Iterator[Tensor]:
    """All tensors in arguments or results."""
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, Mapping):
        yield from _tensors(list(values.values()))
    elif isinstance(values, Sequence) and not isinstance(values, str):
        for value in values:
            yield from _tensors(value)


@contextmanager
def _blocks_of_a_gpu() -> Iterator[None]:
    """Evaluate in blocks as large as on a GPU: the smaller blocks of a CPU would add launches."""
    before = siren.BLOCK_FLOATS, devices.WANTED_BLOCKS
    siren.BLOCK_FLOATS, devices.WANTED_BLOCKS = siren.GPU_BLOCK_FLOATS, 1
    try:
        yield
    finally:
        siren.BLOCK_FLOATS, devices.WANTED_BLOCKS = before
