"""``mplicits bench …``: the arguments of the benchmarks, the checks before any work, and the one way to run them."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from ..run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from ..run.settings import EvolveConfig, FitConfig, ReconstructConfig, TextureConfig
from .bench_paper import PAPER
from .common import Command, add_flags, add_settings, check_output, positive, read_settings, typed, whole, write_json

if TYPE_CHECKING:
    from ..bench.benchmark import Benchmark

__all__ = ["BENCH_COMMANDS"]

# The names of `bench.model.DEVICES`, which help must not load torch for.
MODELLED = ("h100", "a100", "4090", "m2")
GEOMETRIES = ("multiscale", "neus", "single")  # those of `bench.geometries`


def _run(
    arguments: argparse.Namespace, benches: Sequence[Benchmark[Any]], *, out: Path | None, streams: int = 1
) -> int:
    """Do what is not done yet, print the tables, and write them.

    Args:
        arguments: of the command.
        benches: each with its own cells.
        out: folder of the results; None keeps nothing.
        streams: cells at a time, see `run_streams`.
    """
    from ..bench.benchmark import write_results
    from ..bench.cells import Catalogue, make_folder
    from ..bench.report import as_text
    from ..bench.run import run_cells
    from ..run.lock import locked
    from ..run.progress import progress_bars
    from ..run.trainer import Interrupted

    planned = [(bench, bench.cells()) for bench in benches]
    cells = [cell for _, own in planned for cell in own]
    code = 0
    with ExitStack() as stack:
        folder = out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        make_folder(folder)
        stack.enter_context(locked(folder))
        try:
            with progress_bars(whole=False) as bars:
                heard = {"say": _say, "progress": bars, "tell": _say}
                ran = run_cells(cells, folder, Catalogue(benches), streams=streams, device=benches[0].device, **heard)
            code = 1 if ran.failures else 0
        except (Interrupted, KeyboardInterrupt):
            kept = "; the same command goes on after the last finished cell" if out else ""
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


def _number(
    parser: argparse._ArgumentGroup | argparse.ArgumentParser,
    flag: str,
    kind: Callable[[str], float],
    default: float | Sequence[int] | None,
    about: str,
    **more: Any,
) -> None:
    """A flag for a number, or several, whose help ends with its default."""
    shown = (
        "" if default is None else f" ({' '.join(map(str, default)) if isinstance(default, tuple) else f'{default:g}'})"
    )
    metavar = "X" if kind is positive else "N"
    parser.add_argument(flag, type=kind, default=default, metavar=metavar, help=about + shown, **more)


def _folder(parser: argparse.ArgumentParser, *, required: bool = False) -> None:
    about = "keeps cells, fits and tables; what is there is used, and an interrupted bench goes on"
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", required=required, help=about)


def _measured(parser: argparse.ArgumentParser, resolution: int, samples: int = 500_000) -> None:
    _number(parser, "--resolution", whole(8, 2048), resolution, "of the meshes")
    _number(parser, "--eval-samples", whole(1), samples, "points per surface")


def _normals_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, "--points", whole(1), 262_144, "how many")
    _number(parser, "--repeats", whole(1), 3, "the best of how many; with --busy the median")
    _number(parser, "--busy", whole(0, 256), 0, "processes that multiply matrices meanwhile")
    parser.add_argument("--device", default="cpu", help="torch device (cpu)")
    _number(parser, "--seed", whole(0), 0, "of points and weights")
    _folder(parser)
    add_flags(parser, "--json")


def _normals(arguments: argparse.Namespace) -> int:
    from ..bench.speed import NormalsBench

    options = {name: getattr(arguments, name) for name in ("points", "repeats", "busy", "seed", "device")}
    return _run(arguments, [NormalsBench(**options)], out=arguments.out)


def _kernels_arguments(parser: argparse.ArgumentParser) -> None:
    _number(parser, "--widths", whole(1, 512), (16, 64, 128, 256, 400), "of the networks", nargs="+")
    _number(parser, "--depths", whole(1, 8), (1, 2, 3), "of the networks", nargs="+")
    _number(parser, "--points", whole(1), 65, "at which they are compared")
    parser.add_argument("--levels", action="store_true", help="fields of two and three levels as well")
    _number(parser, "--seed", whole(0), 0, "of points and weights")
    _folder(parser)
    add_flags(parser, "--json")


def _kernels(arguments: argparse.Namespace) -> int:
    from ..run.machine import choose_device

    device = str(choose_device("auto"))
    if device == "cpu":  # before anything imports Triton
        os.environ["TRITON_INTERPRET"], os.environ["MPLICITS_KERNELS"] = "1", "interpret"
    from ..bench.kernel_levels import LevelsBench
    from ..bench.kernels import KernelsBench

    sizes = tuple((width, depth) for width in arguments.widths for depth in arguments.depths)
    bench = KernelsBench(sizes=sizes, points=arguments.points, seed=arguments.seed, device=device)
    levels = [LevelsBench(points=arguments.points, seed=arguments.seed, device=device)] if arguments.levels else []
    return _run(arguments, [bench, *levels], out=arguments.out)


def _size(text: str) -> tuple[int, int]:
    """Width and height of a picture."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 4 <= min(int(width), int(height)) <= 8192):
        raise argparse.ArgumentTypeError(f"{text!r}: expected WIDTHxHEIGHT, of 4 to 8192 pixels each")
    return int(width), int(height)


