"""Benchmarks ``normals`` and ``mesh``: what gradients and extraction cost, beside their peers.

Both count: seconds of the same work in several ways, and how often each level of a field is evaluated.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mplicits.neural_fields import Field, InputError, Jet, MultiscaleSDF, Siren, load_field
from mplicits.neural_fields.backend.devices import (
    best_seconds,
    one_thread,
    over_blocks,
    peak_memory,
    sgemm_rate,
    split_operations,
)
from mplicits.neural_fields.meshing.extract import DEFAULT_BOUNDS, extract_mesh
from mplicits.neural_fields.networks.multiscale import levels_of
from mplicits.neural_fields.networks.siren import block_rows
from mplicits.pipelines.training.folder import find_field
from mplicits.pipelines.training.trainer import seeded
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from ..harness.benchmark import Benchmark, Part
from ..harness.jobs import Context
from ..harness.tables import Column, Figure, Table, tabulated

SIZES = ((128, 2), (256, 2), (400, 2), (256, 3))


@contextmanager
def operations_split() -> Iterator[None]:
    """Blocks in turn, each operation split among all threads."""
    token = split_operations.set(True)
    try:
        yield
    finally:
        split_operations.reset(token)


@dataclass(frozen=True)
class NormalsRow:
    """Seconds for one network on one set of points.

    Attributes:
        gemm: of the jet's matrix work, at the machine's own rate.
        value_split: of the value with every operation of a block split among all threads.
        jet_split: the same of the jet.
        value_one: of the value on one thread.
        jet_one: of the jet on one thread.
        threads: that the others used.
    """

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
    value_split: float
    jet_split: float
    value_one: float
    jet_one: float
    threads: int


@dataclass(frozen=True, kw_only=True)
class NormalsBench(Benchmark[NormalsRow]):
    """Value, jet, the paper's Algorithm 1 and torch.autograd, timed on the same random points and weights.

    Algorithm 1 runs in the same blocks and buffers as the jet, so that they differ in method only. It runs once as
    the paper prints it, where each of the three asynchronous passes makes its own activations. It also runs with
    the activations shared, the best a forward method can do on one processor. Autograd runs as users run
    it, on all points at once.

    Attributes:
        points: how many.
        sizes: widths and depths of the networks.
        repeats: runs of each measurement; the best counts, or beside busy processes the median.
        seed: of points and weights.
        busy: processes that multiply matrices meanwhile, as others do on a machine that is shared.
    """

    name = "normals"
    source = "what a gradient costs, four ways"
    row = NormalsRow
    apart = ("sizes",)
    points: int = 262_144
    sizes: tuple[tuple[int, int], ...] = SIZES
    repeats: int = 3
    seed: int = 0
    busy: int = 0

    def jobs(self) -> list[Part]:
        """One for each network."""
        return [Part(self.name, f"({w},{d})", options=(("width", w), ("depth", d))) for w, d in self.sizes]

    def measure(self, job: Part, context: Context) -> list[NormalsRow]:
        """See `Benchmark.measure`."""
        with _busy(self.busy):
            return [self.timed(**job.parameters)]

    def timed(self, width: int, depth: int) -> NormalsRow:
        """The row of one network."""
        generator = torch.Generator().manual_seed(self.seed)
        x = (2 * torch.rand(self.points, 3, generator=generator) - 1).to(self.device)
        with seeded(self.seed):
            network = Siren(width, depth).to(self.device).requires_grad_(False)

        def seconds(way: Callable[[Tensor], object]) -> float:
            return best_seconds(lambda: way(x), repeats=self.repeats, median=self.busy > 0)

        threads = torch.get_num_threads()
        with torch.inference_mode():
            value, jet = seconds(network.value), seconds(network.jet)
            with operations_split():
                value_split, jet_split = seconds(network.value), seconds(network.jet)
            with one_thread():
                value_one, jet_one = seconds(network.value), seconds(network.jet)
            printed, tangents = (seconds(partial(way, network)) for way in (printed_jet, tangent_jet))
        autograd = seconds(partial(_autograd_jet, network))
        flops = 2 * 2 * self.points * ((depth - 1) * width**2 + 4 * width)
        gemm = flops / sgemm_rate(width, rows=block_rows(width, x.device), device=x.device)
        apart = _largest_difference(network, x[:4096])
        return NormalsRow(
            width,
            depth,
            self.points,
            value=value,
            jet=jet,
            printed=printed,
            tangents=tangents,
            autograd=autograd,
            gemm=gemm,
            largest_difference=apart,
            value_split=value_split,
            jet_split=jet_split,
            value_one=value_one,
            jet_one=jet_one,
            threads=threads,
        )

    def tables(self, rows: Sequence[NormalsRow], *, sgemm: float) -> tuple[Table, ...]:
        """See `Benchmark.tables`."""
        figures: list[Figure[NormalsRow]] = [
            (Column("value, ms", ".0f"), lambda r: 1e3 * r.value),
            (Column("jet, ms", ".0f"), lambda r: 1e3 * r.jet),
            (Column("Alg. 1, ms", ".0f"), lambda r: 1e3 * r.printed),
            (Column("shared, ms", ".0f"), lambda r: 1e3 * r.tangents),
            (Column("autograd, ms", ".0f"), lambda r: 1e3 * r.autograd),
            (Column("jet/value", ".2f"), lambda r: r.jet / r.value),
            (Column("Alg.1/jet", ".2f"), lambda r: r.printed / r.jet),
            (Column("shared/jet", ".2f"), lambda r: r.tangents / r.jet),
            (Column("autograd/jet", ".2f"), lambda r: r.autograd / r.jet),
            (Column("of GEMM peak", ".0%"), lambda r: r.gemm / r.jet),
        ]
        notes = (
            f"{rows[0].points:,} points, float32; value, jet and both tangent methods in the same blocks.",
            "Alg. 1: as the paper prints it: three passes with their own activations. shared: the three tangents on "
            "one set of activations.",
            "autograd: torch.autograd.grad on all points at once. of GEMM peak: the jet's matrix products at the "
            "measured SGEMM rate, over its time.",
            f"largest difference between the gradients: {max(r.largest_difference for r in rows):.1e}",
        )
        items = [(f"({r.width},{r.depth})", r) for r in rows]
        cores: list[Figure[NormalsRow]] = [
            (Column("value, ns", ".0f"), lambda r: 1e9 * r.value / r.points),
            (Column("split/value", ".2f"), lambda r: r.value_split / r.value),
            (Column("of 1 thread's", ".0%"), lambda r: r.value_one / (r.threads * r.value)),
            (Column("jet, ns", ".0f"), lambda r: 1e9 * r.jet / r.points),
            (Column("split/jet", ".2f"), lambda r: r.jet_split / r.jet),
            (Column("of 1 thread's", ".0%"), lambda r: r.jet_one / (r.threads * r.jet)),
        ]
        beside = f", {self.busy} other process(es) multiplying matrices (medians)" if self.busy else ""
        about = (
            f"time of a point on {rows[0].threads} threads{beside}. split: every operation of a block shared by all "
            "threads, over blocks that belong to one thread each.",
            "of 1 thread's: work of each thread in a second, of what a single one does.",
        )
        return (
            tabulated(self.name, "What a gradient costs", "network", figures, items, notes=notes),
            tabulated(f"{self.name}-threads", "What threads do", "network", cores, items, notes=about),
        )


@torch.inference_mode()
def tangent_jet(network: Siren, x: Tensor) -> tuple[Tensor, Tensor]:
    """Value ``(N,)`` and gradient ``(N, 3)`` from three tangents pushed forward on one set of activations.

    Algorithm 1 without its repetitions: four passes' worth of matrix products, where the jet has two. Blocked like
    `Siren.jet`, with every temporary in a buffer of its own.
    """
    parameters = network.folded()
    weights, biases = parameters[0:-2:2], parameters[1:-2:2]
    value, gradient = x.new_empty(len(x)), torch.empty_like(x)

    def step(buffers: Sequence[Tensor], part: slice) -> None:
        sine, phase, cosine, *tangents = [buffer[: part.stop - part.start] for buffer in buffers]
        torch.addmm(biases[0], x[part], weights[0].t(), out=phase)
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
        torch.addmv(parameters[-1], sine, parameters[-2][0], out=value[part])
        for axis, tangent in enumerate(tangents):
            gradient[part, axis] = tangent @ parameters[-2][0]

    _over_blocks(network, x, step, buffers=6)
    return value, gradient


@torch.inference_mode()
def printed_jet(network: Siren, x: Tensor) -> tuple[Tensor, Tensor]:
    """The paper's Algorithm 1 as printed: value ``(N,)`` and gradient ``(N, 3)``, one pass for each coordinate."""
    parameters = network.folded()
    weights, biases = parameters[0:-2:2], parameters[1:-2:2]
    value, gradient = x.new_empty(len(x)), torch.empty_like(x)

    def step(buffers: Sequence[Tensor], part: slice) -> None:
        for axis in range(3):
            sine, phase, tangent, cosine = [buffer[: part.stop - part.start] for buffer in buffers]
            torch.addmm(biases[0], x[part], weights[0].t(), out=phase)
            torch.mul(torch.cos(phase, out=cosine), weights[0][:, axis], out=tangent)
            torch.sin(phase, out=sine)
            for weight, bias in zip(weights[1:], biases[1:], strict=True):
                torch.addmm(bias, sine, weight.t(), out=phase)
                torch.cos(phase, out=cosine)
                torch.sin(phase, out=sine)
                tangent, phase = torch.mm(tangent, weight.t(), out=phase).mul_(cosine), tangent
            gradient[part, axis] = tangent @ parameters[-2][0]
            torch.addmv(parameters[-1], sine, parameters[-2][0], out=value[part])

    _over_blocks(network, x, step, buffers=4)
    return value, gradient


