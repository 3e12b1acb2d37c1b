"""The tables marching-cubes and normals: what a grid costs with and without bands, and what a gradient costs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch
from mplicits.neural_fields import Field, Siren, extract_mesh
from mplicits.pipelines.training.trainer import seeded

from ..costs.speed import NormalsBench
from ..harness.jobs import Context, Method, Record, Results
from ..harness.tables import Column, Row, Table, Value
from .base import base_job, base_of, without_bands
from .jobs import PaperJob, TableSpec, select
from .judge import protocol_of
from .ours import Ours
from .published import PAPER_MODELS, TIME_AUTO, TIME_MC

if TYPE_CHECKING:
    from .jobs import Preset

Overrides = tuple[tuple[str, Any], ...]
SIZES: Mapping[Preset, Overrides] = MappingProxyType(
    {
        "smoke": (("widths", (16, 24, 32)), ("depths", (1, 2, 2))),
        "cpu": (("widths", (64, 128, 400)), ("depths", (1, 2, 2))),
        "paper": (("widths", (64, 128, 400)), ("depths", (1, 2, 2))),
    }
)
BASELINE = (256, 4)
# One slab of the grid in this number is really evaluated; 1 is all.
EVERY: Mapping[Preset, int] = MappingProxyType({"smoke": 4, "cpu": 32, "paper": 1})
SIDES: Mapping[Preset, tuple[int, ...]] = MappingProxyType(
    {"smoke": (16, 32), "cpu": (512, 1024), "paper": (512, 1024)}
)
REPEATS: Mapping[Preset, int] = MappingProxyType({"smoke": 1, "cpu": 3, "paper": 5})
WIDTH, DEPTHS = 256, (2, 3)


class MarchingCubes(Method[PaperJob]):
    """Seconds for a grid: one large SIREN, the multiscale field without and with its bands, and our own extraction."""

    name = "marching-cubes"
    depends = True
    source = "paper, Tab. time_mc"
    differs = "evaluation of the grid only, but for our own extraction, which is timed with its triangles"

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """See `Method.settings`."""
        fit = Ours().settings(base_job(job, SIZES[job.preset]))
        return {**fit, "baseline": BASELINE, "every": EVERY[job.preset]}

    def run(self, job: PaperJob, context: Context) -> Results:
        """See `Method.run`: one output per scheme, each with its "seconds"."""
        field = base_of(job, context, SIZES[job.preset]).field
        resolution, every = protocol_of(job.preset).resolution, EVERY[job.preset]
        with seeded(job.seed):
            baseline = Siren(*BASELINE).to(context.device).requires_grad_(False)
        grids = {"baseline": baseline, "without culling": without_bands(field), "with culling": field}
        seconds = {name: grid_seconds(grid, resolution, every=every) for name, grid in grids.items()}
        started = time.perf_counter()
        mesh = extract_mesh(field, resolution=resolution, normals=False)
        seconds["ours"] = time.perf_counter() - started
        outputs = [{"name": name, "seconds": spent} for name, spent in seconds.items()]
        return Results(tuple(outputs), tuple(field.deltas.tolist()), {"vertices": len(mesh.vertices)})


@torch.inference_mode()
def grid_seconds(field: Field, resolution: int, *, every: int = 1) -> float:
    """Seconds to evaluate ``(resolution + 1)³`` lattice points, plane by plane.

    Args:
        field: on the device of its parameters.
        resolution: cells along each side of the mesher's box.
        every: evaluate only one plane in ``every``, and take the others to cost as much.
    """
    axis = torch.linspace(-1.02, 1.02, resolution + 1)
    plane = torch.cartesian_prod(axis[:1], axis, axis).to(field.like.device)
    field.value(plane)  # first calls are slower
    slabs = range(every // 2 if every <= resolution else 0, resolution + 1, every)
    started = time.perf_counter()
    for slab in slabs:
        plane[:, 0] = axis[slab]
        field.value(plane).sum().item()  # a GPU works on after the call returns
    return (time.perf_counter() - started) * (resolution + 1) / len(slabs)


class Normals(Method[PaperJob]):
    """Seconds for value and gradient at as many points as an image has pixels; ``overrides``: depth, side.

    What they cost does not depend on the shape, so the weights are random ones.
    """

    name = "normals"
    source = "paper, supplement, Tab. time_auto"
    differs = "random weights; the first shape stands for all"

    def settings(self, job: PaperJob) -> Mapping[str, Any]:
        """See `Method.settings`."""
        return {"width": WIDTH, "repeats": REPEATS[job.preset]}

    def run(self, job: PaperJob, context: Context) -> Results:
        """See `Method.run`: outputs "autograd", "algorithm 1" and "ours", each with its "seconds"."""
        choice = dict(job.overrides)
        points, size = int(choice["side"]) ** 2, (WIDTH, int(choice["depth"]))
        bench = NormalsBench(points=points, repeats=REPEATS[job.preset], device=context.device, seed=job.seed)
        row = bench.timed(*size)
        times = {"autograd": row.autograd, "algorithm 1": row.printed, "ours": row.jet}
        outputs = [{"name": name, "seconds": seconds} for name, seconds in times.items()]
        return Results(tuple(outputs), details={"largest_difference": row.largest_difference})


def marching_cubes_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    """For each shape the fit of the paper's sizes for this table, and its timing."""
    timed = [PaperJob(shape, MarchingCubes.name, preset) for shape in shapes]
    return [*(base_job(job, SIZES[preset]) for job in timed), *timed]


