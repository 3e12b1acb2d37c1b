"""``python -m benchmarks …`` of what things cost: gradients, kernels, meshes, pictures, many points."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from mplicits.pipelines.cli.common import Command, add_flags, add_settings, positive, read_settings, whole
from mplicits.pipelines.training.settings import FitConfig

from .common import folder_flag, measured_flags, number, run_benches


def _normals_arguments(parser: argparse.ArgumentParser) -> None:
    number(parser, "--points", whole(1), 262_144, "how many")
    number(parser, "--repeats", whole(1), 3, "the best of how many; with --busy the median")
    number(parser, "--busy", whole(0, 256), 0, "processes that multiply matrices meanwhile")
    parser.add_argument("--device", default="cpu", help="torch device (cpu)")
    number(parser, "--seed", whole(0), 0, "of points and weights")
    folder_flag(parser)
    add_flags(parser, "--json")


def _normals(arguments: argparse.Namespace) -> int:
    from ..costs.speed import NormalsBench

    options = {name: getattr(arguments, name) for name in ("points", "repeats", "busy", "seed", "device")}
    return run_benches(arguments, [NormalsBench(**options)], out=arguments.out)


def _kernels_arguments(parser: argparse.ArgumentParser) -> None:
    number(parser, "--widths", whole(1, 512), (16, 64, 128, 256, 400), "of the networks", nargs="+")
    number(parser, "--depths", whole(1, 8), (1, 2, 3), "of the networks", nargs="+")
    number(parser, "--points", whole(1), 65, "at which they are compared")
    parser.add_argument("--levels", action="store_true", help="fields of two and three levels as well")
    number(parser, "--seed", whole(0), 0, "of points and weights")
    folder_flag(parser)
    add_flags(parser, "--json")


def _kernels(arguments: argparse.Namespace) -> int:
    from mplicits.neural_fields.backend.devices import choose_device

    device = str(choose_device("auto"))
    if device == "cpu":  # before anything imports Triton
        os.environ["TRITON_INTERPRET"], os.environ["MPLICITS_KERNELS"] = "1", "interpret"
    from ..costs.kernel_levels import LevelsBench
    from ..costs.kernels import KernelsBench

    sizes = tuple((width, depth) for width in arguments.widths for depth in arguments.depths)
    bench = KernelsBench(sizes=sizes, points=arguments.points, seed=arguments.seed, device=device)
    levels = [LevelsBench(points=arguments.points, seed=arguments.seed, device=device)] if arguments.levels else []
    return run_benches(arguments, [bench, *levels], out=arguments.out)


def _pictures_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    number(parser, "--sizes", whole(1), (512, 512, 1920, 1080), "widths and heights in turn", nargs="+")
    number(parser, "--repeats", whole(1), 30, "pictures that are timed")
    number(parser, "--points", whole(1), 1 << 20, "at which networks are evaluated")
    parser.add_argument("--device", default="cuda", help="torch device (cuda)")
    folder_flag(parser)
    add_flags(parser, "--json")


def _pictures(arguments: argparse.Namespace) -> int:
    from ..costs.pictures import PicturesBench, SamplesBench

    pairs = tuple(zip(arguments.sizes[::2], arguments.sizes[1::2], strict=False))
    pictures = PicturesBench(run_file=arguments.run, sizes=pairs, repeats=arguments.repeats, device=arguments.device)
    samples = SamplesBench(points=arguments.points, device=arguments.device)
    return run_benches(arguments, [pictures, samples], out=arguments.out)


def _mesh_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    number(parser, "--resolutions", whole(8, 2048), (256, 512, 1024), "where ours is timed", nargs="+")
    number(parser, "--reference", whole(8, 1024), 512, "where all are")
    parser.add_argument("--full", action="store_true", help="evaluate the dense peer on the whole lattice: very slow")
    folder_flag(parser)
    add_flags(parser, "--json")


def _mesh(arguments: argparse.Namespace) -> int:
    from ..costs.speed import MeshBench

    bench = MeshBench(
        run_file=arguments.run,
        resolutions=arguments.resolutions,
        reference=arguments.reference,
        full=arguments.full,
    )
    return run_benches(arguments, [bench], out=arguments.out)


def _render_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="meshes or clouds")
    folder_flag(parser, required=True)
    number(parser, "--size", whole(16, 4096), 512, "of the images")
    number(parser, "--views", whole(1), 3, "cameras around the shape")
    number(parser, "--repeats", whole(1), 2, "the best of how many")
    parser.add_argument("--no-naive", action="store_true", help="leave out the naive tracer, which takes minutes")
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _render(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from mplicits.neural_fields.backend.devices import choose_device

    from ..costs.render import RenderBench

    options = {name: getattr(arguments, name) for name in ("shapes", "size", "views", "repeats")}
    naive, device = not arguments.no_naive, str(choose_device(config.device))
    bench = RenderBench(config=config, naive=naive, device=device, **options)
    return run_benches(arguments, [bench], out=arguments.out)


def _scale_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shape", nargs="?", metavar="SHAPE", help="a mesh (default: the bundled statue)")
    number(parser, "--points", whole(1000), (100_000, 1_000_000, 10_000_000), "sizes of the clouds", nargs="+")
    number(parser, "--noise", positive, 0.001, "deviation, in bounding-box diagonals")
    measured_flags(parser, 256)
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where the clouds are written, and removed")
    folder_flag(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _scale(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from ..shapes.fits import ScaleBench

    options = {name: getattr(arguments, name) for name in ("folder", "shape", "noise", "resolution")}
    bench = ScaleBench(counts=arguments.points, config=config, samples=arguments.eval_samples, **options)
    return run_benches(arguments, [bench], out=arguments.out)


COSTS: Mapping[str, Command] = MappingProxyType(
    {
        "normals": Command(
            "what a gradient costs: jet, tangents, autograd",
            "  python -m benchmarks normals\n  python -m benchmarks normals --points 65536 --json normals.json",
            _normals_arguments,
            _normals,
        ),
        "kernels": Command(
            "how exact the fused kernels are, and what they move",
            "  python -m benchmarks kernels\n  python -m benchmarks kernels --widths 128 --depths 2 --levels",
            _kernels_arguments,
            _kernels,
            "Compare jets by the fused kernels (pip install 'mplicits[kernels]') with the same networks in float64, "
            "and count what they read and write. Without CUDA, Triton's interpreter runs them, slowly.",
        ),
        "pictures": Command(
            "pictures a second on a GPU, and how far they are from the CPU's",
            "  python -m benchmarks pictures runs/scan\n"
            "  python -m benchmarks pictures runs/scan --device cpu --sizes 64 48 --repeats 3 --points 4096",
            _pictures_arguments,
            _pictures,
            "Time whole pictures of a run, the host's work included, compare them with the CPU's, and time values and "
            "jets of networks at many points.",
        ),
        "mesh": Command(
            "what extraction costs: adaptive, the paper's, dense",
            """  python -m benchmarks mesh runs/scan
  python -m benchmarks mesh runs/scan --resolutions 128 256 --reference 256""",
            _mesh_arguments,
            _mesh,
        ),
        "render": Command(
            "what a picture costs: the rows of the paper's Tab. 4",
            """  python -m benchmarks render armadillo.ply -o bench_render
  python -m benchmarks render armadillo.ply eiffel.ply -o bench_render --views 1 --no-naive --json render.json""",
            _render_arguments,
            _render,
            "Fit the networks of the paper's Tab. 4 to each shape, trace pictures of them in several ways, and judge "
            "the pictures by converged traces and by a raycast of fine meshes.",
        ),
        "scale": Command(
            "what millions of points cost, and what they gain",
            """  python -m benchmarks scale --preset fast
  python -m benchmarks scale armadillo.ply --points 100000 10000000 --json scale.json""",
            _scale_arguments,
            _scale,
            "Draw clouds of several sizes from one shape, fit and mesh each in a process of its own, and compare.",
        ),
    }
)
