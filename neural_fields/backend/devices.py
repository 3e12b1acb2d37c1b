"""What the host should know of a device that works behind its back: when to look, and how to hand it something."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor


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


def is_traced() -> bool:
    """Whether plain operations are needed: under `torch.func.vmap`, or while `torch.compile` traces.

    Inductor turns writes into parts of uninitialised buffers into wrong numbers.
    """
    return torch.compiler.is_compiling() or under_vmap()


def under_vmap() -> bool:
    """Whether this call is mapped over a batch, at any depth of `torch.func`'s transforms."""
    if torch.compiler.is_compiling():
        return False
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    if functorch.maybe_current_level() is None:
        return False
    vmap = functorch.TransformType.Vmap
    return any(each.key() == vmap for each in functorch.get_interpreter_stack() or ())


Step = Callable[[slice], None]

# Fewer rows than this are not worth a thread: the calls from Python, which only one thread at a time can make, would be
# a good part of the block.
LEAST_ROWS = 1024
# Blocks that a short list of rows is cut into, where they can be of LEAST_ROWS: enough for eight cores.
WANTED_BLOCKS = 8
# Fewer blocks than this go one after the other, every product split among the threads: who wakes up for a block or two
# comes late.
LEAST_BLOCKS = 4


_split = ContextVar("split", default=False)
_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()


def over_blocks(rows: int, size: int, prepare: Callable[[int], Step], *, like: Tensor) -> None:
    """Call a step for each block of rows ``0 … rows``, on as many threads as PyTorch is set to use.

    Args:
        rows: how many there are.
        size: rows of one block at most; a power of two times anything.
        prepare: called once on each thread with the rows of its largest block, makes its step (and the buffers that
            only this thread writes to). A step is given the slice of its block, and runs without a graph; blocks may
            be done in any order.
        like: a tensor of the work. Threads are for plain CPU tensors; other devices, tensor subclasses and dispatch
            modes see the blocks one after the other.

    Raises:
        BaseException: what a step raised first; no further block is begun then.
    """
    if like.device.type == "cpu":  # elsewhere more blocks are more launches
        shorter = min(size, max(LEAST_ROWS, -(-rows // WANTED_BLOCKS)))
        if -(-rows // shorter) >= LEAST_BLOCKS:
            size = shorter
    count = -(-rows // size)
    threads = min(torch.get_num_threads(), count)
    if threads < 2 or count < LEAST_BLOCKS or not _may_share(like):
        step = prepare(min(size, rows))
        for start in range(0, rows, size):
            step(slice(start, min(start + size, rows)))
        return
    blocks, inference = _Blocks(rows, size), torch.is_inference_mode_enabled()

    def helper() -> None:
        torch.set_num_threads(1)
        with torch.inference_mode(inference), torch.no_grad():
            blocks.work(prepare)

    with one_thread():
        helpers = [_helpers().submit(helper) for _ in range(threads - 1)]
        try:
            blocks.work(prepare)
        finally:
            # Whoever has not begun finds nothing to do, so that this waits for the blocks under way and no more.
            failures = [error for one in helpers if not one.cancel() and (error := one.exception()) is not None]
    if failures:
        raise failures[0]


class _Blocks:
    """Slices of the rows, handed out to whoever asks next."""

    def __init__(self, rows: int, size: int) -> None:
        self._starts = iter(range(0, rows, size))
        self._rows, self._size = rows, size
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[slice]:
        while True:
            with self._lock:
                start = next(self._starts, None)
            if start is None:
                return
            yield slice(start, min(start + self._size, self._rows))

    def work(self, prepare: Callable[[int], Step]) -> None:
        """Do blocks until none is left."""
        step: Step | None = None
        try:
            for block in self:
                step = step or prepare(min(self._size, self._rows))
                step(block)
        except BaseException:
            with self._lock:
                self._starts = iter(())
            raise


def _may_share(like: Tensor) -> bool:
    """Whether other threads may work on this tensor; modes that watch operations watch those of one thread only."""
    return (
        not _split.get()
        and like.device.type == "cpu"
        and type(like) in (Tensor, torch.nn.Parameter)
        and not torch.compiler.is_compiling()
        and not torch._C._len_torch_dispatch_stack()
        and not torch._C._len_torch_function_stack()
        and not torch._C._functorch.maybe_current_level()  # pyright: ignore[reportAttributeAccessIssue]
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread inside each operation; afterwards as many as before."""
    if torch.compiler.is_compiling():
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def split_operations() -> Iterator[None]:
    """One block after the other, every operation of it split among all threads: for who compares the two."""
    token = _split.set(True)
    try:
        yield
    finally:
        _split.reset(token)


def _helpers() -> ThreadPoolExecutor:
    """The threads beside the caller's; made at first use, and anew in a process that was forked."""
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max_workers=max(1, (os.cpu_count() or 1) - 1), thread_name_prefix="mplicits")
        return _pool


def _after_fork() -> None:
    global _pool, _pool_lock
    _pool, _pool_lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
