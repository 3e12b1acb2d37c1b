"""The machine and its devices: their choice and speed, transfers without waiting, blocks of rows on CPU threads."""

from __future__ import annotations

import functools
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from .errors import InputError

M = TypeVar("M", bound=Callable[..., Any])


def makes_wait(device: torch.device) -> bool:
    """Whether reading a number of ``device`` blocks the host until the device is done: on all but the CPU."""
    return device.type != "cpu"


def upload(tensor: Tensor, device: torch.device | str) -> Tensor:
    """The tensor on ``device``; copied from pinned memory, so that the host does not wait."""
    device = torch.device(device)
    if device.type in ("cpu", "mps"):  # these share the host's memory
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


class GraphInputs:
    """Inputs from the host for work that a device repeats with the same operations, as a CUDA graph requires.

    The first run, inside `recording`, records how each input is made. Inside `static`, `graph_input` returns views of
    fixed device memory, which `update` fills again: in the same order, with one copy per dtype.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._makers: list[Callable[[], Tensor]] = []
        self._shapes: list[tuple[torch.dtype, torch.Size]] = []
        self._buffers: dict[torch.dtype, Tensor] = {}
        self._views: list[Tensor] = []
        self._next: int | None = None

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record every `graph_input` call of the block; used once."""
        token = _inputs.set(self)
        try:
            yield
        finally:
            _inputs.reset(token)
        self._allocate()

    @contextmanager
    def static(self) -> Iterator[None]:
        """Inside, `graph_input` returns the memory that `update` fills, and makes nothing."""
        self._next = 0
        token = _inputs.set(self)
        try:
            yield
        finally:
            _inputs.reset(token)
            self._next = None

    def update(self) -> None:
        """Make all inputs again, for the next run."""
        made = [make() for make in self._makers]
        for dtype, buffer in self._buffers.items():
            flat = torch.cat([one.reshape(-1) for one in made if one.dtype == dtype])
            buffer.copy_(upload(flat, self.device), non_blocking=True)

    def _allocate(self) -> None:
        """Allocate memory for the recorded inputs, and views of it, one for each."""
        sizes: dict[torch.dtype, int] = {}
        starts = []
        for dtype, shape in self._shapes:
            starts.append(sizes.get(dtype, 0))
            sizes[dtype] = starts[-1] + shape.numel()
        self._buffers = {dtype: torch.zeros(size, dtype=dtype, device=self.device) for dtype, size in sizes.items()}
        self._views = [
            self._buffers[dtype][start : start + shape.numel()].view(shape)
            for start, (dtype, shape) in zip(starts, self._shapes, strict=True)
        ]

    def get(self, make: Callable[[], Tensor]) -> Tensor:
        """See `graph_input`."""
        if self._next is not None:
            self._next += 1
            return self._views[self._next - 1]
        made = make()
        self._makers.append(make)
        self._shapes.append((made.dtype, made.shape))
        return upload(made, self.device)


_inputs: ContextVar[GraphInputs | None] = ContextVar("inputs", default=None)


def graph_input(make: Callable[[], Tensor], device: torch.device) -> Tensor:
    """``make()`` on ``device``, made again for each run of `GraphInputs`. Its shape must not change between calls."""
    inputs = _inputs.get()
    return upload(make(), device) if inputs is None else inputs.get(make)


def uniform(shape: Sequence[int], generator: torch.Generator, device: torch.device) -> Tensor:
    """Random numbers in [0, 1) of ``shape``, drawn on the host as a `graph_input`."""
    return graph_input(lambda: torch.rand(*shape, generator=generator), device)


def has_graph_inputs() -> bool:
    """Whether this work is repeated with `GraphInputs`, so that inputs from the host must go through `graph_input`."""
    return _inputs.get() is not None


def few_numbers(numbers: Sequence[float], like: Tensor) -> Tensor:
    """A vector of numbers on the device and in the dtype of ``like``, filled there without waiting."""
    return torch.stack([like.new_full((), number) for number in numbers])


def precise(device: torch.device) -> torch.dtype:
    """Float64, or float32 on devices without it (MPS)."""
    return torch.float32 if device.type == "mps" else torch.float64


def uncompiled(method: M) -> M:
    """A method that compiled code calls unchanged, with the same bits and the same kernels as elsewhere.

    `torch.compile` cannot improve on what is written out by hand, and Inductor turns writes into parts of
    uninitialised buffers into wrong numbers. The decorator is made when it is first needed, as it imports the compiler.
    """

    @functools.wraps(method)
    def call(*args: Any, **options: Any) -> Any:
        if torch.compiler.is_dynamo_compiling():
            return torch.compiler.disable(method)(*args, **options)
        return method(*args, **options)

    return cast(M, call)


