"""``mplicits bench reconstruct``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from .command import Command, add_json, check_output, positive, whole, write_json
from .run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from .run.progress import counter_bar
from .run.settings import ReconstructConfig

__all__ = ["COMMAND"]


def _arguments(parser: argparse.ArgumentParser) -> None:
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
    from .bench.reconstruct import BenchOptions, bench_reconstruct, read_scene
    from .bench.reconstruct_rows import ReconstructRow, format_reconstruct
    from .run.machine import choose_device, sgemm_rate
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

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


COMMAND = Command(
    "the multiscale geometry against the network of NeuS",
    """  mplicits bench reconstruct painted-sphere figure -o bench --preset fast
  mplicits bench reconstruct data/dtu_scan24 -o bench --width 400 --steps 20000 --json scan24.json""",
    _arguments,
    _reconstruct,
    "Train the network of NeuS and the multiscale geometry on the same rays of posed photographs: PSNR of held-out "
    "views, Chamfer distance where the surface is known, parameters, time and FLOPs.",
)