def _over_blocks(network: Siren, x: Tensor, step: Callable[[Sequence[Tensor], slice], None], *, buffers: int) -> None:
    """Run a step with buffers of its thread over the blocks that the network's own jet has."""

    def prepare(rows: int) -> Callable[[slice], None]:
        return partial(step, [x.new_empty(rows, network.width) for _ in range(buffers)])

    over_blocks(len(x), block_rows(network.width, x.device), prepare, like=x)


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """Keep ``count`` processes multiplying matrices, each on one thread, until the end of the block."""
    context = get_context("spawn")
    begun = context.Barrier(count + 1)
    processes = [context.Process(target=_multiply, args=(begun,), daemon=True) for _ in range(count)]
    for process in processes:
        process.start()
    begun.wait()
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


def _multiply(begun: Barrier) -> None:
    torch.set_num_threads(1)
    matrix = torch.eye(512)
    begun.wait()
    while True:
        torch.mm(matrix, matrix)


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


ADAPTIVE, PAPER, DENSE = "adaptive", "level 0 on every vertex (paper)", "dense SIREN (256,4)"
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
        mean_distance: of the paper's scheme: mean over its vertices and over ours, each to the nearest of the other, in
            cells.
        max_distance: the largest of them.
    """

    method: str
    resolution: int
    seconds: float
    normals: float | None
    evaluations: tuple[int, ...]
    vertices: int
    peak: int | None
    share: float = 1.0
    mean_distance: float | None = None
    max_distance: float | None = None


@dataclass(frozen=True, kw_only=True)
class MeshBench(Benchmark[MeshRow]):
    """Ours at each of ``resolutions``, and its peers at ``reference``, over the same box.

    The paper's scheme evaluates level 0 at every lattice point and finer levels in their bands, then runs dense
    marching cubes (scikit-image). The dense peer is one (256,4) SIREN with random weights. Only
    its evaluation is timed; unless ``full``, on every 32nd slab of the lattice, and extrapolated linearly.
    Every row is made in a fresh process, so that its peak memory is its own.

    Attributes:
        run_file: a run, or a .safetensors file.
        resolutions: where ours is timed.
        reference: where ours is compared; added to ``resolutions`` if it is not among them.
        full: whether the dense peer evaluates the whole lattice.
    """

    name = "mesh"
    source = "what extraction costs: adaptive, the paper's scheme, dense"
    row = MeshRow
    apart = ("run_file", "resolutions", "reference", "full")
    run_file: str | Path
    resolutions: Sequence[int] = (256, 512, 1024)
    reference: int = 512
    full: bool = False

    def jobs(self) -> list[Part]:
        """Every row is one; see `Benchmark.jobs`."""
        file = find_field(self.run_file)
        peer_mesher()  # it is there, before the long work
        wanted = [(ADAPTIVE, resolution, 1.0) for resolution in sorted({*self.resolutions, self.reference})]
        wanted += [(PAPER, self.reference, 1.0), (DENSE, self.reference, 1.0 if self.full else SAMPLED_SHARE)]
        return [
            Part(self.name, f"{method} at {cells}³", (file,), (("scheme", method), ("cells", cells), ("share", share)))
            for method, cells, share in wanted
        ]

    def measure(self, job: Part, context: Context) -> list[MeshRow]:
        """See `Benchmark.measure`; the paper's scheme is compared with the adaptive mesh of the same resolution."""
        (file,), (scheme, cells, share) = job.files, job.parameters.values()
        if scheme == DENSE:
            return [_alone(_dense, cells, share)]
        keep = _vertices(context)
        row = _alone(_adaptive if scheme == ADAPTIVE else _paper, file, cells, keep)
        if scheme == ADAPTIVE:
            return [row]
        ours = next(one for one in self.jobs() if dict(one.options) == {**job.parameters, "scheme": ADAPTIVE})
        assert context.first is not None
        mean, largest = _distances(np.load(_vertices(context.first(ours))), np.load(keep))
        return [replace(row, mean_distance=mean / _step(cells), max_distance=largest / _step(cells))]

    def tables(self, rows: Sequence[MeshRow], *, sgemm: float) -> tuple[Table, ...]:
        """The figures, the growth per doubling, the ratios, and whether both found the same surface."""
        figures: list[Figure[MeshRow]] = [
            (Column("cells", "s"), lambda r: f"{r.resolution}³"),
            (Column("seconds", "s"), lambda r: f"{r.seconds:.2f}" if r.share == 1 else f"~{r.seconds:.0f}"),
            (Column("+ normals", ".2f"), lambda r: r.normals),
            (Column("evaluations per level", "s"), lambda r: " + ".join(f"{n / 1e6:.2f} M" for n in r.evaluations)),
            (Column("vertices", ",d"), lambda r: r.vertices or None),
            (Column("peak memory, MiB", ".0f"), lambda r: None if r.peak is None else r.peak / 2**20),
        ]
        notes = []
        adaptive = [row for row in rows if row.method == ADAPTIVE]
        for small, large in itertools.pairwise(adaptive):
            growth = f"×{large.seconds / small.seconds:.2f} in time"
            growth += f", ×{sum(large.evaluations) / sum(small.evaluations):.2f} in evaluations"
            notes.append(f"{small.resolution}³ → {large.resolution}³: {growth}")
        for peer in (row for row in rows if row.method != ADAPTIVE):
            how = "" if peer.share == 1 else f" (timed on {peer.share:.1%} of the slabs, extrapolated linearly)"
            at = f"{peer.method} at {peer.resolution}³{how}"
            same = [row for row in adaptive if row.resolution == peer.resolution]
            notes += [f"{peer.seconds / ours.seconds:.1f}× faster than {at}" for ours in same]
            if peer.mean_distance is not None:
                notes.append(
                    "vertices of ours and the paper's scheme, to the nearest of the other: "
                    f"mean {peer.mean_distance:.4f} cells, max {peer.max_distance:.3f} cells"
                )
        items = [(row.method, row) for row in rows]
        return (tabulated(self.name, "What extraction costs", "method", figures, items, notes=notes),)


