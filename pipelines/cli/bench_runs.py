"""``mplicits bench reconstruct``: its arguments, and the checks before any work.

``mplicits bench evolve``: its arguments, and the checks before any work.

``mplicits bench paper``: its arguments, and the checks before any work.
"""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from ..paper.names import METHODS, PRESETS, TABLES
from ..run.config import add_config_flags, closest, given_flags, input_error, load_config, preset_names
from ..run.settings import EvolveConfig, ReconstructConfig
from .common import Command, add_json, check_output, positive, whole, write_json

__all__ = ["EVOLVE", "PAPER", "RECONSTRUCT"]


def _reconstruct_arguments(parser: argparse.ArgumentParser) -> None:
    what = "an exact scene (painted-sphere, striped-torus, figure, statue), or the path of posed photographs"
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=what)
    parser.add_argument(
        "-o", "--out", type=Path, metavar="DIR", help="keeps rows, pictures and meshes; rows that are there are used"
    )
    parser.add_argument("--views", type=whole(2, 10_000), default=24, metavar="N", help="of an exact scene (24)")
    parser.add_argument("--size", type=whole(8, 4096), default=64, metavar="N", help="of an exact scene's images (64)")
    parser.add_argument(
        "--test-views", type=whole(1), default=8, metavar="N", help="measure at most so many held-out views (8)"
    )
    parser.add_argument(
        "--equal-time",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="train ours once more, for as long as NeuS took (yes)",
    )
    parser.add_argument("--resolution", type=whole(8, 2048), default=256, metavar="N", help="of the meshes (256)")
    parser.add_argument("--eval-samples", type=whole(1), default=500_000, metavar="N", help="per surface (500000)")
    parser.add_argument(
        "--neus-learning-rate", type=positive, default=1e-3, metavar="X", help="peak rate of the NeuS rows (1e-3)"
    )
    add_json(parser)
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names("reconstruct"))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: default)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, ReconstructConfig, about="of all rows; the geometry is chosen by the benchmark")


def _reconstruct(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    if arguments.out is not None and arguments.out.exists() and not arguments.out.is_dir():
        raise input_error(f"{arguments.out}: is a file; name a folder")
    flags = given_flags(arguments, ReconstructConfig)
    if "geometry" in flags:
        raise input_error("--geometry: the benchmark trains both; leave it out")
    config = load_config(
        ReconstructConfig, arguments.config or arguments.preset or "default", flags, thing="reconstruct"
    )
    if config.time_budget is not None:
        raise input_error("--time-budget: rows are compared after as many steps; leave it out, and give --steps")
    from ..bench.reconstruct import BenchOptions, bench_reconstruct, read_scene
    from ..bench.reconstruct_rows import ReconstructRow, format_reconstruct
    from ..run.machine import choose_device, sgemm_rate
    from ..run.progress import counter_bar, progress_bars
    from ..run.trainer import Interrupted

    device = choose_device(config.device)
    options = BenchOptions(
        directory=arguments.out,
        equal_time=arguments.equal_time,
        test_views=arguments.test_views,
        resolution=arguments.resolution,
        samples=arguments.eval_samples,
        neus_learning_rate=arguments.neus_learning_rate,
    )
    scenes = []
    for name in arguments.scenes:
        with counter_bar(name) as progress:
            scenes.append(
                read_scene(name, views=arguments.views, size=arguments.size, width=config.width, progress=progress)
            )
    rows: list[ReconstructRow] = []
    code = 0
    try:
        with progress_bars() as bars:
            found = bench_reconstruct(
                scenes, config, options, progress=bars, report=lambda text: print(text, file=sys.stderr)
            )
            for row in found:
                rows.append(row)
                write_json(arguments.json, [row.as_dict() for row in rows])
    except (Interrupted, KeyboardInterrupt):
        kept = "; the same command goes on after the last finished row" if arguments.out else ""
        print(f"interrupted{kept}", file=sys.stderr)
        code = 130
    if rows:
        print(format_reconstruct(rows, sgemm=sgemm_rate(256, device=device)))
    if rows and arguments.out is not None:
        print(f"pictures, meshes and rows: {arguments.out}")
    return code


RECONSTRUCT = Command(
    "the multiscale geometry against the network of NeuS",
    """  mplicits bench reconstruct painted-sphere figure -o bench --preset fast
  mplicits bench reconstruct data/dtu_scan24 -o bench --width 400 --steps 20000 --json scan24.json""",
    _reconstruct_arguments,
    _reconstruct,
    "Train the network of NeuS and the multiscale geometry on the same rays of posed photographs: PSNR of held-out "
    "views, Chamfer distance where the surface is known, parameters, time and FLOPs.",
)


FROM_CASES = ("kind", "shapes", "times", "velocity", "axis", "center", "angle", "twist", "alpha")


def _evolve_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--meshes", nargs=2, type=Path, metavar=("A", "B"), help="morph between the fits of these meshes as well"
    )
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help="for --meshes: keeps fits (used again) and morph")
    parser.add_argument(
        "--trace",
        metavar="RUN",
        help="time the dynamic tracer on this run of `mplicits evolve` (with --meshes: the morph)",
    )
    parser.add_argument(
        "--size", type=whole(16, 4096), default=512, metavar="N", help="pixels squared of --trace (512)"
    )
    parser.add_argument("--no-exact", action="store_true", help="leave out the exact cases")
    parser.add_argument("--mesh-resolution", type=whole(8, 2048), default=256, metavar="N", help="with --meshes (256)")
    parser.add_argument("--eval-samples", type=whole(1), default=500_000, metavar="N", help="per surface (500000)")
    add_json(parser)
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names("evolve"))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: exact, or default with --meshes)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(
        parser,
        EvolveConfig,
        about="of the exact cases; with --meshes of the morph instead, and the exact cases have their preset",
    )


