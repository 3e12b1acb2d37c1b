"""``mplicits bench scale``: its arguments."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from .command import Command, add_json, check_output, positive, whole, write_json
from .fit_settings import add_fit_settings, fit_settings

__all__ = ["COMMAND"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shape", nargs="?", metavar="SHAPE", help="a mesh (default: the bundled statue)")
    parser.add_argument(
        "--points",
        type=whole(1000),
        nargs="+",
        default=(100_000, 1_000_000, 10_000_000),
        metavar="N",
        help="sizes of the clouds (100000 1000000 10000000)",
    )
    parser.add_argument(
        "--noise", type=positive, default=0.001, metavar="X", help="deviation, in bounding-box diagonals (0.001)"
    )
    parser.add_argument("--resolution", type=whole(8, 2048), default=256, metavar="N", help="of the meshes (256)")
    parser.add_argument("--eval-samples", type=whole(1), default=500_000, metavar="N", help="per surface (500000)")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where the clouds are written, and removed")
    add_json(parser)
    add_fit_settings(parser)


def _run(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    config = fit_settings(arguments)
    from .bench.fits import bench_scale, format_scale
    from .run.trainer import Interrupted

    try:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            rows = bench_scale(
                arguments.points,
                config,
                Path(folder),
                shape=arguments.shape,
                noise=arguments.noise,
                resolution=arguments.resolution,
                samples=arguments.eval_samples,
                report=lambda text: print(f"{text} …", file=sys.stderr),
            )
    except Interrupted:
        print("interrupted", file=sys.stderr)
        return 130
    print(format_scale(rows))
    write_json(arguments.json, [row.as_dict() for row in rows])
    return 0


COMMAND = Command(
    "what millions of points cost, and what they gain",
    """  mplicits bench scale --preset fast
  mplicits bench scale armadillo.ply --points 100000 10000000 --json scale.json""",
    _arguments,
    _run,
    "Draw clouds of several sizes from one shape, fit and mesh each in a process of its own, and compare.",
)
