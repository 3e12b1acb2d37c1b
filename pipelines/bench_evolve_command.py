"""``mplicits bench evolve``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

from .command import Command, add_json, check_output, whole, write_json
from .run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from .run.settings import EvolveConfig

__all__ = ["COMMAND"]

FROM_CASES = ("kind", "shapes", "times", "velocity", "axis", "center", "angle", "twist", "alpha")


def _arguments(parser: argparse.ArgumentParser) -> None:
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
    from ..neural_fields import load_field
    from .bench.dynamic import dynamic_table, format_dynamic
    from .bench.evolve import bench_exact, bench_morph, format_exact, format_morph
    from .run.folder import find_field
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

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


COMMAND = Command(
    "surfaces that move: exact cases, and morphs of meshes",
    """  mplicits bench evolve
  mplicits bench evolve --meshes spot.obj bob.obj -o bench_evolve --json evolve.json
  mplicits bench evolve --no-exact --trace runs/morph""",
    _arguments,
    _evolve,
    "Train evolutions that are known in closed form and measure their surfaces at 20 times; with --meshes, fit two "
    "meshes, morph between the fits, measure both ends against the meshes, and time the dynamic tracer on the morph.",
)