def _evolve(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    directory: Path | None = arguments.out
    if arguments.meshes and directory is None:
        raise input_error("--meshes: the fits need a folder; add -o DIR")
    if arguments.no_exact and not arguments.meshes and not arguments.trace:
        raise input_error("--no-exact: nothing is left to measure; add --meshes A B or --trace RUN")
    if arguments.meshes and arguments.trace:
        raise input_error("--trace: with --meshes the morph is traced; leave it out")
    flags = given_flags(arguments, EvolveConfig)
    for name in FROM_CASES:
        if name in flags:
            raise input_error(f"--{name}: the benchmark says what is trained; leave it out")
    preset, own = arguments.config or arguments.preset, "default" if arguments.meshes else "exact"
    given = load_config(EvolveConfig, preset or own, flags, thing="evolve")
    exact = load_config(EvolveConfig, "exact", thing="evolve") if arguments.meshes else given
    from ...neural_fields import load_field
    from ..bench.dynamic import dynamic_table, format_dynamic
    from ..bench.evolve import bench_exact, bench_morph, format_exact, format_morph
    from ..run.folder import find_field
    from ..run.progress import progress_bars
    from ..run.trainer import Interrupted

    traced = load_field(find_field(arguments.trace)).field if arguments.trace else None
    if traced is not None and traced.in_dim != 4:
        raise input_error(f"--trace {arguments.trace}: does not move; give a run of `mplicits evolve`")
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {}
    tables = []
    try:
        with progress_bars() as bars:

            def tell(name: str, step: Any) -> None:
                bars(dataclasses.replace(step, stage=f"{name} {step.stage}"))

            if not arguments.no_exact:
                rows = bench_exact(exact, progress=tell)
                figures["exact"] = [row.as_dict() for row in rows]
                tables.append(format_exact(rows))
                write_json(arguments.json, figures)
            if arguments.meshes and directory is not None:
                first, second = arguments.meshes
                row = bench_morph(
                    first,
                    second,
                    given,
                    directory=directory,
                    resolution=arguments.mesh_resolution,
                    samples=arguments.eval_samples,
                    progress=tell,
                )
                figures["morph"] = row.as_dict()
                tables.append(format_morph(row))
                write_json(arguments.json, figures)
                traced = load_field(find_field(directory / "morph")).field
            if traced is not None:
                frames = dynamic_table(traced, size=arguments.size, cells=arguments.mesh_resolution)
                figures["dynamic"] = [frame.as_dict() for frame in frames]
                tables.append(format_dynamic(frames))
    except Interrupted:
        print("interrupted", file=sys.stderr)
        return 130
    finally:
        if tables:
            print("\n\n".join(tables))
    write_json(arguments.json, figures)
    return 0


EVOLVE = Command(
    "surfaces that move: exact cases, and morphs of meshes",
    """  mplicits bench evolve
  mplicits bench evolve --meshes spot.obj bob.obj -o bench_evolve --json evolve.json
  mplicits bench evolve --no-exact --trace runs/morph""",
    _evolve_arguments,
    _evolve,
    "Train evolutions that are known in closed form and measure their surfaces at 20 times; with --meshes, fit two "
    "meshes, morph between the fits, measure both ends against the meshes, and time the dynamic tracer on the morph.",
)


Name = TypeVar("Name", bound=str)


def _paper_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files, or folders of them")
    parser.add_argument(
        "-o", "--out", required=True, type=Path, metavar="DIR", help="keeps cells and tables; what is there is used"
    )
    parser.add_argument(
        "--table",
        nargs="+",
        default=["comparison"],
        metavar="NAME",
        help=f"all, or some of {', '.join(TABLES)} (comparison)",
    )
    parser.add_argument("--preset", default="cpu", metavar="NAME", help=f"{', '.join(PRESETS)} (cpu)")
    parser.add_argument("--methods", nargs="+", metavar="NAME", help=f"only these: {', '.join(METHODS)} (all)")
    parser.add_argument(
        "--reference", type=Path, metavar="MESH", help="what clouds among the shapes are measured against"
    )
    parser.add_argument("--jobs", type=whole(1), default=1, metavar="N", help="cells at a time, through Ray (1)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of everything random (0)")
    parser.add_argument("--device", default="auto", help="torch device (auto)")
    parser.add_argument(
        "--page", type=Path, metavar="FILE.md", help="also write the page there, plots and sheets in a folder beside it"
    )
    add_json(parser)


def _paper(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    check_output(arguments.page, (".md",))
    asked = _words(arguments.table)
    tables = TABLES if "all" in asked else _known("--table", asked, TABLES, more=("all",))
    methods = METHODS if arguments.methods is None else _known("--methods", _words(arguments.methods), METHODS)
    (preset,) = _known("--preset", [arguments.preset], PRESETS)
    from ..bench.cells import make_folder
    from ..bench.report import as_markdown, section_as_dict
    from ..paper.bench import PAGE, Bench, bench_paper, find_shapes
    from ..run.trainer import Interrupted

    make_folder(arguments.out)
    bench = Bench(
        find_shapes(arguments.shapes, reference=arguments.reference),
        tables,
        preset,
        methods,
        seed=arguments.seed,
        jobs=arguments.jobs,
        device=arguments.device,
        command=_command(arguments),
        page=arguments.page,
    )
    try:
        sections, failures = bench_paper(bench, arguments.out, say=lambda text: print(text, file=sys.stderr))
    except (Interrupted, KeyboardInterrupt):
        print("interrupted; the same command goes on after the last finished cell", file=sys.stderr)
        return 130
    for section in sections:
        for table in section.tables[:1]:
            print(f"{section.name}: {section.summary}\n{as_markdown(table)}\n")
    print(f"all of it, with plots and pictures: {arguments.out / PAGE}")
    write_json(arguments.json, [section_as_dict(section) for section in sections])
    if failures:
        print(f"{failures} cells failed; the same command tries them again", file=sys.stderr)
    return 1 if failures else 0


def _words(given: Sequence[str]) -> list[str]:
    """Names, whether they came with commas or spaces."""
    return [word for text in given for word in text.split(",") if word]


def _known(flag: str, names: Sequence[str], known: Sequence[Name], more: Sequence[str] = ()) -> tuple[Name, ...]:
    """The names in their usual order, each once.

    Raises:
        InputError: one is unknown, or there are none.
    """
    for name in names:
        if name not in known:
            raise input_error(f"{flag}: there is no {name!r}{closest(name, [*known, *more])}")
    if not names:
        raise input_error(f"{flag}: expected some of {', '.join([*known, *more])}")
    return tuple(name for name in known if name in names)


def _command(arguments: argparse.Namespace) -> str:
    """The command as it could be typed again, beside the files: the page is for others, who have other folders."""
    words = ["mplicits", "bench", "paper", *map(_nearby, arguments.shapes), "-o", _nearby(arguments.out)]
    words += ["--table", *arguments.table, "--preset", arguments.preset]
    if arguments.methods is not None:
        words += ["--methods", *arguments.methods]
    if arguments.reference is not None:
        words += ["--reference", _nearby(arguments.reference)]
    if arguments.page is not None:
        words += ["--page", _nearby(arguments.page)]
    for name, usual in (("jobs", 1), ("seed", 0), ("device", "auto")):
        value = getattr(arguments, name)
        if value != usual:
            words += [f"--{name}", str(value)]
    return shlex.join(words)


def _nearby(path: str | Path) -> str:
    """A relative path as it is, and the name of an absolute one."""
    return Path(path).name if Path(path).is_absolute() else str(path)


PAPER = Command(
    "the paper's tables: ours and its peers on your shapes",
    """  mplicits bench paper armadillo.ply -o paper
  mplicits bench paper meshes/ -o paper --table comparison noise --jobs 2
  mplicits bench paper meshes/ -o paper --table all --preset paper --device cuda
  mplicits bench paper scans.npz -o scans --reference bunny.ply --methods ours poisson""",
    _paper_arguments,
    _paper,
    "Train every method of the paper on the same clouds, measure them in the same way, and write its tables with the "
    "published figures beside ours. Finished cells are kept: the same command goes on where it was stopped.",
)