def _gpu_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    sizes = ((512, 512), (1920, 1080))
    shown = " ".join(f"{width}x{height}" for width, height in sizes)
    parser.add_argument(
        "--sizes", type=_size, nargs="+", default=sizes, metavar="WxH", help=f"of the pictures ({shown})"
    )
    _modelled(parser, ("h100", "4090"))
    parser.add_argument("--timed", metavar="DEVICE", help="time them on this device, too: cuda, cpu, ... (none)")
    _folder(parser)
    add_flags(parser, "--json")


def _modelled(parser: argparse.ArgumentParser, default: tuple[str, ...]) -> None:
    about = f"times on GPUs by a model of counts and published rates: {', '.join(MODELLED)}"
    if default:
        about += f" ({' '.join(default)})"
    parser.add_argument("--model", nargs="+", choices=MODELLED, default=default, metavar="GPU", help=about)


def _gpu(arguments: argparse.Namespace) -> int:
    from ..bench.gpu import GpuBench

    bench = GpuBench(
        run_file=arguments.run, sizes=tuple(arguments.sizes), devices=tuple(arguments.model), timed=arguments.timed
    )
    return _run(arguments, [bench], out=arguments.out)


def _mesh_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    _number(parser, "--resolutions", whole(8, 2048), (256, 512, 1024), "where ours is timed", nargs="+")
    _number(parser, "--reference", whole(8, 1024), 512, "where all are")
    parser.add_argument("--full", action="store_true", help="evaluate the dense peer on the whole lattice: very slow")
    _folder(parser)
    add_flags(parser, "--json")


def _mesh(arguments: argparse.Namespace) -> int:
    from ..bench.speed import MeshBench

    bench = MeshBench(
        run_file=arguments.run,
        resolutions=arguments.resolutions,
        reference=arguments.reference,
        full=arguments.full,
    )
    return _run(arguments, [bench], out=arguments.out)


def _noisy(parser: argparse.ArgumentParser) -> None:
    """Flags for the clouds of meshes."""
    _number(parser, "--noise", positive, None, "move points by up to X bounding-box diagonals")
    what = "noise in all directions (Gaussian), as strong along the normals; --normals estimate leaves those out"
    parser.add_argument("--isotropic", action="store_true", help=what)
    _number(parser, "--points", whole(100), None, "draw so many points with exact normals, and leave the vertices")


def _noise(arguments: argparse.Namespace) -> float:
    """How much of it, of what `_noisy` has declared.

    Raises:
        InputError: it has a kind and no amount.
    """
    if arguments.isotropic and not arguments.noise:
        raise input_error("--isotropic: how much noise? add --noise, 0.01 for one per cent of the diagonal")
    return arguments.noise or 0.0


