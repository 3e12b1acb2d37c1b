"""``mplicits bench normals``: what a gradient costs, four ways, beside the machine's matrix rate.

``mplicits bench mesh``: adaptive extraction beside the paper's scheme and a dense SIREN, in one run.

Counting how often each level of a field is evaluated.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from skimage.measure import marching_cubes
from torch import Tensor

from ...neural_fields import Field, Jet, MultiscaleSDF, Siren, levels_of, load_field, save_field
from ...neural_fields.meshing import DEFAULT_BOUNDS, extract_mesh
from ..run.folder import find_field
from ..run.machine import best_seconds, format_table, peak_memory, sgemm_rate

__all__ = [
    "Counted",
    "MeshBench",
    "MeshRow",
    "NormalsRow",
    "bench_mesh",
    "bench_normals",
    "counted",
    "evaluate_slabs",
    "format_bench_mesh",
    "format_normals",
    "printed_jet",
    "tangent_jet",
]

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


PAPER, DENSE = "level 0 on every vertex (paper)", "dense SIREN (256,4)"
SAMPLED_SHARE = 1 / 32


@dataclass(frozen=True)
class MeshRow:
    """One extraction, in a process of its own.

    Attributes:
        method: what was run.
        resolution: cells along each side of the box.
        seconds: wall time of evaluation and triangles, without normals; extrapolated where ``share`` < 1.
        normals: seconds more for analytic normals; None where there are none.
        evaluations: rows that the network of each level evaluated, without normals.
        vertices: of the mesh; 0 where only the evaluation was timed.
        peak: most memory the process held at any time, Python and libraries included, in bytes; None where the system
            does not keep it.
        share: fraction of the lattice that was really evaluated.
    """

    method: str
    resolution: int
    seconds: float
    normals: float | None
    evaluations: tuple[int, ...]
    vertices: int
    peak: int | None
    share: float = 1.0


@dataclass(frozen=True)
class MeshBench:
    """All rows, and how far our vertices are from the nearest ones of the paper's scheme, in cells.

    Attributes:
        rows: adaptive ones first, then the peers at the reference resolution.
        reference: resolution at which methods are compared.
        mean_distance: mean over our vertices and over the peer's, each to the nearest of the other.
        max_distance: the largest of them.
        limit: a line about the machine's limit, printed as it is.
    """

    rows: tuple[MeshRow, ...]
    reference: int
    mean_distance: float
    max_distance: float
    limit: str = ""


def bench_mesh(
    source: str | Path | Field,
    *,
    resolutions: Sequence[int] = (256, 512, 1024),
    reference: int = 512,
    full: bool = False,
    limit: str = "",
    report: Callable[[str], None] | None = None,
) -> MeshBench:
    """Time ours at each of ``resolutions``, and the peers at ``reference``, over the same box.

    The paper's scheme evaluates level 0 at every lattice point and finer levels in their bands, then runs dense
    marching cubes (scikit-image). The dense peer is one (256,4) SIREN with random weights, of which only the
    evaluation is timed; unless ``full``, on every 32nd slab of the lattice, and extrapolated linearly.
    Every row runs in a fresh process, so that its peak memory is its own.

    Args:
        source: a run, a .safetensors file or a field.
        resolutions: where ours is timed.
        reference: where ours is compared; added to ``resolutions`` if it is not among them.
        full: whether the dense peer evaluates the whole lattice.
        limit: text about the machine's limit to print with the table.
        report: told what is being run.

    Raises:
        InputError: ``source`` is no run and no field's file.
    """
    say = report or (lambda _: None)
    with tempfile.TemporaryDirectory() as scratch:
        if isinstance(source, Field):
            path = Path(scratch) / "field.safetensors"
            save_field(path, source)
        else:
            path = find_field(source)
        rows = []
        for resolution in sorted({*resolutions, reference}):
            say(f"adaptive at {resolution}³")
            keep = Path(scratch) / "ours.npy" if resolution == reference else None
            rows.append(_alone(_adaptive, path, resolution, keep))
        say(f"{PAPER} at {reference}³")
        rows.append(_alone(_paper, path, reference, Path(scratch) / "paper.npy"))
        say(f"{DENSE} at {reference}³")
        rows.append(_alone(_dense, reference, 1.0 if full else SAMPLED_SHARE))
        mean, largest = _distances(np.load(Path(scratch) / "ours.npy"), np.load(Path(scratch) / "paper.npy"))
    cell = _step(reference)
    return MeshBench(tuple(rows), reference, mean / cell, largest / cell, limit)


def format_bench_mesh(bench: MeshBench) -> str:
    """The table, the growth per doubling, the ratios, and whether both found the same surface."""
    table = [_cells(row) for row in bench.rows]
    header = ("method", "cells", "seconds", "+ normals", "evaluations per level", "vertices", "peak memory")
    lines = [format_table(header, table), ""]
    adaptive = [row for row in bench.rows if row.method == "adaptive"]
    for small, large in itertools.pairwise(adaptive):
        growth = f"×{large.seconds / small.seconds:.2f} in time"
        growth += f", ×{sum(large.evaluations) / sum(small.evaluations):.2f} in evaluations"
        lines.append(f"{small.resolution}³ → {large.resolution}³: {growth}")
    ours = next(row for row in adaptive if row.resolution == bench.reference)
    for peer in bench.rows[len(adaptive) :]:
        how = "" if peer.share == 1 else f" (timed on {peer.share:.1%} of the slabs, extrapolated linearly)"
        lines.append(f"{peer.seconds / ours.seconds:.1f}× faster than {peer.method} at {bench.reference}³{how}")
    lines.append(
        f"vertices of ours and the paper's scheme, to the nearest of the other: mean {bench.mean_distance:.4f} cells, "
        f"max {bench.max_distance:.3f} cells"
    )
    return "\n".join([*lines, bench.limit] if bench.limit else lines)


def _cells(row: MeshRow) -> tuple[str, ...]:
    return (
        row.method,
        f"{row.resolution}³",
        f"{row.seconds:.2f}" if row.share == 1 else f"~{row.seconds:.0f}",
        "" if row.normals is None else f"{row.normals:.2f}",
        " + ".join(f"{count / 1e6:.2f} M" for count in row.evaluations),
        f"{row.vertices:,}" if row.vertices else "",
        "" if row.peak is None else f"{row.peak / 2**20:.0f} MiB",
    )


def _alone(work: Callable[..., MeshRow], *arguments: object) -> MeshRow:
    """Run ``work`` in a fresh process with as many threads as here."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_with_threads, torch.get_num_threads(), work, *arguments).result()


