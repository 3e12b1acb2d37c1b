"""Whether a network is evaluated by the fused kernels or by PyTorch, and why. This file does not import Triton.

They are used wherever they can be: float32 on CUDA, with Triton there (``pip install 'mplicits[kernels]'``; PyTorch's
builds for CUDA bring it). The environment variable ``MPLICITS_KERNELS`` overrides that:

    auto       the kernels where they can be used (the default)
    off        PyTorch everywhere
    interpret  the kernels on the CPU too, by Triton's interpreter (needs TRITON_INTERPRET=1): for tests
"""

from __future__ import annotations

import functools
import importlib.util
import os
from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import InputError

VARIABLE = "MPLICITS_KERNELS"
MODES = ("auto", "off", "interpret")
MAX_WIDTH, MAX_DEPTH = 512, 8  # as tested; larger networks would keep more in scratch than caches hold
MAX_LEVELS = 4  # a kernel over levels has the code of each, which takes seconds to compile


class Choice(NamedTuple):
    """Whether the kernels evaluate a network (``fused``), and if not, the ``reason``."""

    fused: bool
    reason: str


def mode() -> str:
    """Value of ``MPLICITS_KERNELS``; InputError if it is none of `MODES`."""
    said = os.environ.get(VARIABLE, "auto")
    if said not in MODES:
        raise InputError(f"{VARIABLE}={said!r} in the environment: expected one of {', '.join(MODES)}")
    return said


def choose(x: Tensor, *, width: int, depth: int, features: int = 0, levels: int = 1) -> Choice:
    """How a SIREN, or several in one launch, is evaluated at points ``x`` without a graph.

    ``width`` and ``depth`` are the largest of all; ``features`` is the number of outputs requested besides the value.
    """
    requested, reason = mode(), ""
    if requested == "off":
        reason = f"{VARIABLE}=off"
    elif requested != "interpret" and x.device.type != "cuda":
        reason = f"points on {x.device.type}; the kernels are for CUDA"
    elif x.dtype != torch.float32:
        reason = f"{x.dtype}; the kernels compute in float32"
    elif features:
        reason = "features are requested; the kernels have none"
    elif width > MAX_WIDTH or depth > MAX_DEPTH:
        reason = f"({width}, {depth}) is more than width {MAX_WIDTH} or depth {MAX_DEPTH}"
    elif levels > MAX_LEVELS:
        reason = f"{levels} levels are more than {MAX_LEVELS}; they are evaluated one by one"
    else:
        reason = obstacle(x.device, requested)
    return Choice(not reason, reason)


@functools.cache
def obstacle(device: torch.device, requested: str) -> str:
    """What the machine lacks for the kernels on ``device``; empty if nothing."""
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed; pip install 'mplicits[kernels]'"
    if requested == "interpret":
        return "" if os.environ.get("TRITON_INTERPRET") == "1" else "TRITON_INTERPRET=1 is not set"
    if os.environ.get("TRITON_INTERPRET") == "1":
        return "TRITON_INTERPRET=1 is set; only MPLICITS_KERNELS=interpret uses the interpreter"
    # Before 8.0 there are no tensor cores for float32 of any kind; Triton itself needs 7.0.
    if torch.cuda.get_device_capability(device) < (8, 0):
        return f"{torch.cuda.get_device_name(device)} is older than compute capability 8.0"
    return ""