def _fit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files")
    _noisy(parser)
    _measured(parser, 512)
    _number(parser, "--poisson-depth", whole(4, 14), 10, "octree depth")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write two pictures of all methods per shape")
    _folder(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _fit(arguments: argparse.Namespace) -> int:
    config, noise = read_settings(arguments, FitConfig), _noise(arguments)
    from ..bench.fits import FitBench

    bench = FitBench(
        shapes=arguments.shapes,
        config=config,
        noise=noise,
        isotropic=arguments.isotropic,
        points=arguments.points,
        resolution=arguments.resolution,
        samples=arguments.eval_samples,
        poisson_depth=arguments.poisson_depth,
        pictures=arguments.pictures,
    )
    return _run(arguments, [bench], out=arguments.out)


def _signs_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files")
    _noisy(parser)
    _folder(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _signs(arguments: argparse.Namespace) -> int:
    config, noise = read_settings(arguments, FitConfig), _noise(arguments)
    from ..bench.signs import SignsBench

    options = {"noise": noise, "isotropic": arguments.isotropic, "points": arguments.points, "device": config.device}
    return _run(arguments, [SignsBench(shapes=arguments.shapes, config=config, **options)], out=arguments.out)


def _render_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="meshes or clouds")
    _folder(parser, required=True)
    _number(parser, "--size", whole(16, 4096), 512, "of the images")
    _number(parser, "--views", whole(1), 3, "cameras around the shape")
    _number(parser, "--repeats", whole(1), 2, "the best of how many")
    parser.add_argument("--no-naive", action="store_true", help="leave out the naive tracer, which takes minutes")
    _modelled(parser, ())
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _render(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from ..bench.render import RenderBench
    from ..run.machine import choose_device

    options = {name: getattr(arguments, name) for name in ("shapes", "size", "views", "repeats")}
    naive, device = not arguments.no_naive, str(choose_device(config.device))
    bench = RenderBench(config=config, naive=naive, device=device, devices=tuple(arguments.model), **options)
    return _run(arguments, [bench], out=arguments.out)


# The paper's (64,1), with a frequency and a schedule at which it is a closed surface that looks like the shape.
COARSE = FitConfig(widths=(64,), depths=(1,), omegas=(40.0,), steps=(1500,), learning_rates=(2e-2,), samples=200_000)


def _view_arguments(parser: argparse.ArgumentParser, *, views: int) -> None:
    _number(parser, "--views", whole(1), views, "cameras around it")
    _number(parser, "--size", whole(16, 4096), 512, "of the images")
    parser.add_argument("--up", choices=("y", "z"), default="y", help="the axis that points up (y)")
    _number(parser, "--resolution", whole(8, 2048), 256, "of the coarse surface's mesh")
    add_flags(parser, "--json")


def _texture_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("meshes", nargs="+", metavar="MESH", help="OBJ, GLB or glTF with a texture")
    _folder(parser, required=True)
    _view_arguments(parser, views=6)
    coarse = parser.add_argument_group("coarse surface")
    _number(coarse, "--coarse-width", whole(1), 64, "neurons per layer")
    _number(coarse, "--coarse-depth", whole(1), 1, "sine layers")
    _number(coarse, "--coarse-omega", positive, 40.0, "SIREN frequency")
    _number(coarse, "--coarse-steps", whole(1), 1500, "training steps")
    coarse.add_argument("--full", action="store_true", help="compare with a fit of several levels as well")
    names = ", ".join(preset_names("fit"))
    coarse.add_argument("--fit-preset", default="default", metavar="NAME", help=f"of --full: {names} (default)")
    add_config_flags(parser, TextureConfig, about="of the textures; seed and device are also the fits'")


def _texture(arguments: argparse.Namespace) -> int:
    texture = load_config(TextureConfig, None, given_flags(arguments, TextureConfig))
    shared = {"seed": texture.seed, "device": texture.device}
    own = {f"{name}s": (getattr(arguments, f"coarse_{name}"),) for name in ("width", "depth", "omega")}
    coarse = dataclasses.replace(COARSE, **own, steps=(arguments.coarse_steps,), **shared)
    full = load_config(FitConfig, arguments.fit_preset, shared) if arguments.full else None
    from ..bench.texture import TextureBench

    options = {name: getattr(arguments, name) for name in ("meshes", "views", "size", "up", "resolution")}
    bench = TextureBench(texture=texture, coarse=coarse, full=full, device=texture.device, **options)
    return _run(arguments, [bench], out=arguments.out)


def _normal_map_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument("reference", metavar="REFERENCE", help="the mesh that was fitted")
    about = "a .png or .jpg with all the images, or a folder that keeps them and the figures"
    parser.add_argument("-o", "--out", type=Path, metavar="PATH", help=about)
    shadings = ("headlight", "lambert", "normals")
    parser.add_argument("--shading", choices=shadings, default="headlight", help="what is compared")
    _number(parser, "--repeats", whole(1), 2, "the best of how many")
    parser.add_argument("--device", default="auto", help="torch device (auto)")
    _view_arguments(parser, views=3)


def _normal_map(arguments: argparse.Namespace) -> int:
    out: Path | None = arguments.out
    picture = None
    if out is not None and out.suffix and not out.is_dir():
        check_output(out, (".png", ".jpg", ".jpeg"))
        picture, out = out, None
    elif out is not None:
        picture = out / "images.png"
    from ..bench.normal_map import NormalMapBench

    names = ("reference", "shading", "size", "views", "up", "resolution", "repeats", "device")
    options = {name: getattr(arguments, name) for name in names}
    return _run(arguments, [NormalMapBench(run_file=arguments.run, picture=picture, **options)], out=out)


def _reconstruct_arguments(parser: argparse.ArgumentParser) -> None:
    what = "an exact scene (painted-sphere, striped-torus, figure, statue), or the path of posed photographs"
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=what)
    _folder(parser)
    _number(parser, "--views", whole(2, 10_000), 24, "of an exact scene")
    _number(parser, "--size", whole(8, 4096), 64, "of an exact scene's images")
    _number(parser, "--test-views", whole(1), 8, "measure at most so many held-out views")
    parser.add_argument(
        "--equal-time",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="train ours once more, for as long as NeuS took (yes)",
    )
    _measured(parser, 256)
    what = "peak rate of the NeuS rows (0.001)"
    parser.add_argument("--neus-learning-rate", type=positive, metavar="RATE", help=what)
    alone = parser.add_argument_group("the geometry alone")
    about = "the same colour network, encodings and rates for the multiscale geometry, NeuS's and one SIREN of its size"
    alone.add_argument("--geometry-only", action="store_true", help=about)
    _number(alone, "--seeds", whole(2, 100), 3, "trainings of each geometry with its rate")
    about = "peak rates, all tried with the first seed; each geometry keeps its best one (--learning-rate)"
    alone.add_argument("--rates", nargs="+", type=positive, metavar="RATE", help=about)
    about = f"which of them (all): {', '.join(GEOMETRIES)}"
    alone.add_argument("--geometries", nargs="+", choices=GEOMETRIES, metavar="NAME", help=about)
    about = "trainings at a time, each in a stream of the GPU, which one alone does not fill"
    _number(alone, "--streams", whole(1, 64), 1, about)
    add_flags(parser, "--json")
    add_settings(parser, ReconstructConfig, about="of all rows; the geometry is chosen by the benchmark")


def _reconstruct(arguments: argparse.Namespace) -> int:
    if "geometry" in given_flags(arguments, ReconstructConfig):
        raise input_error("--geometry: the benchmark trains both; leave it out")
    for name in ("jets", "focus"):
        if name in given_flags(arguments, ReconstructConfig):
            raise input_error(f"--{name}: rows see the same rays, as many in every step; leave it out")
    if arguments.rates and not arguments.geometry_only:
        raise input_error("--rates: only --geometry-only tries several; add it, or give --learning-rate")
    if arguments.geometries and not arguments.geometry_only:
        raise input_error("--geometries: without --geometry-only all rows are trained; add it")
    if arguments.streams > 1 and not arguments.geometry_only:
        raise input_error("--streams: rows are compared by their time, one by one; only --geometry-only has several")
    if arguments.geometry_only and arguments.neus_learning_rate is not None:
        raise input_error("--neus-learning-rate: --geometry-only tries the same rates for all; give --rates")
    config = read_settings(arguments, ReconstructConfig)
    if config.time_budget is not None:
        raise input_error("--time-budget: rows are compared after as many steps; leave it out, and give --steps")
    from ..bench.reconstruct import ReconstructBench, read_scene
    from ..run.progress import counter_bar

    scenes = []
    for name in arguments.scenes:
        with counter_bar(name) as progress:
            scenes.append(
                read_scene(name, views=arguments.views, size=arguments.size, width=config.width, progress=progress)
            )
    options = {name: getattr(arguments, name) for name in ("test_views", "resolution")}
    options |= {"samples": arguments.eval_samples, "device": config.device}
    if arguments.geometry_only:
        from ..bench.geometries import GeometryBench

        options["rates"] = tuple(dict.fromkeys(arguments.rates or (config.learning_rate,)))
        if arguments.geometries:
            options["geometries"] = tuple(dict.fromkeys(arguments.geometries))
        options |= {"seeds": arguments.seeds, "streams": arguments.streams}
        alone = GeometryBench(scenes=scenes, config=config, **options)
        return _run(arguments, [alone], out=arguments.out, streams=arguments.streams)
    options["equal_time"] = arguments.equal_time
    if arguments.neus_learning_rate is not None:
        options["neus_learning_rate"] = arguments.neus_learning_rate
    return _run(arguments, [ReconstructBench(scenes=scenes, config=config, **options)], out=arguments.out)


FROM_CASES = ("kind", "shapes", "times", "velocity", "axis", "center", "angle", "twist", "alpha")


def _evolve_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--meshes", nargs=2, type=Path, metavar=("A", "B"), help="morph between the fits of these meshes as well"
    )
    _folder(parser)
    parser.add_argument(
        "--trace",
        metavar="RUN",
        help="time the dynamic tracer on this run of `mplicits evolve` (with --meshes: the morph)",
    )
    _number(parser, "--size", whole(16, 4096), 512, "pixels squared of --trace")
    parser.add_argument("--no-exact", action="store_true", help="leave out the exact cases")
    _number(parser, "--mesh-resolution", whole(8, 2048), 256, "with --meshes and --trace")
    _number(parser, "--eval-samples", whole(1), 500_000, "per surface")
    add_flags(parser, "--json")
    add_settings(
        parser,
        EvolveConfig,
        default="exact, or default with --meshes",
        about="of the exact cases; with --meshes of the morph instead, and the exact cases have their preset",
    )


