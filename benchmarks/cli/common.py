"""What the commands of ``python -m benchmarks …`` share: their flags, and the one way to run them."""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mplicits.pipelines.cli.common import add_flags, positive, whole, write_json
from mplicits.pipelines.training.settings import input_error

if TYPE_CHECKING:
    from ..harness.benchmark import Benchmark


def typed(arguments: argparse.Namespace) -> str:
    """The command as it could be typed again beside its files: pages are for others, who have other folders."""
    words = (Path(word).name if Path(word).is_absolute() else word for word in arguments.words)
    return shlex.join(words)


def run_benches(
    arguments: argparse.Namespace, benches: Sequence[Benchmark[Any]], *, out: Path | None, streams: int = 1
) -> int:
    """Do what is not done yet, print the tables, and write them.

    Args:
        arguments: of the command.
        benches: each with its own jobs.
        out: folder of the results; None keeps nothing.
        streams: jobs at a time, see `run_streams`.
    """
    from mplicits.pipelines.training.folder import locked
    from mplicits.pipelines.training.progress import progress_bars
    from mplicits.pipelines.training.trainer import Interrupted

    from ..harness.benchmark import write_results
    from ..harness.jobs import Registry, make_folder
    from ..harness.report import as_text
    from ..harness.run import run_pending

    planned = [(bench, bench.jobs()) for bench in benches]
    jobs = [job for _, own in planned for job in own]
    code = 0
    with ExitStack() as stack:
        folder = out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        make_folder(folder)
        stack.enter_context(locked(folder))
        try:
            with progress_bars() as bars:
                heard = {"say": _say, "progress": bars, "tell": _say}
                ran = run_pending(jobs, folder, Registry(benches), streams=streams, device=benches[0].device, **heard)
            code = 1 if ran.failures else 0
        except (Interrupted, KeyboardInterrupt):
            kept = "; the same command goes on after the last finished job" if out else ""
            print(f"interrupted{kept}", file=sys.stderr)
            code = 130
        tables, figures = write_results(planned, folder, command=typed(arguments))
    if tables:
        print("\n\n".join(map(as_text, tables)))
        print(f"machine: {figures['machine']}")
        write_json(arguments.json, figures)
    if out is not None:
        print(f"tables, cells, fits and pictures: {out}")
    return code


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def number(
    parser: argparse._ArgumentGroup | argparse.ArgumentParser,
    flag: str,
    kind: Callable[[str], float],
    default: float | Sequence[float] | None,
    about: str,
    **more: Any,
) -> None:
    """A flag for a number, or several, whose help ends with its default."""
    shown = (
        "" if default is None else f" ({' '.join(map(str, default)) if isinstance(default, tuple) else f'{default:g}'})"
    )
    metavar = "X" if kind is positive else "N"
    parser.add_argument(flag, type=kind, default=default, metavar=metavar, help=about + shown, **more)


def folder_flag(parser: argparse.ArgumentParser, *, required: bool = False) -> None:
    """The flag ``-o`` for the folder of the results."""
    about = "keeps records, fits and tables; what is there is used, and an interrupted bench goes on"
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", required=required, help=about)


def measured_flags(parser: argparse.ArgumentParser, resolution: int, samples: int = 500_000) -> None:
    """Flags for how finely surfaces are meshed and measured, with their defaults."""
    number(parser, "--resolution", whole(8, 2048), resolution, "of the meshes")
    number(parser, "--eval-samples", whole(1), samples, "points per surface")


def view_flags(parser: argparse.ArgumentParser, *, views: int) -> None:
    """Flags for the cameras around a shape (``views`` by default), and for its coarse surface."""
    number(parser, "--views", whole(1), views, "cameras around it")
    number(parser, "--size", whole(16, 4096), 512, "of the images")
    parser.add_argument("--up", choices=("y", "z"), default="y", help="the axis that points up (y)")
    number(parser, "--resolution", whole(8, 2048), 256, "of the coarse surface's mesh")
    add_flags(parser, "--json")


def noisy_flags(parser: argparse.ArgumentParser) -> None:
    """Flags for the clouds of meshes."""
    number(parser, "--noise", positive, None, "move points by up to X bounding-box diagonals")
    what = "noise in all directions (Gaussian), as strong along the normals; --normals estimate leaves those out"
    parser.add_argument("--isotropic", action="store_true", help=what)
    number(parser, "--points", whole(100), None, "draw so many points with exact normals, and leave the vertices")


def noise_of(arguments: argparse.Namespace) -> float:
    """How much of it, of what `noisy_flags` has declared.

    Raises:
        InputError: it has a kind and no amount.
    """
    if arguments.isotropic and not arguments.noise:
        raise input_error("--isotropic: how much noise? add --noise, 0.01 for one per cent of the diagonal")
    return arguments.noise or 0.0
