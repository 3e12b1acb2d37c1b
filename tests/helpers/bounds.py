"""How far rounding may move a result: a bound from the field and its precision, and from no one machine."""

import copy
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)
Tensors = Tensor | Sequence[Tensor]

# Sensitivities are differences over a relative change of this size, in float64: far above rounding, far below a period.
CHANGE = 1e-6
DRAWS = 6
# The draws are random and the worst rounding is not: a result may be this many times as far off as they are.
MARGIN = 2.0
# Operations per coordinate of closed forms, whose inner products have three or four terms.
LEAST_TERMS = 16


def unit_roundoff(dtype: torch.dtype) -> float:
    """u, the largest relative error of one rounding: half the distance from 1 to the next number."""
    return torch.finfo(dtype).eps / 2


def rounding(field: Module, x: Tensor, evaluate: Callable[[Module, Tensor], Sequence[Tensor]]) -> list[Tensor]:
    """A bound on the rounding errors of results that are computed in the precision of ``x``, entry by entry.

    A sum of n products, in any order, is the exact sum for weights that differ by at most γ_n = n u / (1 − n u) each
    (Higham 2002, Sec. 3.1). Rounded points, biases and sines are much the same. So a network in floating point is an
    exact network of other weights, at another point. The effect is measured in float64. All parameters and coordinates
    are multiplied by 1 ± ε with random signs; the change of the result is divided by ε and multiplied by n u. A result
    that changes by little in all draws gets the median change of all results. Where a gate opens or a box has an edge
    within ε, the bound is as large as the jump.

    Returns:
        A bound for each entry of each result of ``evaluate(field, x)``, in float64, on the CPU.
    """
    exact = copy.deepcopy(field).cpu().double().requires_grad_(False)
    points = x.detach().cpu().double()
    terms = max([LEAST_TERMS, *(parameter.shape[-1] for parameter in exact.parameters() if parameter.ndim)])
    size = terms * unit_roundoff(x.dtype)
    generator = torch.Generator().manual_seed(0)

    def changed(tensor: Tensor) -> Tensor:
        signs = 1.0 - 2.0 * torch.randint(2, tensor.shape, generator=generator)
        return tensor * (1 + CHANGE * signs.to(tensor))

    expected = [result.detach() for result in evaluate(exact, points)]
    largest = [torch.zeros_like(result) for result in expected]
    for _ in range(DRAWS):
        other = copy.deepcopy(exact)
        for parameter in other.parameters():
            parameter.copy_(changed(parameter))
        found = evaluate(other, changed(points))
        for most, before, after in zip(largest, expected, found, strict=True):
            torch.maximum(most, (after.detach() - before).abs() / CHANGE, out=most)
    return [
        MARGIN * size * (torch.maximum(most, most.median()) + result.abs()) if most.numel() else most
        for most, result in zip(largest, expected, strict=True)
    ]


def assert_within(actual: Tensors, expected: Tensors, bound: float | Tensors, times: float = 1.0) -> None:
    """|actual − expected| ≤ times · bound, entry by entry; of sequences, one after the other."""
    if not isinstance(actual, Tensor):
        for found, other, most in zip(actual, expected, bound, strict=True):
            assert_within(found, other, most, times)
        return
    assert actual.shape == expected.shape
    difference = (actual.detach().double() - expected.detach().double()).abs().cpu()
    if difference.numel():
        worst = float((difference / (times * torch.as_tensor(bound)).cpu().clamp(min=1e-300)).max())
        assert worst <= 1, f"{worst:.3g} times as far apart as allowed; at most {float(difference.max()):.3g} apart"