def _evolve(arguments: argparse.Namespace) -> int:
    if arguments.meshes and arguments.out is None:
        raise input_error("--meshes: the fits need a folder; add -o DIR")
    if arguments.no_exact and not arguments.meshes and not arguments.trace:
        raise input_error("--no-exact: nothing is left to measure; add --meshes A B or --trace RUN")
    if arguments.meshes and arguments.trace:
        raise input_error("--trace: with --meshes the morph is traced; leave it out")
    flags = given_flags(arguments, EvolveConfig)
    for name in FROM_CASES:
        if name in flags:
            raise input_error(f"--{name}: the benchmark says what is trained; leave it out")
    given = read_settings(arguments, EvolveConfig, default="default" if arguments.meshes else "exact")
    exact = load_config(EvolveConfig, "exact") if arguments.meshes else given
    from ..bench.dynamic import DynamicBench
    from ..bench.evolve import ExactBench, MorphBench

    benches: list[Benchmark[Any]] = [] if arguments.no_exact else [ExactBench(config=exact)]
    resolution, samples = arguments.mesh_resolution, arguments.eval_samples
    morph = None
    if arguments.meshes:
        morph = MorphBench(meshes=tuple(arguments.meshes), config=given, resolution=resolution, samples=samples)
        benches.append(morph)
    if arguments.meshes or arguments.trace:
        benches.append(DynamicBench(run_file=arguments.trace, morph=morph, size=arguments.size, resolution=resolution))
    return _run(arguments, benches, out=arguments.out)


