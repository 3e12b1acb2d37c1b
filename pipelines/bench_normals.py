"""``mplicits bench normals``: what a gradient costs, four ways, beside the machine's matrix rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from ..neural_fields import Siren
from .run.machine import best_seconds, format_table, sgemm_rate

__all__ = ["NormalsRow", "bench_normals", "format_normals", "printed_jet", "tangent_jet"]

SIZES = ((128, 2), (256, 2), (400, 2), (256, 3))


@dataclass(frozen=True)
class NormalsRow:
    """Seconds for one network on one set of points; ``gemm`` is the jet's matrix work at the machine's own rate."""

    width: int
    depth: int
    points: int
    value: float
    jet: float
    printed: float
    tangents: float
    autograd: float
    gemm: float
    largest_difference: float

    def as_dict(self) -> dict[str, float]:
        """All figures, for JSON."""
        return asdict(self)


def bench_normals(
    *,
    points: int = 262_144,
    sizes: tuple[tuple[int, int], ...] = SIZES,
    repeats: int = 3,
    device: str = "cpu",
    seed: int = 0,
) -> list[NormalsRow]:
    """Time value, jet, the paper's Algorithm 1 and torch.autograd on the same random points and weights.

    Algorithm 1 runs in the same blocks and buffers as the jet, so that they differ in method only: once as the
    paper prints it, where each of the three asynchronous passes makes its own activations, and once with
    the activations shared, the best a forward method can do on one processor. Autograd runs as users run
    it, on all points at once.
    """
    generator = torch.Generator().manual_seed(seed)
    x = (2 * torch.rand(points, 3, generator=generator) - 1).to(device)
    rows = []
    for width, depth in sizes:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Siren(width, depth).to(device).requires_grad_(False)
        with torch.inference_mode():
            value = best_seconds(lambda n=network: n.value(x), repeats=repeats)
            jet = best_seconds(lambda n=network: n.jet(x), repeats=repeats)
            printed = best_seconds(lambda n=network: printed_jet(n, x), repeats=repeats)
            tangents = best_seconds(lambda n=network: tangent_jet(n, x), repeats=repeats)
        autograd = best_seconds(lambda n=network: _autograd_jet(n, x), repeats=repeats)
        flops = 2 * 2 * points * ((depth - 1) * width**2 + 4 * width)
        rate = sgemm_rate(width, rows=network.block_rows(x.device), device=x.device)
        rows.append(
            NormalsRow(
                width,
                depth,
                points,
                value,
                jet,
                printed,
                tangents,
                autograd,
                flops / rate,
                _largest_difference(network, x[:4096]),
            )
        )
    return rows


def format_normals(rows: list[NormalsRow]) -> str:
    """The table that the command prints."""
    header = (
        *("network", "value", "jet", "Alg. 1", "shared", "autograd"),
        *("jet/value", "Alg.1/jet", "shared/jet", "autograd/jet", "of GEMM peak"),
    )
    cells = [
        (
            f"({r.width},{r.depth})",
            *(f"{1e3 * t:.0f} ms" for t in (r.value, r.jet, r.printed, r.tangents, r.autograd)),
            *(f"{a / b:.2f}" for a, b in ((r.jet, r.value), (r.printed, r.jet), (r.tangents, r.jet))),
            f"{r.autograd / r.jet:.2f}",
            f"{100 * r.gemm / r.jet:.0f} %",
        )
        for r in rows
    ]
    notes = (
        f"{rows[0].points:,} points, {torch.get_num_threads()} threads, float32; value, jet and both tangent methods "
        "in the same blocks.\nAlg. 1: as the paper prints it: three passes with their own activations. shared: the "
        "three tangents on one set of activations.\nautograd: torch.autograd.grad on all points at once. of GEMM "
        "peak: the jet's matrix products at the measured SGEMM rate, over its time.\n"
        f"largest difference between the gradients: {max(r.largest_difference for r in rows):.1e}"
    )
    return f"{format_table(header, cells)}\n{notes}"


@torch.inference_mode()
def tangent_jet(network: Siren, x: Tensor) -> tuple[Tensor, Tensor]:
    """Value ``(N,)`` and gradient ``(N, 3)`` from three tangents pushed forward on one set of activations.

    Algorithm 1 without its repetitions: four passes' worth of matrix products, where the jet has two. Blocked like
    `Siren.jet`, with every temporary in a buffer of its own.
    """
    parameters = network.folded()
    weights, biases = parameters[0:-2:2], parameters[1:-2:2]
    value, gradient = x.new_empty(len(x)), torch.empty_like(x)
    block = network.block_rows(x.device)
    buffers = [x.new_empty(block, network.width) for _ in range(6)]
    for start in range(0, len(x), block):
        part = x[start : start + block]
        sine, phase, cosine, *tangents = [buffer[: len(part)] for buffer in buffers]
        torch.addmm(biases[0], part, weights[0].t(), out=phase)
        torch.cos(phase, out=cosine)
        torch.sin(phase, out=sine)
        for axis, tangent in enumerate(tangents):
            torch.mul(cosine, weights[0][:, axis], out=tangent)
        for weight, bias in zip(weights[1:], biases[1:], strict=True):
            torch.addmm(bias, sine, weight.t(), out=phase)
            torch.cos(phase, out=cosine)
            torch.sin(phase, out=sine)
            for index, tangent in enumerate(tangents):
                # The phase is spent; its buffer takes the product, and the tangent's old buffer the next phase.
                product = torch.mm(tangent, weight.t(), out=phase).mul_(cosine)
                phase, tangents[index] = tangent, product
        torch.addmv(parameters[-1], sine, parameters[-2][0], out=value[start : start + block])
        for axis, tangent in enumerate(tangents):
            gradient[start : start + block, axis] = tangent @ parameters[-2][0]
    return value, gradient


@torch.inference_mode()
def printed_jet(network: Siren, x: Tensor) -> tuple[Tensor, Tensor]:
    """The paper's Algorithm 1 as printed: value ``(N,)`` and gradient ``(N, 3)``, one pass for each coordinate."""
    parameters = network.folded()
    weights, biases = parameters[0:-2:2], parameters[1:-2:2]
    value, gradient = x.new_empty(len(x)), torch.empty_like(x)
    block = network.block_rows(x.device)
    buffers = [x.new_empty(block, network.width) for _ in range(4)]
    for start in range(0, len(x), block):
        part = x[start : start + block]
        for axis in range(3):
            sine, phase, tangent, cosine = [buffer[: len(part)] for buffer in buffers]
            torch.addmm(biases[0], part, weights[0].t(), out=phase)
            torch.mul(torch.cos(phase, out=cosine), weights[0][:, axis], out=tangent)
            torch.sin(phase, out=sine)
            for weight, bias in zip(weights[1:], biases[1:], strict=True):
                torch.addmm(bias, sine, weight.t(), out=phase)
                torch.cos(phase, out=cosine)
                torch.sin(phase, out=sine)
                tangent, phase = torch.mm(tangent, weight.t(), out=phase).mul_(cosine), tangent
            gradient[start : start + block, axis] = tangent @ parameters[-2][0]
            torch.addmv(parameters[-1], sine, parameters[-2][0], out=value[start : start + block])
    return value, gradient


def _autograd_jet(network: Siren, x: Tensor) -> tuple[Tensor, Tensor]:
    """What one writes without this package: the forward pass in torch operations, then torch.autograd."""
    points = x.clone().requires_grad_()
    h = points
    for layer in network.layers:
        h = torch.sin(network.omega * layer(h))
    value = network.output(h)[:, 0]
    return value.detach(), torch.autograd.grad(value.sum(), points)[0]


def _largest_difference(network: Siren, x: Tensor) -> float:
    methods: tuple[Callable[[Siren, Tensor], tuple[Tensor, Tensor]], ...] = (printed_jet, tangent_jet, _autograd_jet)
    jet = network.jet(x)
    return max(float((method(network, x)[1] - jet.gradient).abs().max()) for method in methods)
