"""``mplicits bench …``: thin arguments around the benchmarks."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Mapping
from types import MappingProxyType

from .command import Command, add_json, check_output, whole

__all__ = ["BENCH_COMMANDS"]


def _normals_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--points", type=whole(1), default=262_144, metavar="N", help="how many (262144)")
    parser.add_argument("--repeats", type=whole(1), default=5, metavar="N", help="the best of how many (5)")
    parser.add_argument("--device", default="cpu", help="torch device (cpu)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of points and weights (0)")
    add_json(parser)


def _normals(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    from .bench_normals import bench_normals, format_normals

    rows = bench_normals(
        points=arguments.points, repeats=arguments.repeats, device=arguments.device, seed=arguments.seed
    )
    print(format_normals(rows))
    if arguments.json:
        arguments.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=2) + "\n")
    return 0


BENCH_COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "bench normals": Command(
            "what a gradient costs: jet, tangents, autograd",
            "  mplicits bench normals\n  mplicits bench normals --points 65536 --json normals.json",
            _normals_arguments,
            _normals,
        ),
    }
)