def _motion_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "meshes", nargs="*", type=Path, metavar="MESH", help="in place of figures: pairs of meshes, A B"
    )
    parser.add_argument(
        "--kinds", nargs="+", choices=_from_shape_to_shape(), metavar="KIND", help="of evolve (all from shape to shape)"
    )
    parser.add_argument("--figures", nargs="+", metavar="NAME", help="of these figures alone: arm, bar, walker (all)")
    _number(parser, "--keys", whole(2, 100), None, "key shapes, at even times (5)")
    _number(
        parser, "--noise", positive, None, "fit scans of the key shapes, with this deviation in diagonals (no scans)"
    )
    _number(parser, "--moments", whole(1, 1000), 20, "held-out times that are measured")
    _number(parser, "--mesh-resolution", whole(8, 2048), 96, "of the meshes that are measured")
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="of pairs: sheets of moments, with carried colours"
    )
    _folder(parser)
    add_flags(parser, "--json")
    add_settings(parser, EvolveConfig, default="exact", about="of each training; overrides the preset")


def _from_shape_to_shape() -> list[str]:
    """The kinds of ``evolve`` that take several shapes, each at its time."""
    kinds: tuple[str, ...] = get_args(get_type_hints(EvolveConfig)["kind"])
    return [kind for kind in kinds if kind not in ("transport", "smooth")]


