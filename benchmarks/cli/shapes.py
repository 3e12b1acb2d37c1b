"""``python -m benchmarks …`` of what comes of a shape: fits of clouds and scans, textures, borrowed normals."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from mplicits.pipelines.cli.common import Command, add_flags, add_settings, check_output, positive, read_settings, whole
from mplicits.pipelines.training.settings import (
    FitConfig,
    TextureConfig,
    add_config_flags,
    given_flags,
    input_error,
    load_config,
    preset_names,
)

from .common import folder_flag, measured_flags, noise_of, noisy_flags, number, run_benches, view_flags


def _fit_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files")
    noisy_flags(parser)
    _compared_flags(parser)


def _compared_flags(parser: argparse.ArgumentParser) -> None:
    measured_flags(parser, 512)
    number(parser, "--poisson-depth", whole(4, 14), 10, "octree depth")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write two pictures of all methods per shape")
    folder_flag(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _fit(arguments: argparse.Namespace) -> int:
    config, noise = read_settings(arguments, FitConfig), noise_of(arguments)
    from ..shapes.fits import FitBench

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
    return run_benches(arguments, [bench], out=arguments.out)


def _uneven_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="*", metavar="SHAPE", help="mesh files; without any, eight exact shapes")
    number(parser, "--points", whole(1000), 30_000, "points drawn on each")
    parser.add_argument("--density", choices=("curvature", "scanner", "patches"), help="what the density follows")
    number(parser, "--ratio", positive, 30.0, "largest over smallest density")
    _compared_flags(parser)


def _uneven(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from ..shapes.uneven import UnevenBench

    bench = UnevenBench(
        shapes=arguments.shapes,
        config=config,
        points=arguments.points,
        density=arguments.density,
        ratio=arguments.ratio,
        folder=(arguments.out or Path()) / "shapes",
        resolution=arguments.resolution,
        samples=arguments.eval_samples,
        poisson_depth=arguments.poisson_depth,
        pictures=arguments.pictures,
    )
    return run_benches(arguments, [bench], out=arguments.out)


def _tiles_arguments(parser: argparse.ArgumentParser) -> None:
    number(parser, "--plots", whole(1), 4, "along each side of the town")
    number(parser, "--points", whole(10_000), 1_000_000, "of the scan")
    number(parser, "--workers", whole(1), 1, "tiles fitted at a time")
    names = ("tiles", "one network", "screened Poisson")
    parser.add_argument("--methods", nargs="+", choices=names, default=names, metavar="METHOD", help=", ".join(names))
    number(parser, "--poisson-depth", whole(4, 14), 11, "octree depth")
    measured_flags(parser, 1024)
    folder_flag(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _tiles(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from ..shapes.tiles import TilesBench

    names = ("plots", "points", "workers", "resolution", "eval_samples", "poisson_depth")
    options = {name: getattr(arguments, name) for name in names}
    bench = TilesBench(config=config, methods=tuple(arguments.methods), **options)
    return run_benches(arguments, [bench], out=arguments.out)


def _signs_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shapes", nargs="+", metavar="SHAPE", help="mesh files")
    noisy_flags(parser)
    folder_flag(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _signs(arguments: argparse.Namespace) -> int:
    config, noise = read_settings(arguments, FitConfig), noise_of(arguments)
    from ..shapes.signs import SignsBench

    options = {"noise": noise, "isotropic": arguments.isotropic, "points": arguments.points, "device": config.device}
    return run_benches(arguments, [SignsBench(shapes=arguments.shapes, config=config, **options)], out=arguments.out)


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
    measured_flags(parser, 512, 1_000_000)
    number(parser, "--poisson-depth", whole(4, 14), 10, "octree depth")
    folder_flag(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _srb(arguments: argparse.Namespace) -> int:
    if "normals" in given_flags(arguments, FitConfig):
        raise input_error("--normals: the benchmark fits with and without them; choose by --rows")
    config = read_settings(arguments, FitConfig)
    from ..shapes.srb import SrbBench

    options = {name: getattr(arguments, name) for name in ("folder", "shapes", "resolution", "poisson_depth")}
    bench = SrbBench(config=config, normals=arguments.rows, samples=arguments.eval_samples, **options)
    return run_benches(arguments, [bench], out=arguments.out)


def _official_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="where their archive was unpacked: with data/ in it")
    about = "their checkpoints, a folder with results/NAME/coarse/best.pth and so on, measured here as well"
    parser.add_argument("--official", type=Path, metavar="RESULTS", help=about)
    parser.add_argument("--shapes", nargs="+", default=(), metavar="NAME", help="only these (all)")
    about = "first write these meshes into DIR as their archive has them: in the unit sphere, and with noise"
    parser.add_argument("--add", nargs="+", type=Path, default=(), metavar="MESH", help=about)
    measured_flags(parser, 512, 500_000)
    folder_flag(parser)
    add_flags(parser, "--json")
    add_settings(parser, FitConfig)


def _official(arguments: argparse.Namespace) -> int:
    config = read_settings(arguments, FitConfig)
    from ..shapes.official import OfficialBench, add_shapes

    add_shapes(arguments.folder, arguments.add, seed=config.seed)
    options = {name: getattr(arguments, name) for name in ("folder", "shapes", "resolution")}
    bench = OfficialBench(config=config, results=arguments.official, samples=arguments.eval_samples, **options)
    return run_benches(arguments, [bench], out=arguments.out)


# The paper's (64,1), with a frequency and a schedule at which it is a closed surface that looks like the shape.
COARSE = FitConfig(widths=(64,), depths=(1,), omegas=(40.0,), steps=(1500,), learning_rates=(2e-2,), samples=200_000)


def _texture_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("meshes", nargs="+", metavar="MESH", help="OBJ, GLB or glTF with a texture")
    folder_flag(parser, required=True)
    view_flags(parser, views=6)
    coarse = parser.add_argument_group("coarse surface")
    number(coarse, "--coarse-width", whole(1), 64, "neurons per layer")
    number(coarse, "--coarse-depth", whole(1), 1, "sine layers")
    number(coarse, "--coarse-omega", positive, 40.0, "SIREN frequency")
    number(coarse, "--coarse-steps", whole(1), 1500, "training steps")
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
    from ..shapes.texture import TextureBench

    options = {name: getattr(arguments, name) for name in ("meshes", "views", "size", "up", "resolution")}
    bench = TextureBench(texture=texture, coarse=coarse, full=full, device=texture.device, **options)
    return run_benches(arguments, [bench], out=arguments.out)


def _normal_map_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument("reference", metavar="REFERENCE", help="the mesh that was fitted")
    about = "a .png or .jpg with all the images, or a folder that keeps them and the figures"
    parser.add_argument("-o", "--out", type=Path, metavar="PATH", help=about)
    shadings = ("headlight", "lambert", "normals")
    parser.add_argument("--shading", choices=shadings, default="headlight", help="what is compared")
    number(parser, "--repeats", whole(1), 2, "the best of how many")
    parser.add_argument("--device", default="auto", help="torch device (auto)")
    view_flags(parser, views=3)


def _normal_map(arguments: argparse.Namespace) -> int:
    out: Path | None = arguments.out
    picture = None
    if out is not None and out.suffix and not out.is_dir():
        check_output(out, (".png", ".jpg", ".jpeg"))
        picture, out = out, None
    elif out is not None:
        picture = out / "images.png"
    from ..shapes.normal_map import NormalMapBench

    names = ("reference", "shading", "size", "views", "up", "resolution", "repeats", "device")
    options = {name: getattr(arguments, name) for name in names}
    return run_benches(arguments, [NormalMapBench(run_file=arguments.run, picture=picture, **options)], out=out)


SOLIDS = ("box", "cylinder", "gear")


def _solid_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=SOLIDS, help="which one")
    add_flags(parser, "--out", help="a .ply file to write")


def _solid(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (".ply",))
    from mplicits.neural_fields import Mesh
    from mplicits.pipelines.mesh import write_mesh

    from ..shapes.prisms import PRISMS

    write_mesh(arguments.out, Mesh(*PRISMS[arguments.name]()))
    command = f"python -m benchmarks fit {arguments.out} --points 12000"
    print(f"{arguments.out}: an exact mesh; `{command}` fits points drawn on it")
    return 0


SHAPES: Mapping[str, Command] = MappingProxyType(
    {
        "solid": Command(
            "write the mesh of a solid with sharp edges",
            "  python -m benchmarks solid gear -o gear.ply",
            _solid_arguments,
            _solid,
        ),
        "fit": Command(
            "how near fits come: ours per level, screened Poisson",
            """  python -m benchmarks fit armadillo.ply --time-budget 180
  python -m benchmarks fit armadillo.ply bunny.ply --noise 0.01 --preset fast --pictures pictures""",
            _fit_arguments,
            _fit,
            "Fit the vertices of each mesh and measure the result against the mesh; Poisson needs mplicits[poisson].",
        ),
        "uneven": Command(
            "fits of clouds whose density varies over the shape",
            """  python -m benchmarks uneven --preset fast -o uneven --pictures uneven/pictures
  python -m benchmarks uneven armadillo.ply --density scanner --ratio 30""",
            _uneven_arguments,
            _uneven,
            "Draw uneven points on exact shapes, or on meshes, and compare every level with screened Poisson.",
        ),
        "tiles": Command(
            "a town that one network cannot hold",
            """  python -m benchmarks tiles --preset fast --workers 2 -o bench_tiles
  python -m benchmarks tiles --plots 12 --points 10000000 --methods tiles -o bench_tiles""",
            _tiles_arguments,
            _tiles,
            "Scan an exact town from the air and from its streets, fit it in tiles, by one network and by screened "
            "Poisson: distances, differences at borders of tiles, seconds and memory.",
        ),
        "signs": Command(
            "how many estimated normals point the wrong way",
            """  python -m benchmarks signs armadillo.ply
  python -m benchmarks signs armadillo.ply eiffel.ply --noise 0.005 --isotropic --json signs.json""",
            _signs_arguments,
            _signs,
            "Estimate the normals of the vertices of each mesh as a fit does, then by a network that is not told of "
            "signs (fit --normals none), and compare both with the exact ones.",
        ),
        "srb": Command(
            "the surface reconstruction benchmark, beside what papers print",
            """  python -m benchmarks srb srb/ -o bench_srb --preset fast
  python -m benchmarks srb srb/ -o bench_srb --shapes anchor --rows none --json srb.json""",
            _srb_arguments,
            _srb,
            "Fit the scans of a folder with their normals and without, and measure every level against the true "
            "surfaces, in raw units and in the unit sphere, by the protocols of the papers.",
        ),
        "official": Command(
            "the protocol of the paper's own code on its folders, beside its checkpoints",
            """  python -m benchmarks official m-plicits/ -o official --official m-plicits/results
  python -m benchmarks official shapes/ --add armadillo.ply bunny.ply -o official --preset fast""",
            _official_arguments,
            _official,
            "Fit the clean and the noisy inputs of dsilvavinicius/m-plicits, and measure every level, and its own "
            "checkpoints, as it does. Finished shapes are kept.",
        ),
        "texture": Command(
            "how near textures on coarse surfaces come to UV textures",
            """  python -m benchmarks texture spot.obj bob.obj -o bench_texture
  python -m benchmarks texture spot.obj -o bench_texture --full --fit-preset fast --json texture.json""",
            _texture_arguments,
            _texture,
            "Fit a coarse surface to each mesh, train a texture field around it, and compare unlit images of it with "
            "those of the mesh and its UV texture. Errors are in display RGB from 0 to 1.",
        ),
        "normal-map": Command(
            "what the normals of a fine level do for a coarse surface",
            """  python -m benchmarks normal-map runs/scan scan.ply
  python -m benchmarks normal-map runs/scan scan.ply --shading lambert --views 6 -o images.png""",
            _normal_map_arguments,
            _normal_map,
            "Compare shaded images of the levels of a run, and of the coarsest with the normals of the finest, with "
            "images of the mesh that was fitted.",
        ),
    }
)
