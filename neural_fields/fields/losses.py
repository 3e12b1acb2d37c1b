"""The terms of the paper's Eqs. 1 and 4 and of its texture loss, per point: callers choose the mean and the weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def data_loss(value: Tensor, target: Tensor | float = 0.0) -> Tensor:
    """``(f(x) − d)²`` with the known distance d, 0 on the surface. ``(...,)`` → ``(...,)``, squared field units."""
    return (value - target) ** 2


def normal_loss(gradient: Tensor, normal: Tensor, *, eps: float = 1e-8) -> Tensor:
    """``1 − ⟨∇f, N⟩ / |∇f|`` with unit normals N. ``(..., d)`` twice → ``(...,)`` in [0, 2].

    The paper writes ``1 − ⟨∇f, N⟩``, which rewards ever longer gradients until the eikonal term stops it;
    the cosine asks for the direction only and leaves the length to the eikonal term.
    """
    return 1 - torch.nn.functional.cosine_similarity(gradient, normal, dim=-1, eps=eps)


def pseudo_huber(loss: Tensor, scale: float) -> Tensor:
    """``s (√(1 + 2 c / s) − 1)`` of losses c that grow with a square: c itself where c ≪ s, ``√(2 s c)`` where c ≫ s.

    Of ``c = 1 − cos a`` it is a²/2 for small angles a and √s a for large ones, so that a few large ones, which nothing
    can be done about, do not outweigh many small ones (Charbonnier et al., "Two deterministic half-quadratic
    regularization algorithms for computed imaging", ICIP 1994).

    Args:
        loss: ``(...,)`` losses, 0 or more.
        scale: s, positive; infinity leaves the losses as they are.
    """
    return loss if scale == math.inf else scale * ((1 + 2 * loss / scale).sqrt() - 1)


def eikonal_loss(gradient: Tensor, *, eps: float = 1e-12) -> Tensor:
    """``(|∇f| − 1)²``. ``(..., d)`` → ``(...,)``.

    ``eps`` keeps the derivative of the length finite where the gradient vanishes.
    """
    return ((gradient.square().sum(dim=-1) + eps).sqrt() - 1) ** 2


def color_loss(color: Tensor, target: Tensor) -> Tensor:
    """``|g(x) − c|² / 3``, the first term of the texture loss 𝒯 (Sec. 3). ``(..., 3)`` twice → ``(...,)``."""
    return (color - target).square().mean(dim=-1)


def tangential_loss(derivative: Tensor, delta: Tensor | float) -> Tensor:
    """``δ² |∇g ∇f|² / 3``, the second term of 𝒯: the colour shall not change along the normals, only across them.

    The paper has no δ there; with it the term is a squared difference of colours, that between the middle of
    the band and its rim, so one weight serves bands of any width and shapes of any scale.

    Args:
        derivative: ``(..., 3)``, ∇g along ∇f.
        delta: half-width of the band, in units of the field.
    """
    return delta**2 * derivative.square().mean(dim=-1)