def _motion(arguments: argparse.Namespace) -> int:
    flags, meshes = given_flags(arguments, EvolveConfig), arguments.meshes
    for name in FROM_CASES if meshes else (*FROM_CASES, "align"):
        if name in flags:
            raise input_error(f"--{name}: the benchmark says what is trained; leave it out")
    config = read_settings(arguments, EvolveConfig, default="exact")
    if (arguments.noise is not None or meshes) and arguments.out is None:
        raise input_error(f"{'MESH' if meshes else '--noise'}: the fits need a folder; add -o DIR")
    kinds, moments = tuple(arguments.kinds or _from_shape_to_shape()), arguments.moments
    measured = {"config": config, "kinds": kinds, "moments": moments, "resolution": arguments.mesh_resolution}
    if meshes:
        return _motion_of_pairs(arguments, measured)
    if arguments.pictures is not None:
        raise input_error("--pictures: are of pairs of meshes; name two, or leave it out")
    from ..bench.motion import FIGURES, MotionBench

    figures, noise = tuple(arguments.figures or FIGURES), arguments.noise
    bench = MotionBench(figures=figures, keys=arguments.keys or 5, noise=noise, **measured)
    return _run(arguments, [bench], out=arguments.out)


def _motion_of_pairs(arguments: argparse.Namespace, measured: dict[str, Any]) -> int:
    for name in ("figures", "keys", "noise"):
        if getattr(arguments, name) is not None:
            raise input_error(f"--{name}: is of figures; leave it out, or the meshes")
    meshes = arguments.meshes
    if len(meshes) % 2:
        raise input_error(f"{len(meshes)} meshes: expected pairs, A B or A B C D and so on")
    if arguments.moments < 2:
        raise input_error(f"--moments {arguments.moments}: between two meshes 2 are measured at least, the ends")
    from ..bench.pairs import PairBench

    pairs = tuple(zip(meshes[::2], meshes[1::2], strict=True))
    return _run(arguments, [PairBench(pairs=pairs, pictures=arguments.pictures, **measured)], out=arguments.out)


