"""``python -m benchmarks …`` of what comes of photographs, and of shapes that move."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from mplicits.pipelines.cli.common import (
    Command,
    add_flags,
    add_settings,
    picture_size,
    positive,
    read_settings,
    whole,
)
from mplicits.pipelines.cli.views import SCENE_NAMES
from mplicits.pipelines.training.settings import EvolveConfig, ReconstructConfig, given_flags, input_error, load_config

from .common import folder_flag, measured_flags, number, run_benches

if TYPE_CHECKING:
    from ..harness.benchmark import Benchmark

GEOMETRIES = ("multiscale", "neus", "single")  # those of `bench.geometries`


def _reconstruct_arguments(parser: argparse.ArgumentParser) -> None:
    what = f"an exact scene ({', '.join(SCENE_NAMES)}), or the path of posed photographs"
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help=what)
    folder_flag(parser)
    number(parser, "--views", whole(2, 10_000), 24, "of an exact scene")
    number(parser, "--size", whole(8, 4096), 64, "of an exact scene's images")
    number(parser, "--test-views", whole(1), 8, "measure at most so many held-out views")
    parser.add_argument(
        "--equal-time",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="train ours once more, for as long as NeuS took (yes)",
    )
    measured_flags(parser, 256)
    what = "peak rate of the NeuS rows (0.001)"
    parser.add_argument("--neus-learning-rate", type=positive, metavar="RATE", help=what)
    alone = parser.add_argument_group("the geometry alone")
    about = "the same colour network, encodings and rates for the multiscale geometry, NeuS's and one SIREN of its size"
    alone.add_argument("--geometry-only", action="store_true", help=about)
    number(alone, "--seeds", whole(2, 100), 3, "trainings of each geometry with its rate")
    about = "peak rates, all tried with the first seed; each geometry keeps its best one (--learning-rate)"
    alone.add_argument("--rates", nargs="+", type=positive, metavar="RATE", help=about)
    about = f"which of them (all): {', '.join(GEOMETRIES)}"
    alone.add_argument("--geometries", nargs="+", choices=GEOMETRIES, metavar="NAME", help=about)
    about = "trainings at a time, each in a stream of the GPU, which one alone does not fill"
    number(alone, "--streams", whole(1, 64), 1, about)
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
    from mplicits.pipelines.training.progress import counter_bar

    from ..scenes.reconstruct import ReconstructBench, read_scene

    scenes = []
    for name in arguments.scenes:
        with counter_bar(name) as progress:
            scenes.append(
                read_scene(name, views=arguments.views, size=arguments.size, width=config.width, progress=progress)
            )
    options = {name: getattr(arguments, name) for name in ("test_views", "resolution")}
    options |= {"samples": arguments.eval_samples, "device": config.device}
    if arguments.geometry_only:
        from ..scenes.geometries import GeometryBench

        options["rates"] = tuple(dict.fromkeys(arguments.rates or (config.learning_rate,)))
        if arguments.geometries:
            options["geometries"] = tuple(dict.fromkeys(arguments.geometries))
        options |= {"seeds": arguments.seeds, "streams": arguments.streams}
        alone = GeometryBench(scenes=scenes, config=config, **options)
        return run_benches(arguments, [alone], out=arguments.out, streams=arguments.streams)
    options["equal_time"] = arguments.equal_time
    if arguments.neus_learning_rate is not None:
        options["neus_learning_rate"] = arguments.neus_learning_rate
    return run_benches(arguments, [ReconstructBench(scenes=scenes, config=config, **options)], out=arguments.out)


PART_NAMES = ("none", "correlation", "flatness", "both")  # those of `consistency.PARTS`


def _consistency_arguments(parser: argparse.ArgumentParser) -> None:
    folder_flag(parser)
    parser.add_argument(
        "--scene", choices=SCENE_NAMES, default="corner", metavar="NAME", help="an exact scene (corner)"
    )
    number(parser, "--views", whole(2, 10_000), 49, "of the scene")
    what = "images of N × N pixels, or of W × H (200x150)"
    parser.add_argument("--size", type=picture_size, default=(200, 150), metavar="N|WxH", help=what)
    number(parser, "--samples", whole(1, 16), 2, "rays per pixel and direction of the images")
    what = "of the comparison, one for each training: none, correlation, flatness or both (each of these)"
    parser.add_argument("--parts", choices=PART_NAMES, default=PART_NAMES, nargs="+", metavar="NAME", help=what)
    number(parser, "--seeds", whole(1), 1, "trainings of each, with seeds that follow each other")
    measured_flags(parser, 256, 300_000)
    add_flags(parser, "--json")
    add_settings(parser, ReconstructConfig, about="of all trainings")


def _consistency(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, ReconstructConfig)
    if "consistency" not in given_flags(arguments, ReconstructConfig):
        config = replace(config, consistency=0.5)
    if not config.consistency:
        raise input_error("--consistency 0: trainings differ in the parts of this term; give it a weight")
    from ..scenes.consistency import ConsistencyBench

    names = "scene", "views", "size", "parts", "seeds", "resolution", "eval_samples"
    options = {name: getattr(arguments, name) for name in names}
    bench = ConsistencyBench(rays=arguments.samples, config=config, device=config.device, **options)
    return run_benches(arguments, [bench], out=arguments.out)


FAULTS = ("poses", "pose", "image", "mirrored", "masks", "holes", "exposure")


def _fault_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("photos", metavar="DATA", help="posed photographs, three or more")
    parser.add_argument("fault", choices=FAULTS, metavar="FAULT", help=", ".join(FAULTS))
    add_flags(parser, "--out", metavar="DIR", help="a folder that is not there yet")
    add_flags(parser, "--seed", help="of the fault (0)")


def _fault(arguments: argparse.Namespace) -> int:
    from mplicits.datasets import read_posed_images, write_neus
    from mplicits.datasets.views.writing import check_new_folder

    from ..scenes.view_faults import with_fault

    folder, images = check_new_folder(arguments.out), read_posed_images(arguments.photos)
    if len(images.views) < 3:
        raise input_error(f"{arguments.photos}: {len(images.views)} photographs; the third has the fault, so give more")
    write_neus(folder, with_fault(images, arguments.fault, arguments.seed))
    print(f"{folder}: {len(images.views)} photographs with the fault {arguments.fault!r}")
    return 0


FROM_CASES = ("kind", "shapes", "times", "velocity", "axis", "center", "angle", "twist", "alpha")


def _evolve_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--meshes", nargs=2, type=Path, metavar=("A", "B"), help="morph between the fits of these meshes as well"
    )
    folder_flag(parser)
    parser.add_argument(
        "--trace",
        metavar="RUN",
        help="time the dynamic tracer on this run of `mplicits evolve` (with --meshes: the morph)",
    )
    number(parser, "--size", whole(16, 4096), 512, "pixels squared of --trace")
    parser.add_argument("--no-exact", action="store_true", help="leave out the exact cases")
    number(parser, "--mesh-resolution", whole(8, 2048), 256, "with --meshes and --trace")
    number(parser, "--eval-samples", whole(1), 500_000, "per surface")
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
    from ..motion.dynamic import DynamicBench
    from ..motion.evolve import ExactBench, MorphBench

    benches: list[Benchmark[Any]] = [] if arguments.no_exact else [ExactBench(config=exact)]
    resolution, samples = arguments.mesh_resolution, arguments.eval_samples
    morph = None
    if arguments.meshes:
        morph = MorphBench(meshes=tuple(arguments.meshes), config=given, resolution=resolution, samples=samples)
        benches.append(morph)
    if arguments.meshes or arguments.trace:
        benches.append(DynamicBench(run_file=arguments.trace, morph=morph, size=arguments.size, resolution=resolution))
    return run_benches(arguments, benches, out=arguments.out)


def _motion_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "meshes", nargs="*", type=Path, metavar="MESH", help="in place of figures: pairs of meshes, A B"
    )
    parser.add_argument(
        "--kinds", nargs="+", choices=_from_shape_to_shape(), metavar="KIND", help="of evolve (all from shape to shape)"
    )
    parser.add_argument("--figures", nargs="+", metavar="NAME", help="of these figures alone: arm, bar, walker (all)")
    number(parser, "--keys", whole(2, 100), None, "key shapes, at even times (5)")
    number(
        parser, "--noise", positive, None, "fit scans of the key shapes, with this deviation in diagonals (no scans)"
    )
    number(parser, "--moments", whole(1, 1000), 20, "held-out times that are measured")
    number(parser, "--mesh-resolution", whole(8, 2048), 96, "of the meshes that are measured")
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="of pairs: sheets of moments, with carried colours"
    )
    folder_flag(parser)
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
    from ..motion.motion import FIGURES, MotionBench

    figures, noise = tuple(arguments.figures or FIGURES), arguments.noise
    bench = MotionBench(figures=figures, keys=arguments.keys or 5, noise=noise, **measured)
    return run_benches(arguments, [bench], out=arguments.out)


def _motion_of_pairs(arguments: argparse.Namespace, measured: dict[str, Any]) -> int:
    for name in ("figures", "keys", "noise"):
        if getattr(arguments, name) is not None:
            raise input_error(f"--{name}: is of figures; leave it out, or the meshes")
    meshes = arguments.meshes
    if len(meshes) % 2:
        raise input_error(f"{len(meshes)} meshes: expected pairs, A B or A B C D and so on")
    if arguments.moments < 2:
        raise input_error(f"--moments {arguments.moments}: between two meshes 2 are measured at least, the ends")
    from ..motion.pairs import PairBench

    pairs = tuple(zip(meshes[::2], meshes[1::2], strict=True))
    return run_benches(arguments, [PairBench(pairs=pairs, pictures=arguments.pictures, **measured)], out=arguments.out)


SCENES: Mapping[str, Command] = MappingProxyType(
    {
        "reconstruct": Command(
            "the multiscale geometry against the network of NeuS",
            """  python -m benchmarks reconstruct painted-sphere figure -o bench --preset fast
  python -m benchmarks reconstruct data/dtu_scan24 -o bench --width 400 --steps 20000 --json scan24.json""",
            _reconstruct_arguments,
            _reconstruct,
            "Train the network of NeuS and the multiscale geometry on the same rays of posed photographs: PSNR of "
            "held-out views, Chamfer distance where the surface is known, parameters, time and FLOPs.",
        ),
        "consistency": Command(
            "photographs compared with each other, on an exact scene",
            """  python -m benchmarks consistency -o bench
  python -m benchmarks consistency --size 400x300 --parts none both --steps 1000000 --time-budget 720 -o bench""",
            _consistency_arguments,
            _consistency,
            "Train on photographs of an exact scene with and without each part of the comparison of photographs: "
            "accuracy, completeness, flat walls, edges, held-out views, seconds and memory.",
        ),
        "fault": Command(
            "posed photographs with something wrong",
            "  python -m benchmarks fault figure poses -o unsharp",
            _fault_arguments,
            _fault,
            "Make one thing wrong with posed photographs (`mplicits scene` draws some), to see what `check-cameras` "
            "says of it and what a training survives; written in the format of NeuS.",
        ),
        "evolve": Command(
            "surfaces that move: exact cases, and morphs of meshes",
            """  python -m benchmarks evolve
  python -m benchmarks evolve --meshes spot.obj bob.obj -o bench_evolve --json evolve.json
  python -m benchmarks evolve --no-exact --trace runs/morph""",
            _evolve_arguments,
            _evolve,
            "Train evolutions that are known in closed form and measure their surfaces at 20 times; with --meshes, fit "
            "two meshes, morph between the fits, measure both ends against the meshes, and time the dynamic tracer on "
            "the morph.",
        ),
        "motion": Command(
            "motions between key shapes, at moments that were held out",
            """  python -m benchmarks motion
  python -m benchmarks motion --kinds morph --keys 3 --moments 12 -o bench_motion --json motion.json
  python -m benchmarks motion --noise 0.005 --figures arm -o bench_scans
  python -m benchmarks motion spot.obj bob.obj -o bench_pairs --pictures sheets""",
            _motion_arguments,
            _motion,
            "Train evolutions between key shapes of figures that bend, twist and walk in closed form, and measure "
            "surface, volume, area, components, carried points and stretched triangles at held-out moments, beside "
            "the blend of the key shapes' distances. Between two meshes there is no truth: then volume, area, parts, "
            "stretched triangles, and whether carried colours stay smooth.",
        ),
    }
)