def _vertices(context: Context) -> Path:
    return context.out / "meshes" / f"{context.key}.npy"


def _alone(work: Callable[..., MeshRow], *arguments: object) -> MeshRow:
    """Run ``work`` in a fresh process with as many threads as here."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_with_threads, torch.get_num_threads(), work, *arguments).result()


def _with_threads(threads: int, work: Callable[..., MeshRow], *arguments: object) -> MeshRow:
    torch.set_num_threads(threads)
    return work(*arguments)


def _adaptive(path: Path, resolution: int, keep: Path) -> MeshRow:
    field, levels = counted(load_field(path).field)
    start = time.perf_counter()
    mesh = extract_mesh(field, resolution=resolution)
    whole = time.perf_counter() - start
    counts = tuple(level.values for level in levels)
    start = time.perf_counter()
    extract_mesh(field, resolution=resolution, normals=False)
    seconds = time.perf_counter() - start
    np.save(keep, mesh.vertices)
    return MeshRow(ADAPTIVE, resolution, seconds, whole - seconds, counts, len(mesh.vertices), peak_memory())


def _paper(path: Path, resolution: int, keep: Path) -> MeshRow:
    field, levels = counted(load_field(path).field)
    start = time.perf_counter()
    values = np.empty((resolution + 1,) * 3, np.float32)
    evaluate_slabs(field, values, range(resolution + 1))
    step = _step(resolution)
    vertices = peer_mesher()(values, 0.0, spacing=(step, step, step))[0] + np.asarray(DEFAULT_BOUNDS[0])
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


def peer_mesher() -> Callable[..., tuple[NDArray[Any], ...]]:
    """The ``marching_cubes`` of scikit-image, with which ours is compared.

    Raises:
        InputError: it is not installed.
    """
    try:
        from skimage.measure import marching_cubes  # here: this bench alone needs it
    except ImportError as error:
        raise InputError("meshers are compared with scikit-image's; pip install 'mplicits[bench]'") from error
    return marching_cubes


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

    def value_features(self, x: Tensor, *, level: int = -1) -> tuple[Tensor, Tensor]:
        """See `Field.value_features`."""
        self.values += x.shape[:-1].numel()
        return self.inner.value_features(x, level=level)

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