def _scale_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shape", nargs="?", metavar="SHAPE", help="a mesh (default: the bundled statue)")
    _number(parser, "--points", whole(1000), (100_000, 1_000_000, 10_000_000), "sizes of the clouds", nargs="+")
    _number(parser, "--noise", positive, 0.001, "deviation, in bounding-box diagonals")
    _measured(parser, 256)
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where the clouds are written, and removed")
    _folder(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _scale(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from ..bench.fits import ScaleBench

    options = {name: getattr(arguments, name) for name in ("folder", "shape", "noise", "resolution")}
    bench = ScaleBench(counts=arguments.points, config=config, samples=arguments.eval_samples, **options)
    return _run(arguments, [bench], out=arguments.out)


def _srb_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", help="scans and true surfaces of the same names")
    parser.add_argument(
        "--rows",
        nargs="+",
        choices=("file", "none"),
        default=("file", "none"),
        help="fits with the file's normals, and without (both)",
    )
    parser.add_argument("--shapes", nargs="+", default=(), metavar="NAME", help="only scans of these surfaces (all)")
    _measured(parser, 512, 1_000_000)
    _number(parser, "--poisson-depth", whole(4, 14), 10, "octree depth")
    _folder(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _srb(arguments: argparse.Namespace) -> int:
    if "normals" in given_flags(arguments, FitConfig):
        raise input_error("--normals: the benchmark fits with and without them; choose by --rows")
    config = read_settings(arguments, FitConfig)
    from ..bench.srb import SrbBench

    options = {name: getattr(arguments, name) for name in ("folder", "shapes", "resolution", "poisson_depth")}
    bench = SrbBench(config=config, normals=arguments.rows, samples=arguments.eval_samples, **options)
    return _run(arguments, [bench], out=arguments.out)


def _eta_arguments(parser: argparse.ArgumentParser) -> None:
    what = "fit, reconstruct or evolve (all three)"
    parser.add_argument("works", nargs="*", metavar="WORK", help=what)
    _number(parser, "--share", positive, 1.0, "factor on the steps of the fast presets")
    _number(parser, "--points", whole(100), 50_000, "of the cloud that is fitted")
    parser.add_argument("--device", default="cpu", help="torch device (cpu)")
    _folder(parser)
    add_flags(parser, "--json")


def _eta(arguments: argparse.Namespace) -> int:
    from ..bench.eta import WORKS, EtaBench

    options = {name: getattr(arguments, name) for name in ("share", "points", "device")}
    return _run(arguments, [EtaBench(works=tuple(arguments.works) or WORKS, **options)], out=arguments.out)


BENCH_COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "bench normals": Command(
            "what a gradient costs: jet, tangents, autograd",
            "  mplicits bench normals\n  mplicits bench normals --points 65536 --json normals.json",
            _normals_arguments,
            _normals,
        ),
        "bench eta": Command(
            "what progress bars say of the time left, and what is true",
            "  mplicits bench eta\n  mplicits bench eta fit --share 0.5 --json eta.json",
            _eta_arguments,
            _eta,
            "Do a fit, a reconstruction and a morph, and compare the time that they take with what was said after five "
            "seconds, a quarter and half of it.",
        ),
        "bench kernels": Command(
            "how exact the fused kernels are, and what they move",
            "  mplicits bench kernels\n  mplicits bench kernels --widths 128 --depths 2 --levels",
            _kernels_arguments,
            _kernels,
            "Compare jets by the fused kernels (pip install 'mplicits[kernels]') with the same networks in float64, "
            "and count what they read and write. Without CUDA, Triton's interpreter runs them, slowly.",
        ),
        "bench gpu": Command(
            "what pictures of a run would cost on GPUs: a model",
            "  mplicits bench gpu runs/scan\n  mplicits bench gpu runs/scan --sizes 512x512 --model h100 m2",
            _gpu_arguments,
            _gpu,
            "Count, on the CPU, what pictures of the coarsest and the finest level ask of a device, and tell by "
            "published rates how long they would take on GPUs that are not here.",
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
        "bench signs": Command(
            "how many estimated normals point the wrong way",
            """  mplicits bench signs armadillo.ply
  mplicits bench signs armadillo.ply eiffel.ply --noise 0.005 --isotropic --json signs.json""",
            _signs_arguments,
            _signs,
            "Estimate the normals of the vertices of each mesh as a fit does, then by a network that is not told of "
            "signs (fit --normals none), and compare both with the exact ones.",
        ),
        "bench render": Command(
            "what a picture costs: the rows of the paper's Tab. 4",
            """  mplicits bench render armadillo.ply -o bench_render
  mplicits bench render armadillo.ply eiffel.ply -o bench_render --views 1 --no-naive --json render.json
  mplicits bench render armadillo.ply -o bench_render --model h100 4090""",
            _render_arguments,
            _render,
            "Fit the networks of the paper's Tab. 4 to each shape, trace pictures of them in several ways, and judge "
            "the pictures by converged traces and by a raycast of fine meshes.",
        ),
        "bench texture": Command(
            "how near textures on coarse surfaces come to UV textures",
            """  mplicits bench texture spot.obj bob.obj -o bench_texture
  mplicits bench texture spot.obj -o bench_texture --full --fit-preset fast --json texture.json""",
            _texture_arguments,
            _texture,
            "Fit a coarse surface to each mesh, train a texture field around it, and compare unlit images of it with "
            "those of the mesh and its UV texture. Errors are in display RGB from 0 to 1.",
        ),
        "bench normal-map": Command(
            "what the normals of a fine level do for a coarse surface",
            """  mplicits bench normal-map runs/scan scan.ply
  mplicits bench normal-map runs/scan scan.ply --shading lambert --views 6 -o images.png""",
            _normal_map_arguments,
            _normal_map,
            "Compare shaded images of the levels of a run, and of the coarsest with the normals of the finest, with "
            "images of the mesh that was fitted.",
        ),
        "bench reconstruct": Command(
            "the multiscale geometry against the network of NeuS",
            """  mplicits bench reconstruct painted-sphere figure -o bench --preset fast
  mplicits bench reconstruct data/dtu_scan24 -o bench --width 400 --steps 20000 --json scan24.json""",
            _reconstruct_arguments,
            _reconstruct,
            "Train the network of NeuS and the multiscale geometry on the same rays of posed photographs: PSNR of "
            "held-out views, Chamfer distance where the surface is known, parameters, time and FLOPs.",
        ),
        "bench evolve": Command(
            "surfaces that move: exact cases, and morphs of meshes",
            """  mplicits bench evolve
  mplicits bench evolve --meshes spot.obj bob.obj -o bench_evolve --json evolve.json
  mplicits bench evolve --no-exact --trace runs/morph""",
            _evolve_arguments,
            _evolve,
            "Train evolutions that are known in closed form and measure their surfaces at 20 times; with --meshes, fit "
            "two meshes, morph between the fits, measure both ends against the meshes, and time the dynamic tracer on "
            "the morph.",
        ),
        "bench motion": Command(
            "motions between key shapes, at moments that were held out",
            """  mplicits bench motion
  mplicits bench motion --kinds morph --keys 3 --moments 12 -o bench_motion --json motion.json
  mplicits bench motion --noise 0.005 --figures arm -o bench_scans
  mplicits bench motion spot.obj bob.obj -o bench_pairs --pictures sheets""",
            _motion_arguments,
            _motion,
            "Train evolutions between key shapes of figures that bend, twist and walk in closed form, and measure "
            "surface, volume, area, components, carried points and stretched triangles at held-out moments, beside "
            "the blend of the key shapes' distances. Between two meshes there is no truth: then volume, area, parts, "
            "stretched triangles, and whether carried colours stay smooth.",
        ),
        "bench paper": PAPER,
        "bench scale": Command(
            "what millions of points cost, and what they gain",
            """  mplicits bench scale --preset fast
  mplicits bench scale armadillo.ply --points 100000 10000000 --json scale.json""",
            _scale_arguments,
            _scale,
            "Draw clouds of several sizes from one shape, fit and mesh each in a process of its own, and compare.",
        ),
        "bench srb": Command(
            "the surface reconstruction benchmark, beside what papers print",
            """  mplicits bench srb srb/ -o bench_srb --preset fast
  mplicits bench srb srb/ -o bench_srb --shapes anchor --rows none --json srb.json""",
            _srb_arguments,
            _srb,
            "Fit the scans of a folder with their normals and without, and measure every level against the true "
            "surfaces, in raw units and in the unit sphere, by the protocols of the papers.",
        ),
    }
)
