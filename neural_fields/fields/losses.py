"""Loss terms of the paper's Eqs. 1 and 4 and of its texture loss, per point; callers take the mean and weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def data_loss(value: Tensor, target: Tensor | float = 0.0) -> Tensor:
    """``(f(x) − d)²`` with the known distance d, 0 on the surface. ``(...,)`` → ``(...,)``, squared field units."""
    return (value - target) ** 2


def normal_loss(gradient: Tensor, normal: Tensor, *, eps: float = 1e-8) -> Tensor:
    """``1 − ⟨∇f, N⟩ / |∇f|`` with unit normals N. ``(..., d)`` twice → ``(...,)`` in [0, 2].

    The paper has no division by |∇f|, so its term also rewards longer gradients; the cosine leaves length to
    `eikonal_loss`.
    """
    return 1 - torch.nn.functional.cosine_similarity(gradient, normal, dim=-1, eps=eps)


def pseudo_huber(loss: Tensor, scale: float) -> Tensor:
    """``s (√(1 + 2 c / s) − 1)`` of losses c ``(...,)`` ≥ 0: c where c ≪ s or s = ∞, ``√(2 s c)`` where c ≫ s.

    Few large losses then do not outweigh many small ones (Charbonnier et al., "Two deterministic half-quadratic
    regularization algorithms for computed imaging", ICIP 1994).
    """
    return loss if scale == math.inf else scale * ((1 + 2 * loss / scale).sqrt() - 1)


def eikonal_loss(gradient: Tensor, *, eps: float = 1e-12) -> Tensor:
    """``(|∇f| − 1)²``. ``(..., d)`` → ``(...,)``. ``eps`` keeps its derivative finite where the gradient vanishes."""
    return ((gradient.square().sum(dim=-1) + eps).sqrt() - 1) ** 2


def color_loss(color: Tensor, target: Tensor) -> Tensor:
    """``|g(x) − c|² / 3``, the first term of the texture loss 𝒯 (Sec. 3). ``(..., 3)`` twice → ``(...,)``."""
    return (color - target).square().mean(dim=-1)


def tangential_loss(derivative: Tensor, delta: Tensor | float) -> Tensor:
    """``δ² |∇g ∇f|² / 3``, the second term of 𝒯: colour is constant along normals.

    ``derivative`` ``(..., 3)`` is ∇g along ∇f. The paper has no δ (half-width of the band, field units). With it the
    term is a squared colour difference between the middle of the band and its rim, so one weight serves bands of any
    width.
    """
    return delta**2 * derivative.square().mean(dim=-1)
