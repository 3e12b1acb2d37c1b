"""``mplicits bench …``: thin arguments around the benchmarks.

``mplicits bench texture`` and ``mplicits bench normal-map``: their arguments, and the checks before any work.

``mplicits bench scale``: its arguments.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from ..run.config import add_config_flags, given_flags, load_config, preset_names
from ..run.settings import FitConfig, TextureConfig
from .bench_runs import EVOLVE, PAPER, RECONSTRUCT
from .common import Command, add_fit_settings, add_json, check_output, fit_settings, positive, whole, write_json

__all__ = ["BENCH_COMMANDS"]


def _normals_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--points", type=whole(1), default=262_144, metavar="N", help="how many (262144)")
    parser.add_argument("--repeats", type=whole(1), default=3, metavar="N", help="the best of how many (3)")
    parser.add_argument("--device", default="cpu", help="torch device (cpu)")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of points and weights (0)")
    add_json(parser)


def _normals(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    from ..bench.speed import bench_normals, format_normals

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
    from ..bench.speed import bench_mesh, format_bench_mesh
    from ..run.machine import sgemm_rate

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
    from ..bench.fits import bench_fit, format_fit
    from ..run.progress import progress_bars
    from ..run.trainer import Interrupted

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
    from ..bench.render import bench_render, format_render
    from ..run.machine import choose_device, sgemm_rate
    from ..run.progress import progress_bars
    from ..run.trainer import Interrupted

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


# The paper's (64,1), with a frequency and a schedule at which it is a closed surface that looks like the shape.
COARSE = FitConfig(widths=(64,), depths=(1,), omegas=(40.0,), steps=(1500,), learning_rates=(2e-2,), samples=200_000)


def _view_arguments(parser: argparse.ArgumentParser, *, views: int) -> None:
    parser.add_argument("--views", type=whole(1), default=views, metavar="N", help=f"cameras around it ({views})")
    parser.add_argument("--size", type=whole(16, 4096), default=512, metavar="N", help="of the images (512)")
    parser.add_argument("--up", choices=("y", "z"), default="y", help="the axis that points up (y)")
    parser.add_argument(
        "--resolution", type=whole(8, 2048), default=256, metavar="N", help="of the coarse surface's mesh (256)"
    )
    add_json(parser)


def _texture_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("meshes", nargs="+", metavar="MESH", help="OBJ, GLB or glTF with a texture")
    parser.add_argument(
        "-o",
        "--out",
        required=True,
        type=Path,
        metavar="DIR",
        help="keeps fits, textures and pictures; those that are there are used",
    )
    _view_arguments(parser, views=6)
    coarse = parser.add_argument_group("coarse surface")
    coarse.add_argument("--coarse-width", type=whole(1), default=64, metavar="N", help="neurons per layer (64)")
    coarse.add_argument("--coarse-depth", type=whole(1), default=1, metavar="N", help="sine layers (1)")
    coarse.add_argument("--coarse-omega", type=positive, default=40.0, metavar="X", help="SIREN frequency (40)")
    coarse.add_argument("--coarse-steps", type=whole(1), default=1500, metavar="N", help="training steps (1500)")
    coarse.add_argument("--full", action="store_true", help="compare with a fit of several levels as well")
    names = ", ".join(preset_names("fit"))
    coarse.add_argument("--fit-preset", default="default", metavar="NAME", help=f"of --full: {names} (default)")
    add_config_flags(parser, TextureConfig, about="of the textures; seed and device are also the fits'")


def _texture(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    texture = load_config(TextureConfig, None, given_flags(arguments, TextureConfig), thing="texture")
    shared = {"seed": texture.seed, "device": texture.device}
    coarse = dataclasses.replace(
        COARSE,
        widths=(arguments.coarse_width,),
        depths=(arguments.coarse_depth,),
        omegas=(arguments.coarse_omega,),
        steps=(arguments.coarse_steps,),
        **shared,
    )
    full = load_config(FitConfig, arguments.fit_preset, shared) if arguments.full else None
    from ..bench.texture import bench_texture, format_texture
    from ..run.progress import progress_bars
    from ..run.trainer import Interrupted

    try:
        with progress_bars() as report:
            rows = bench_texture(
                arguments.meshes,
                arguments.out,
                texture,
                coarse=coarse,
                full=full,
                views=arguments.views,
                size=arguments.size,
                up=arguments.up,
                resolution=arguments.resolution,
                progress=lambda name, step: report(dataclasses.replace(step, stage=f"{name} {step.stage}")),
                report=lambda text: print(f"{text} …", file=sys.stderr),
            )
    except Interrupted:
        print("interrupted; the same command goes on", file=sys.stderr)
        return 130
    print(format_texture(rows))
    print(f"pictures and fits: {arguments.out}")
    write_json(arguments.json, [row.as_dict() for row in rows])
    return 0


def _normal_map_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument("reference", metavar="REFERENCE", help="the mesh that was fitted")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="a .png or .jpg with all the images")
    parser.add_argument(
        "--shading",
        choices=("headlight", "lambert", "normals"),
        default="headlight",
        help="what is compared",
    )
    parser.add_argument("--repeats", type=whole(1), default=2, metavar="N", help="the best of how many (2)")
    parser.add_argument("--device", default="auto", help="torch device (auto)")
    _view_arguments(parser, views=3)


def _normal_map(arguments: argparse.Namespace) -> int:
    check_output(arguments.json, (".json",))
    check_output(arguments.out, (".png", ".jpg", ".jpeg"))
    from ..bench.normal_map import bench_normal_map, format_normal_map

    rows = bench_normal_map(
        arguments.run,
        arguments.reference,
        shading=arguments.shading,
        size=arguments.size,
        views=arguments.views,
        up=arguments.up,
        resolution=arguments.resolution,
        repeats=arguments.repeats,
        device=arguments.device,
        picture=arguments.out,
        report=lambda text: print(f"{text} …", file=sys.stderr),
    )
    print(format_normal_map(rows))
    write_json(arguments.json, [row.as_dict() for row in rows])
    return 0


TEXTURE = Command(
    "how near textures on coarse surfaces come to UV textures",
    """  mplicits bench texture spot.obj bob.obj -o bench_texture
  mplicits bench texture spot.obj -o bench_texture --full --fit-preset fast --json texture.json""",
    _texture_arguments,
    _texture,
    "Fit a coarse surface to each mesh, train a texture field around it, and compare unlit images of it with those of "
    "the mesh and its UV texture. Errors are in display RGB from 0 to 1.",
)

NORMAL_MAP = Command(
    "what the normals of a fine level do for a coarse surface",
    """  mplicits bench normal-map runs/scan scan.ply
  mplicits bench normal-map runs/scan scan.ply --shading lambert --views 6 -o images.png""",
    _normal_map_arguments,
    _normal_map,
    "Compare shaded images of the levels of a run, and of the coarsest with the normals of the finest, with images of "
    "the mesh that was fitted.",
)


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
    from ..bench.fits import bench_scale, format_scale
    from ..run.trainer import Interrupted

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


SCALE = Command(
    "what millions of points cost, and what they gain",
    """  mplicits bench scale --preset fast
  mplicits bench scale armadillo.ply --points 100000 10000000 --json scale.json""",
    _arguments,
    _run,
    "Draw clouds of several sizes from one shape, fit and mesh each in a process of its own, and compare.",
)

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