def marching_cubes_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """One row per shape, and the paper's own rows below."""
    found = [record for record in select(records, method=MarchingCubes.name) if record["outputs"]]
    if not found:
        return ()
    rows = []
    for record in found:
        seconds = {output["name"]: output["seconds"] for output in record["outputs"]}
        baseline, unculled, culled, ours = (
            seconds[name] for name in ("baseline", "without culling", "with culling", "ours")
        )
        values = (baseline, unculled, culled, baseline / culled, ours, baseline / ours)
        rows.append(Row(record["cell"]["shape"], values, _published_grid(record["cell"]["shape"])))
    named = {row.name.lower() for row in rows}
    rows += [
        Row(f"{model} (paper only)", (None,) * 6, _published_grid(model), competes=False)
        for model in TIME_MC
        if model.lower() not in named
    ]
    preset: Preset = found[0]["cell"]["preset"]
    resolution, every = protocol_of(preset).resolution, EVERY[preset]
    sizes = dict(SIZES[preset])
    levels = " ▷ ".join(f"({width},{depth})" for width, depth in zip(sizes["widths"], sizes["depths"], strict=True))
    columns = (
        Column("baseline, s", ".2f"),
        Column("no culling, s", ".2f"),
        Column("culling, s", ".2f"),
        Column("speed-up", ".2f"),
        Column("our extraction, s", ".2f"),
        Column("speed-up", ".2f"),
    )
    sampled = "" if every == 1 else f", timed on every {every}th plane of the grid and extrapolated"
    notes = (
        f"{levels} at {resolution}³ against one SIREN {BASELINE}, whose weights are random, on "
        f"{found[0]['environment']['device']}. The paper's figures are of 512³ on an RTX 5090.",
        f"The first three columns are seconds for evaluating the whole grid{sampled}. They are for all levels "
        "everywhere, or the coarse level everywhere and finer ones in their bands. Our extraction culls blocks and "
        "includes triangles.",
    )
    return (Table("marching-cubes", "Marching cubes (tab:time_mc)", "shape", columns, tuple(rows), notes),)


def _published_grid(shape: str) -> tuple[Value, ...] | None:
    for model, (baseline, unculled, culled) in TIME_MC.items():
        if model.lower() == shape.lower():
            return (baseline, unculled, culled, baseline / culled, None, None)
    return None


def normals_jobs(shapes: Sequence[Path], preset: Preset) -> list[PaperJob]:
    """One job per network and number of points."""
    return [
        PaperJob(shapes[0], Normals.name, preset, overrides=(("depth", depth), ("side", side)))
        for depth in DEPTHS
        for side in SIDES[preset]
    ]


def normals_tables(records: Sequence[Record]) -> tuple[Table, ...]:
    """One row per network and number of points."""
    found = [record for record in select(records, method=Normals.name) if record["outputs"]]
    if not found:
        return ()
    rows = []
    for record in found:
        seconds = {output["name"]: output["seconds"] for output in record["outputs"]}
        depth, side = (record["cell"]["overrides"][name] for name in ("depth", "side"))
        autograd, printed, ours = (seconds[name] for name in ("autograd", "algorithm 1", "ours"))
        name = f"{WIDTH}x{depth}, {side}x{side}"
        values = (autograd, printed, ours, autograd / printed, autograd / ours)
        rows.append(Row(name, values, _published_normals(depth, side)))
    columns = (
        Column("autograd, s", ".3f"),
        Column("Algorithm 1, s", ".3f"),
        Column("ours, s", ".3f"),
        Column("Algorithm 1's speed-up", ".2f"),
        Column("our speed-up", ".2f"),
    )
    difference = max(record["details"]["largest_difference"] for record in found)
    notes = (
        f"Value and gradient on {found[0]['environment']['device']}; the paper's figures are means over "
        f"{', '.join(PAPER_MODELS)} on an RTX 5090, and its own method is Algorithm 1.",
        f"Ours is one sweep back through the same matrices. The gradients differ by at most {difference:.1e}.",
    )
    return (
        Table("normals", "Normals without autograd (tab:time_auto)", "network, points", columns, tuple(rows), notes),
    )


def _published_normals(depth: int, side: int) -> tuple[Value, ...] | None:
    found = [TIME_AUTO[model, depth, side] for model in PAPER_MODELS if (model, depth, side) in TIME_AUTO]
    if not found:
        return None
    autograd, printed = (sum(column) / len(found) for column in zip(*found, strict=True))
    return (autograd, printed, None, autograd / printed, None)


MARCHING_CUBES = TableSpec(
    "marching-cubes",
    "Tab. time_mc",
    "what evaluating a grid costs, with and without bands",
    marching_cubes_jobs,
    marching_cubes_tables,
)
NORMALS = TableSpec("normals", "Tab. time_auto", "gradients by hand and by autograd", normals_jobs, normals_tables)
