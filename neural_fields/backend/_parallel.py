"""Blocks of rows on several cores: each block is the work of one thread from its first product to its last.

Blocks are small, so that activations stay in the cache of one core. Splitting every product among all threads would
synchronise them a dozen times in a block, for little work. Here threads meet once, at the end. What is computed for a
block depends on nothing else, so results are the same bits for any number of threads.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

__all__ = ["Step", "one_thread", "over_blocks", "split_operations"]

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
