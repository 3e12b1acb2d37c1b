"""Whether a network is evaluated by the fused kernels or by PyTorch, and why not by the other.

They are used wherever they can be: float32 on CUDA, with Triton there (``pip install 'mplicits[kernels]'``; PyTorch's
builds for CUDA bring it). The environment variable ``MPLICITS_KERNELS`` says otherwise:

    auto       the kernels where they can be used (the default)
    off        PyTorch everywhere
    interpret  the kernels on the CPU too, by Triton's interpreter, which TRITON_INTERPRET=1 has to switch on: for tests

This file does not import Triton.
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
# What is tested; wider and deeper ones would run, and keep more in scratch than caches hold.
MAX_WIDTH, MAX_DEPTH = 512, 8
# A kernel over levels has the code of each; compiling takes some seconds for one of them.
MAX_LEVELS = 4


class Choice(NamedTuple):
    """How a network will be evaluated.

    Attributes:
        fused: whether the kernels evaluate it.
        reason: why PyTorch does; empty where the kernels do.
    """

    fused: bool
    reason: str


def mode() -> str:
    """What ``MPLICITS_KERNELS`` says.

    Raises:
        InputError: it says something else.
    """
    said = os.environ.get(VARIABLE, "auto")
    if said not in MODES:
        raise InputError(f"{VARIABLE}={said!r} in the environment: expected one of {', '.join(MODES)}")
    return said


def choose(x: Tensor, *, width: int, depth: int, features: int = 0, levels: int = 1) -> Choice:
    """How a SIREN, or several of them in one launch, is to be evaluated at points ``x`` without a graph.

    Args:
        x: the points.
        width: of its sine layers; of several, the largest.
        depth: how many it has; likewise.
        features: how many outputs beside the value are asked for.
        levels: how many SIRENs; only level by level where they are more than `MAX_LEVELS`.

    Raises:
        InputError: see `mode`.
    """
    asked = mode()
    reason = ""
    if asked == "off":
        reason = f"{VARIABLE}=off"
    elif asked != "interpret" and x.device.type != "cuda":
        reason = f"points on {x.device.type}; the kernels are for CUDA"
    elif x.dtype != torch.float32:
        reason = f"{x.dtype}; the kernels compute in float32"
    elif features:
        reason = "features are asked for; the kernels have none"
    elif width > MAX_WIDTH or depth > MAX_DEPTH:
        reason = f"({width}, {depth}) is more than width {MAX_WIDTH} or depth {MAX_DEPTH}"
    elif levels > MAX_LEVELS:
        reason = f"{levels} levels are more than {MAX_LEVELS}; they are evaluated one by one"
    else:
        reason = obstacle(x.device, asked)
    return Choice(not reason, reason)


@functools.cache
def obstacle(device: torch.device, asked: str) -> str:
    """What the machine lacks for the kernels on ``device``; empty if nothing."""
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed; pip install 'mplicits[kernels]'"
    if asked == "interpret":
        return "" if os.environ.get("TRITON_INTERPRET") == "1" else "TRITON_INTERPRET=1 is not set"
    if os.environ.get("TRITON_INTERPRET") == "1":
        return "TRITON_INTERPRET=1 is set; only MPLICITS_KERNELS=interpret uses the interpreter"
    # Before 8.0 there are no tensor cores for float32 of any kind; Triton itself needs 7.0.
    if torch.cuda.get_device_capability(device) < (8, 0):
        return f"{torch.cuda.get_device_name(device)} is older than compute capability 8.0"
    return ""
