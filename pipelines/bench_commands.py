"""``mplicits bench …``: thin arguments around the benchmarks."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from .bench_colour_commands import NORMAL_MAP, TEXTURE
from .bench_evolve_command import COMMAND as EVOLVE
from .bench_reconstruct_command import COMMAND as RECONSTRUCT
from .bench_scale_command import COMMAND as SCALE
from .command import Command, add_json, check_output, positive, whole, write_json
from .fit_settings import add_fit_settings, fit_settings
from .paper.command import COMMAND as PAPER

__all__ = ["BENCH_COMMANDS"]


def _normals_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--points", type=whole(1), default=262_144, metavar="N", help="how many (262144)")
    parser.add_argument("--repeats", type=whole(1), default=3, metavar="N", help="the best of how many (3)")
    parser.add_argument("--device", default="cpu", help="torch device (cpu)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of points and weights (0)")
    add_json(parser)


def _normals(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    from .bench.speed import bench_normals, format_normals

    rows = bench_normals(
        points=arguments.points, repeats=arguments.repeats, device=arguments.device, seed=arguments.seed
    )
    print(format_normals(rows))
    write_json(arguments.json, [row.as_dict() for row in rows])
    return 0


def _mesh_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument(
        "--resolutions",
        type=whole(8, 2048),
        nargs="+",
        default=(256, 512, 1024),
        metavar="N",
        help="where ours is timed (256 512 1024)",
    )
    parser.add_argument("--reference", type=whole(8, 1024), default=512, metavar="N", help="where all are (512)")
    parser.add_argument("--full", action="store_true", help="evaluate the dense peer on the whole lattice: very slow")
    add_json(parser)


def _mesh(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    from .bench.speed import bench_mesh, format_bench_mesh
    from .run.machine import sgemm_rate

    bench = bench_mesh(
        arguments.run,
        resolutions=arguments.resolutions,
        reference=arguments.reference,
        full=arguments.full,
        limit=f"this machine multiplies float32 matrices at {sgemm_rate(256) / 1e9:.0f} GFLOP/s",
        report=lambda text: print(f"{text} …", file=sys.stderr),
    )
    print(format_bench_mesh(bench))
    write_json(arguments.json, dataclasses.asdict(bench))
    return 0


def _fit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files")
    parser.add_argument("--noise", type=positive, metavar="X", help="move points by up to X bounding-box diagonals")
    parser.add_argument("--resolution", type=whole(8, 2048), default=512, metavar="N", help="of the meshes (512)")
    parser.add_argument("--eval-samples", type=whole(1), default=500_000, metavar="N", help="per surface (500000)")
    parser.add_argument("--poisson-depth", type=whole(4, 14), default=10, metavar="N", help="octree depth (10)")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write a picture of all methods per shape")
    add_json(parser)
    add_fit_settings(parser)


def _fit(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    config = fit_settings(arguments)
    from .bench.fits import bench_fit, format_fit
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

    if arguments.pictures is not None:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    try:
        with progress_bars() as report:
            rows = bench_fit(
                arguments.shapes,
                config,
                noise=arguments.noise or 0.0,
                resolution=arguments.resolution,
                samples=arguments.eval_samples,
                poisson_depth=arguments.poisson_depth,
                pictures=arguments.pictures,
                progress=lambda shape, step: report(dataclasses.replace(step, stage=f"{shape} {step.stage}")),
            )
    except Interrupted:
        print("interrupted", file=sys.stderr)
        return 130
    print(format_fit(rows))
    write_json(arguments.json, [row.as_dict() for row in rows])
    return 0


def _render_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="meshes or clouds")
    parser.add_argument(
        "-o", "--out", required=True, type=Path, metavar="DIR", help="keeps the fits; those that are there are used"
    )
    parser.add_argument("--size", type=whole(16, 4096), default=512, metavar="N", help="of the images (512)")
    parser.add_argument("--views", type=whole(1), default=3, metavar="N", help="cameras around the shape (3)")
    parser.add_argument("--repeats", type=whole(1), default=2, metavar="N", help="the best of how many (2)")
    parser.add_argument("--no-naive", action="store_true", help="leave out the naive tracer, which takes minutes")
    add_json(parser)
    add_fit_settings(parser)


def _render(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    config = fit_settings(arguments)
    from .bench.render import bench_render, format_render
    from .run.machine import choose_device, sgemm_rate
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

    device = choose_device(config.device)
    try:
        with progress_bars() as report:
            rows = bench_render(
                arguments.shapes,
                arguments.out,
                config,
                size=arguments.size,
                views=arguments.views,
                repeats=arguments.repeats,
                naive=not arguments.no_naive,
                device=str(device),
                progress=lambda name, step: report(dataclasses.replace(step, stage=f"{name} {step.stage}")),
                report=lambda text: print(f"{text} …", file=sys.stderr),
            )
    except Interrupted:
        print("interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    rate = sgemm_rate(256, device=device)
    print(format_render(rows, sgemm=rate))
    print(f"this machine multiplies float32 matrices at {rate / 1e9:.0f} GFLOP/s on {device}")
    write_json(arguments.json, [row.as_dict() for row in rows])
    return 0


BENCH_COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "bench normals": Command(
            "what a gradient costs: jet, tangents, autograd",
            "  mplicits bench normals\n  mplicits bench normals --points 65536 --json normals.json",
            _normals_arguments,
            _normals,
        ),
        "bench mesh": Command(
            "what extraction costs: adaptive, the paper's, dense",
            "  mplicits bench mesh runs/scan\n  mplicits bench mesh runs/scan --resolutions 128 256 --reference 256",
            _mesh_arguments,
            _mesh,
        ),
        "bench fit": Command(
            "how near fits come: ours per level, screened Poisson",
            """  mplicits bench fit armadillo.ply --time-budget 180
  mplicits bench fit armadillo.ply bunny.ply --noise 0.01 --preset fast --pictures pictures""",
            _fit_arguments,
            _fit,
            "Fit the vertices of each mesh and measure the result against the mesh; Poisson needs mplicits[poisson].",
        ),
        "bench render": Command(
            "what a picture costs: the rows of the paper's Tab. 4",
            """  mplicits bench render armadillo.ply -o bench_render
  mplicits bench render armadillo.ply eiffel.ply -o bench_render --views 1 --no-naive --json render.json""",
            _render_arguments,
            _render,
            "Fit the networks of the paper's Tab. 4 to each shape, trace pictures of them in several ways, and judge "
            "the pictures by converged traces and by a raycast of fine meshes.",
        ),
        "bench texture": TEXTURE,
        "bench normal-map": NORMAL_MAP,
        "bench reconstruct": RECONSTRUCT,
        "bench evolve": EVOLVE,
        "bench paper": PAPER,
        "bench scale": SCALE,
    }
)
