"""Benchmark ``paper``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from mplicits.pipelines.cli.common import Command, add_flags, check_output, whole, write_json
from mplicits.pipelines.training.settings import closest, input_error

from ..paper.names import METHODS, PRESETS, TABLES
from .common import typed

Name = TypeVar("Name", bound=str)


def _paper_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files, or folders of them")
    parser.add_argument(
        "-o", "--out", required=True, type=Path, metavar="DIR", help="keeps records and tables; what is there is used"
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
    parser.add_argument("--jobs", type=whole(1), default=1, metavar="N", help="jobs at a time, through Ray (1)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of everything random (0)")
    parser.add_argument("--device", default="auto", help="torch device (auto)")
    parser.add_argument(
        "--page", type=Path, metavar="FILE.md", help="also write the page there, plots and sheets in a folder beside it"
    )
    add_flags(parser, "--json")


def _paper(arguments: argparse.Namespace) -> int:
    check_output(arguments.page, (".md",))
    asked = _words(arguments.table)
    tables = TABLES if "all" in asked else _known("--table", asked, TABLES, more=("all",))
    methods = METHODS if arguments.methods is None else _known("--methods", _words(arguments.methods), METHODS)
    (preset,) = _known("--preset", [arguments.preset], PRESETS)
    from mplicits.pipelines.training.folder import locked
    from mplicits.pipelines.training.trainer import Interrupted

    from ..harness.jobs import make_folder
    from ..harness.plots import check_matplotlib
    from ..harness.report import as_text, section_as_dict
    from ..paper.bench import PAGE, Bench, bench_paper, find_shapes

    check_matplotlib()
    make_folder(arguments.out)
    bench = Bench(
        find_shapes(arguments.shapes, reference=arguments.reference),
        tables,
        preset,
        methods,
        seed=arguments.seed,
        jobs=arguments.jobs,
        device=arguments.device,
        command=typed(arguments),
        page=arguments.page,
    )
    try:
        with locked(arguments.out):
            sections, failures = bench_paper(bench, arguments.out, say=lambda text: print(text, file=sys.stderr))
    except (Interrupted, KeyboardInterrupt):
        print("interrupted; the same command goes on after the last finished job", file=sys.stderr)
        return 130
    for section in sections:
        for table in section.tables[:1]:
            print(f"{section.name}: {section.summary}\n{as_text(table)}\n")
    print(f"all of it, with plots and pictures: {arguments.out / PAGE}")
    write_json(arguments.json, [section_as_dict(section) for section in sections])
    if failures:
        print(f"{failures} jobs failed; the same command tries them again", file=sys.stderr)
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


PAPER = Command(
    "the paper's tables: ours and its peers on your shapes",
    """  python -m benchmarks paper armadillo.ply -o paper
  python -m benchmarks paper meshes/ -o paper --table comparison noise --jobs 2
  python -m benchmarks paper meshes/ -o paper --table all --preset paper --device cuda
  python -m benchmarks paper scans.npz -o scans --reference bunny.ply --methods ours poisson""",
    _paper_arguments,
    _paper,
    "Train every method of the paper on the same clouds, measure them in the same way, and write its tables with the "
    "published figures beside ours. Finished jobs are kept: the same command goes on where it was stopped.",
)