def _with_threads(threads: int, work: Callable[..., MeshRow], *arguments: object) -> MeshRow:
    torch.set_num_threads(threads)
    return work(*arguments)


def _adaptive(path: Path, resolution: int, keep: Path | None) -> MeshRow:
    field, levels = counted(load_field(path).field)
    start = time.perf_counter()
    mesh = extract_mesh(field, resolution=resolution)
    seconds = time.perf_counter() - start
    assert mesh.stats is not None
    normals = mesh.stats.seconds["normals"]
    counts = tuple(level.values for level in levels)
    if keep is not None:
        np.save(keep, mesh.vertices)
    return MeshRow("adaptive", resolution, seconds - normals, normals, counts, len(mesh.vertices), peak_memory())


def _paper(path: Path, resolution: int, keep: Path) -> MeshRow:
    field, levels = counted(load_field(path).field)
    start = time.perf_counter()
    values = np.empty((resolution + 1,) * 3, np.float32)
    evaluate_slabs(field, values, range(resolution + 1))
    step = _step(resolution)
    vertices = marching_cubes(values, 0.0, spacing=(step, step, step))[0] + np.asarray(DEFAULT_BOUNDS[0])
    seconds = time.perf_counter() - start
    np.save(keep, vertices)
    return MeshRow(
        PAPER, resolution, seconds, None, tuple(level.values for level in levels), len(vertices), peak_memory()
    )


def _dense(resolution: int, share: float) -> MeshRow:
    torch.manual_seed(0)
    field = Siren(256, 4).requires_grad_(False)
    slabs = range(0, resolution + 1, round(1 / share))
    start = time.perf_counter()
    evaluate_slabs(field, np.empty((1, resolution + 1, resolution + 1), np.float32), slabs)
    done = len(slabs) / (resolution + 1)
    seconds = (time.perf_counter() - start) / done
    return MeshRow(DENSE, resolution, seconds, None, ((resolution + 1) ** 3,), 0, peak_memory(), done)


@torch.inference_mode()
def evaluate_slabs(field: Field, values: NDArray[np.float32], slabs: Sequence[int], *, level: int = -1) -> None:
    """Fill ``values`` with the field on some planes of constant x; with room for one plane only, overwrite it."""
    count = values.shape[1]
    axis = torch.arange(count) * _step(count - 1) + DEFAULT_BOUNDS[0][0]
    plane = torch.stack(torch.meshgrid(axis, axis, axis[:1], indexing="ij"), -1).reshape(-1, 3)[:, [2, 0, 1]]
    for slab in slabs:
        plane[:, 0] = axis[slab]
        values[slab % len(values)] = field.value(plane, level=level).numpy().reshape(count, count)


def _step(resolution: int) -> float:
    return (DEFAULT_BOUNDS[1][0] - DEFAULT_BOUNDS[0][0]) / resolution


def _distances(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, float]:
    """Mean and maximum over both sets of the distance to the nearest point of the other."""
    distances = np.concatenate((KDTree(theirs).query(ours)[0], KDTree(ours).query(theirs)[0]))
    return float(distances.mean()), float(distances.max())


class Counted(Field):
    """A level that counts the rows it evaluates.

    Attributes:
        values: rows evaluated without their gradient.
        jets: rows evaluated with it.
    """

    def __init__(self, inner: Field) -> None:
        super().__init__()
        self.inner, self.in_dim, self.num_levels = inner, inner.in_dim, inner.num_levels
        self.values = self.jets = 0
        self.register_buffer("deltas", inner.deltas)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.values += x.shape[:-1].numel()
        return self.inner.value(x, level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        self.jets += x.shape[:-1].numel()
        return self.inner.jet(x, level=level)


def counted(field: Field) -> tuple[Field, list[Counted]]:
    """The field with counters in the place of its levels; the levels themselves are shared, not copied."""
    levels = [Counted(level) for level in levels_of(field)]
    if not isinstance(field, MultiscaleSDF):
        return levels[0], levels
    return MultiscaleSDF(levels[0], levels[1:], field.deltas, taper=field.taper), levels
