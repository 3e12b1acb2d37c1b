"""Two results of one evaluation, handed out by two calls: the second result waits for its call, and no longer."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

__all__ = ["Half", "PointMemo"]

Half = Literal["value", "gradient"]
Evaluate = Callable[[], tuple[Tensor, Tensor]]


@dataclass(frozen=True, eq=False)
class _Waiting:
    """The half of a pair that has not been asked for yet.

    Attributes:
        half: which one it is.
        result: the tensor; nobody outside has seen it.
        points: where it was evaluated.
        handed: the other half, which the caller has.
        module: whose it is.
        tensors: the module's parameters and buffers.
        state: what else it depends on, see `_state`.
    """

    half: Half
    result: Tensor
    points: weakref.ref[Tensor]
    handed: weakref.ref[Tensor]
    module: nn.Module
    tensors: tuple[Tensor, ...]
    state: tuple[object, ...]

    def fits(self, half: Half, points: Tensor, module: nn.Module, tensors: Sequence[Tensor]) -> bool:
        """Whether this is what is asked for, and nothing has changed since it was evaluated."""
        return (
            self.half == half
            and self.points() is points
            and self.module is module
            and len(self.tensors) == len(tensors)
            and all(old is new for old, new in zip(self.tensors, tensors, strict=True))
            and self.state == _state(points, module, tensors)
        )


class PointMemo:
    """Keeps one half of the last pair (value, gradient) until it is requested, at the very same points.

    Renderers like NeuS's call for the values and then, by another method, for the gradient at the same tensor. The
    first call evaluates both and returns its half; the second call gets the other one, once. What is kept is dropped

    - when it is returned, or anything else is requested;
    - when the points or the returned half die, so no graph lives longer than the caller's own tensors;
    - when a gradient flows back through the returned half: autograd may have freed the graph of both.

    It is used only for the same tensor object at the same version, with the same tensors of the module at the same
    versions, and in the same grad mode. Writing through ``.data`` or NumPy between the two calls is not noticed.
    """

    def __init__(self) -> None:
        self._waiting: _Waiting | None = None

    def __reduce__(self) -> tuple[type[PointMemo], tuple[()]]:
        """Copies and pickles of a module start with nothing remembered: weak references cannot be copied."""
        return PointMemo, ()

    def ask(self, half: Half, points: Tensor, module: nn.Module, evaluate: Evaluate) -> Tensor:
        """One half of ``evaluate()``, which returns (value, gradient) of ``module`` at ``points``."""
        waiting, self._waiting = self._waiting, None
        tensors = (*module.parameters(), *module.buffers())
        # Inference tensors have no version; nothing that depends on one is remembered.
        countable = not any(tensor.is_inference() for tensor in (points, *tensors))
        if countable and waiting is not None and waiting.fits(half, points, module, tensors):
            return waiting.result
        value, gradient = evaluate()
        handed, kept = (value, gradient) if half == "value" else (gradient, value)
        if countable:
            forget = _forgetter(weakref.ref(self))
            self._waiting = _Waiting(
                "gradient" if half == "value" else "value",
                kept,
                weakref.ref(points, forget),
                weakref.ref(handed, forget),
                module,
                tensors,
                _state(points, module, tensors),
            )
            if handed.requires_grad:
                kept_entry = weakref.ref(self._waiting)
                handed.register_hook(lambda _: self._forget(kept_entry()))
        return handed

    def _forget(self, waiting: _Waiting | None) -> None:
        if self._waiting is waiting:
            self._waiting = None


def _forgetter(memo: weakref.ref[PointMemo]) -> Callable[[object], None]:
    """Called when one of the tensors of what waits dies."""

    def forget(dead: object) -> None:
        owner = memo()
        waiting = None if owner is None else owner._waiting
        if owner is not None and waiting is not None and (dead is waiting.points or dead is waiting.handed):
            owner._forget(waiting)

    return forget


def _state(points: Tensor, module: nn.Module, tensors: Sequence[Tensor]) -> tuple[object, ...]:
    """What a result depends on beside the identity of the points, the module and its tensors."""
    # Assigning to `.data` replaces the memory and leaves the version as it was.
    places = tuple((tensor._version, tensor.data_ptr(), tensor.dtype) for tensor in (points, *tensors))
    trained = tuple(tensor.requires_grad for tensor in tensors)
    return (torch.is_grad_enabled(), torch.is_inference_mode_enabled(), module.training, trained, places)