def is_traced() -> bool:
    """Whether plain operations are needed: under `torch.func.vmap`, or while `torch.export` traces."""
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

LEAST_ROWS = 1024  # of a block: with fewer, calls from Python (one thread at a time) dominate
WANTED_BLOCKS = 8  # that few rows are cut into, where blocks stay at LEAST_ROWS: enough for eight cores
LEAST_BLOCKS = 4  # for threads; with fewer, waking them costs more than it saves


split_operations = ContextVar("split_operations", default=False)  # blocks in turn, operations split among all threads


def over_blocks(rows: int, size: int, prepare: Callable[[int], Step], *, like: Tensor) -> None:
    """Call a step for each block of at most ``size`` of ``rows`` rows, on as many threads as PyTorch is set to use.

    ``prepare(size)`` is called once per thread and returns its step, with buffers of its own. A step gets the slice of
    its block. Threads meet once, at the end, and a block's result depends on nothing else: the bits are the same for
    any number of threads. Threads are used for plain CPU tensors ``like``; others get the blocks in turn. The first
    error is raised.
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
    starts, lock, inference = iter(range(0, rows, size)), threading.Lock(), torch.is_inference_mode_enabled()

    def work() -> None:
        """Process blocks until none is left; after an error no thread begins another."""
        step: Step | None = None
        while True:
            with lock:
                start = next(starts, None)
            if start is None:
                return
            try:
                step = step or prepare(min(size, rows))
                step(slice(start, min(start + size, rows)))
            except BaseException:
                with lock:
                    deque(starts, maxlen=0)
                raise

    def helper() -> None:
        torch.set_num_threads(1)
        with torch.inference_mode(inference), torch.no_grad():
            work()

    with one_thread():
        helpers = [_helpers().submit(helper) for _ in range(threads - 1)]
        try:
            work()
        finally:
            # Helpers that have not begun are cancelled, so this waits only for the blocks under way.
            failures = [error for one in helpers if not one.cancel() and (error := one.exception()) is not None]
    if failures:
        raise failures[0]


def _may_share(like: Tensor) -> bool:
    """Whether other threads may work on this tensor; modes that watch operations watch one thread only."""
    return (
        not split_operations.get()
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


@functools.cache
def _helpers() -> ThreadPoolExecutor:
    """The threads beside the caller's; made at first use, and again in a forked process."""
    return ThreadPoolExecutor(max_workers=max(1, (os.cpu_count() or 1) - 1), thread_name_prefix="mplicits")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)


# Linux keeps the high-water mark of a process here. Not getrusage: its maximum survives exec, so that a child would
# report what its parent held when it was born.
STATUS = Path("/proc/self/status")


def best_seconds(work: Callable[[], object], *, repeats: int = 5, median: bool = False) -> float:
    """Least wall-clock seconds of ``repeats`` calls after a warm-up: other processes can only make a run slower.

    The ``median`` is for where it is their effect that is to be seen.
    """
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return sorted(times)[repeats // 2] if median else min(times)


@torch.inference_mode()
def sgemm_rate(width: int = 512, *, rows: int = 2048, device: torch.device | str = "cpu", repeats: int = 20) -> float:
    """Measured float32 matrix-product rate ``(rows, width) @ (width, width)``, in FLOP/s: the limit of any SIREN."""
    random = torch.Generator().manual_seed(0)  # of its own: who measures in between draws the same afterwards
    a = torch.randn(rows, width, generator=random).to(device)
    b = torch.randn(width, width, generator=random).to(device)
    out = torch.empty(rows, width, device=device)
    return 2 * rows * width * width / best_seconds(lambda: torch.mm(a, b, out=out), repeats=repeats)


def peak_memory() -> int | None:
    """Largest resident set of this process so far, in bytes; None where the system does not keep it (Windows)."""
    try:
        status = STATUS.read_text(encoding="ascii")
    except OSError:
        status = ""
    for line in status.splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def choose_device(name: str) -> torch.device:
    """The device of this name; ``auto`` is CUDA where there is a working GPU, the CPU elsewhere.

    Raises:
        InputError: no such device here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"--device {name}: not usable here ({reason}); use auto or cpu") from error
    return device
