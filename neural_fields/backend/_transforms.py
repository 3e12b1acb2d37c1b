"""Whether `torch.func.vmap` or `torch.compile` traces a call; neither takes writing into buffers."""

from __future__ import annotations

import torch

__all__ = ["is_traced", "under_vmap"]


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
