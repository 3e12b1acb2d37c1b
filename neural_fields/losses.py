"""The terms of the paper's Eqs. 1 and 4, per point: callers choose the mean and the weights."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["data_loss", "eikonal_loss", "normal_loss"]


def data_loss(value: Tensor, target: Tensor | float = 0.0) -> Tensor:
    """``(f(x) − d)²`` with the known distance d, 0 on the surface. ``(...,)`` → ``(...,)``, squared field units."""
    return (value - target) ** 2


def normal_loss(gradient: Tensor, normal: Tensor, *, eps: float = 1e-8) -> Tensor:
    """``1 − ⟨∇f, N⟩ / |∇f|`` with unit normals N. ``(..., d)`` twice → ``(...,)`` in [0, 2].

    The paper writes ``1 − ⟨∇f, N⟩``, which rewards ever longer gradients until the eikonal term stops it;
    the cosine asks for the direction only and leaves the length to the eikonal term.
    """
    return 1 - torch.nn.functional.cosine_similarity(gradient, normal, dim=-1, eps=eps)


def eikonal_loss(gradient: Tensor, *, eps: float = 1e-12) -> Tensor:
    """``(|∇f| − 1)²``. ``(..., d)`` → ``(...,)``.

    ``eps`` keeps the derivative of the length finite where the gradient vanishes.
    """
    return ((gradient.square().sum(dim=-1) + eps).sqrt() - 1) ** 2
