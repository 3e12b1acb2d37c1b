"""Benchmark ``paper``: the clouds it is about, the jobs that its tables need, and the page of results."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mplicits.neural_fields import InputError
from mplicits.neural_fields.backend.devices import choose_device, sgemm_rate
from mplicits.neural_fields.backend.files import files_in, write_json, write_whole
from mplicits.pipelines.surface.surface import MESH_SUFFIXES, read_reference, read_surface

from ..harness.benchmark import machine_words
from ..harness.jobs import Record, make_folder
from ..harness.plots import to_svg
from ..harness.report import Section, as_csv, as_page, section_as_dict, section_from_dict, with_missing
from ..harness.run import Ran, kept_records, run_pending
from .ablations import DELTA_FACTOR, LOSS_WEIGHTS
from .comparison import BANF_TABLE, COMPARISON_TABLE, NOISE_TABLE, POISSON_TABLE
from .isolation import ISOLATION
from .jobs import Input, PaperJob, Preset, TableSpec, jobs_of
from .judge import protocol_of
from .methods import REGISTRY
from .names import METHODS, TABLES
from .robustness import DELTAS_TABLE, OUTLIERS_TABLE, UNDERTRAINED_TABLE
from .sheets import write_sheets
from .speed import MARCHING_CUBES, NORMALS

# In the order of `names.TABLES`; a test holds the two together.
SPECS: tuple[TableSpec, ...] = (
    COMPARISON_TABLE,
    NOISE_TABLE,
    POISSON_TABLE,
    BANF_TABLE,
    ISOLATION,
    UNDERTRAINED_TABLE,
    OUTLIERS_TABLE,
    DELTAS_TABLE,
    LOSS_WEIGHTS,
    DELTA_FACTOR,
    MARCHING_CUBES,
    NORMALS,
)

PAGE = "results.md"
TITLE = "The paper's tables, measured here"


@dataclass(frozen=True)
class Bench:
    """The options of a bench.

    Attributes:
        shapes: see `find_shapes`.
        tables: names of `SPECS`.
        preset: how large and how long.
        methods: those of `names.METHODS` that take part.
        seed: of everything.
        jobs: how many at a time.
        device: a torch device, or "auto".
        command: as it will stand on the page.
        page: where else the page is written, its plots and sheets in a folder of that name beside it.
    """

    shapes: Sequence[Input]
    tables: Sequence[str]
    preset: Preset
    methods: Sequence[str] = METHODS
    seed: int = 0
    jobs: int = 1
    device: str = "cpu"
    command: str = "python -m benchmarks paper"
    page: Path | None = None


def bench_paper(bench: Bench, out: Path, *, say: Callable[[str], None]) -> tuple[list[Section], int]:
    """Run a bench and write the results into a folder; results that exist there are used.

    The page holds the tables of earlier runs into the same folder too, if shapes, preset and seed are the same.

    Args:
        bench: the options.
        out: the folder.
        say: told one line per job.

    Returns:
        The sections of the chosen tables, and how many jobs failed.

    Raises:
        InputError: the folder cannot be written, or see `run_pending`.
        KeyboardInterrupt: Ctrl-C; finished jobs are kept.
        Interrupted: the same, during a fit of ours.
    """
    make_folder(out)
    # Variants of ours, which only ablations train, are not for --methods to choose.
    skipped = [name for name in METHODS if name not in bench.methods]
    plan = {
        spec: jobs_of(spec, bench.shapes, bench.preset, seed=bench.seed) for spec in SPECS if spec.name in bench.tables
    }
    jobs = list(dict.fromkeys(job for wanted in plan.values() for job in wanted))
    asked = [job for job in jobs if job.method not in skipped]
    say(f"{len(plan)} tables, {len(bench.shapes)} shapes, {len(asked)} jobs")
    ran = run_pending(asked, out, REGISTRY, workers=bench.jobs, device=bench.device, say=say)
    # What other methods found earlier stays in the tables.
    records = {**kept_records([job for job in jobs if job.method in skipped], out, REGISTRY), **ran.records}
    sections = [
        _section(spec, {job: records[job] for job in wanted if job in records}, wanted, ran, out)
        for spec, wanted in plan.items()
    ]
    stamp = {"preset": bench.preset, "seed": bench.seed, "shapes": [shape.path.name for shape in bench.shapes]}
    for section, wanted in zip(sections, plan.values(), strict=True):
        for table in section.tables:
            write_whole(out / f"{table.name}.csv", as_csv(table))
        own = [dict(records[job]) for job in wanted if job in records]
        pairs = stamp | {"section": section_as_dict(section), "records": own}
        write_json(out / f"{section.name}.json", pairs)
    there = _kept(out, stamp)
    where = choose_device(bench.device)
    protocol, machine = _protocol(bench), machine_words(where, sgemm_rate(256, device=where))
    write_whole(out / PAGE, as_page(there, title=TITLE, command=bench.command, protocol=protocol, machine=machine))
    if bench.page is not None:
        moved = [_copied(section, out, bench.page) for section in there]
        write_whole(bench.page, as_page(moved, title=TITLE, command=bench.command, protocol=protocol, machine=machine))
    return sections, len(ran.failures)


def _copied(section: Section, out: Path, page: Path) -> Section:
    """The section with links to copies of its plots and sheets, in a folder beside a page elsewhere."""
    for file, _ in (*section.plots, *section.sheets):
        target = page.parent / page.stem / file
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / file, target)
    plots, sheets = (
        tuple((f"{page.stem}/{file}", title) for file, title in pictures)
        for pictures in (section.plots, section.sheets)
    )
    return dataclasses.replace(section, plots=plots, sheets=sheets)


def _section(
    spec: TableSpec, own: Mapping[PaperJob, Record], jobs: Sequence[PaperJob], ran: Ran[PaperJob], out: Path
) -> Section:
    """Tables, plots and sheets of one spec.

    Args:
        spec: the table.
        own: records of those of its jobs that are done.
        jobs: all of its jobs.
        ran: why the others are not.
        out: folder of the bench.
    """
    records = list(own.values())
    failures = {job.name: ran.failures[job] for job in jobs if job in ran.failures}
    there = {job.method for job in own}
    missing = {name: why for name, why in ran.lacking.items() if name in {job.method for job in jobs}}
    for job in jobs:
        if job.method not in there and job in ran.failures:
            missing.setdefault(job.method, f"failed, {ran.failures[job]}")
    tables = spec.tables(records) if records else ()
    if tables:
        tables = (with_missing(tables[0], missing), *tables[1:])
    plots = []
    for plot in spec.plots(records) if records else ():
        (out / "plots").mkdir(exist_ok=True)
        file = f"plots/{plot.name}.svg"
        write_whole(out / file, to_svg(plot))
        plots.append((file, plot.title))
    sources = {record["cell"]["method"]: record["method"] for record in records}
    return Section(
        spec.name,
        spec.label,
        spec.summary,
        tables,
        tuple(plots),
        write_sheets(spec.name, own, out) if spec.sheets else (),
        tuple((name, about["source"], about["differs"]) for name, about in sources.items()),
        tuple(f"{name}: {why}" for name, why in failures.items()),
    )


def _kept(out: Path, stamp: Mapping[str, Any]) -> list[Section]:
    """Every section in the folder that was measured in the same way, in the order of the tables."""
    sections = []
    for name in TABLES:
        file = out / f"{name}.json"
        pairs = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
        if stamp.items() <= pairs.items():
            sections.append(section_from_dict(pairs["section"]))
    return sections


def _protocol(bench: Bench) -> list[str]:
    names = ", ".join(shape.path.name for shape in bench.shapes)
    measured = [
        f"{shape.path.name} is measured against {shape.reference.name}."
        for shape in bench.shapes
        if shape.reference is not None
    ]
    return [
        f"Preset `{bench.preset}`, seed {bench.seed}. Shapes: {names}.",
        "The cloud is the mesh's vertices with their normals (of a scan, its points); all methods learn from it and "
        "from nothing else. Only ours may judge points to be strays, and drops components that no points support, as "
        "`mplicits fit` and `mplicits mesh` do: that is part of it. The JSON files count both.",
        "Both shapes are moved by the similarity that puts the reference into the unit sphere. The Chamfer distance is "
        "squared L2, the sum of both directions; what two samplings of the same surface score is the row `(sampling "
        "floor)`.",
        protocol_of(bench.preset).summary(),
        *measured,
    ]


def find_shapes(paths: Sequence[str | Path], *, reference: Path | None = None) -> list[Input]:
    """The shapes that files and folders name.

    Args:
        paths: mesh files, folders (every mesh in them), or clouds if there is a reference.
        reference: the mesh that those without faces are measured against.

    Raises:
        InputError: there is no such file, a folder holds no mesh, a file holds no faces and there is no reference,
            or two files have the same name but for their folders and extensions.
    """
    files = [file for path in map(Path, paths) for file in _files(path)]
    stems: dict[str, Path] = {}
    for file in files:
        other = stems.setdefault(file.stem, file)
        if other is not file:
            raise InputError(f"{file}: {other} has the same name, which is how tables tell shapes apart; rename one")
    if reference is not None:
        read_reference(reference, fix="give another --reference")
    shapes = [_shape(file, reference) for file in files]
    if reference is not None and all(shape.reference is None for shape in shapes):
        raise InputError(f"--reference {reference}: every shape is a mesh, its own reference; leave it out")
    return shapes


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = [file for file in files_in(path, MESH_SUFFIXES) if file.is_file()]
    if not found:
        raise InputError(f"{path}: holds no mesh ({', '.join(MESH_SUFFIXES)}); name files, or another folder")
    return found


def _shape(file: Path, reference: Path | None) -> Input:
    if len(read_surface(file).faces):
        return Input(file)
    if reference is None:
        raise InputError(f"{file}: has no faces, so there is no surface to compare with; give --reference MESH")
    return Input(file, reference)
