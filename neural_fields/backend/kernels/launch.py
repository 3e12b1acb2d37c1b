"""Common to all launches: tiles of a network, number of programs, and their scratch."""

# pyright: reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import contextlib
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor

REGISTERS, WARP = 1 << 16, 32  # of a multiprocessor of compute capability 8.0 and later; threads of a warp
INTERPRETED_PROGRAMS = 3  # run in turn by the interpreter


class Network(NamedTuple):
    """A SIREN for the kernels."""

    parameters: tuple[Tensor, ...]  # (W₁, b₁, …, W_out, b_out), contiguous, float32; one output row is read
    omega: float  # ω₀ times the unit of the sine layers' parameters
    gain: float  # the unit of the output's

    @classmethod
    def of(cls, parameters: Sequence[Tensor], omega: float, gain: float) -> Network:
        """A network of contiguous, detached parameters."""
        return cls(tuple(parameter.detach().contiguous() for parameter in parameters), float(omega), float(gain))

    @property
    def width(self) -> int:
        """Of the sine layers."""
        return self.parameters[0].shape[0]

    @property
    def depth(self) -> int:
        """Number of sine layers."""
        return len(self.parameters) // 2 - 1


class Tiling(NamedTuple):
    """How a kernel cuts its work; the names are those of its arguments."""

    rows: int  # points of a tile
    columns: int  # units of an accumulator, a power of two
    piece: int  # inner units of one product, a power of two ≥ 16
    warps: int  # of a program

    def stride(self, width: int) -> int:
        """The width rounded up to whole accumulators."""
        return triton.cdiv(width, self.columns) * self.columns


def tiling_of(width: int) -> Tiling:
    """Tiles for a width: one accumulator up to 128 units; beyond, 64 units at a time, which wastes fewest of 400."""
    units = max(16, triton.next_power_of_2(width))
    if units <= 128:
        return Tiling(64, units, min(32, units), 8 if units == 128 else 4)
    return Tiling(64, 64, 32, 4)


def program_count(device: torch.device, tiles: int) -> int:
    """Programs that share ``tiles``: at least 1, and as many as run at a time."""
    if device.type != "cuda":
        return max(1, min(tiles, INTERPRETED_PROGRAMS))
    # By their registers two run beside each other; of the jet of 128 units one, and the other comes after it.
    return max(1, min(tiles, 2 * multiprocessors(device)))


def multiprocessors(device: torch.device) -> int:
    """Of a CUDA device."""
    return torch.cuda.get_device_properties(device).multi_processor_count


def half_scratch(like: Tensor, numbers: int) -> Tensor:
    """Uninitialised memory for ``numbers`` float16 numbers, at least one."""
    return torch.empty(max(1, numbers), dtype=torch.float16, device=like.device)


def on_device(x: Tensor) -> contextlib.AbstractContextManager[object]:
    """Make the device of ``x`` current, on which Triton launches."""
    return torch.cuda.device(x.device) if x.is_cuda else contextlib.nullcontext()


# Programs that a multiprocessor holds at a time, of each compiled kernel.
_resident: dict[Hashable, int] = {}


def launch(
    kernel: Any,
    like: Tensor,
    tiles: int,
    arguments: Callable[[int], Sequence[object]],
    *,
    warps: int = 4,
    stages: int = 2,
    **constants: Any,
) -> None:
    """Launch as many programs of a kernel as the device holds at a time, at most ``tiles`` ≥ 1.

    How many a multiprocessor holds follows from the registers and shared memory of the compiled kernel; the first
    launch, which compiles it, has one for each. ``arguments`` maps the number of programs to the kernel's arguments;
    ``constants`` are compiled in.
    """
    options = {**constants, "num_warps": warps, "num_stages": stages}
    if not like.is_cuda:
        programs = min(tiles, INTERPRETED_PROGRAMS)
        kernel[(programs,)](*arguments(programs), **options)
        return
    key = (id(kernel), like.device, *options.items())
    programs = min(tiles, multiprocessors(like.device) * _resident.get(key, 1))
    with on_device(like):
        compiled = kernel[(programs,)](*arguments(programs), **options)
    if key not in _resident:
        _resident[key] = resident_programs(
            compiled.n_regs, compiled.metadata.shared, warps, torch.cuda.get_device_properties(like.device)
        )


def resident_programs(registers: int, shared: int, warps: int, properties: Any) -> int:
    """Programs that one multiprocessor holds: ``registers`` of a thread, ``shared`` bytes of a program."""
    by_registers = REGISTERS // (-(-registers // 8) * 8 * WARP * warps)
    # The driver keeps 1 KiB of shared memory for each program.
    by_shared = properties.shared_memory_per_multiprocessor // (shared + (1 << 10))
    by_threads = properties.max_threads_per_multi_processor // (WARP * warps)
    return max(1, min(by_registers, by_shared, by_threads))
