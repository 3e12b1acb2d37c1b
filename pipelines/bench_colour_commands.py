"""``mplicits bench texture`` and ``mplicits bench normal-map``: their arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

from .command import Command, add_json, check_output, positive, whole, write_json
from .run.config import add_config_flags, given_flags, load_config, preset_names
from .run.settings import FitConfig, TextureConfig

__all__ = ["NORMAL_MAP", "TEXTURE"]

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
    from .bench.texture import bench_texture, format_texture
    from .run.progress import progress_bars
    from .run.trainer import Interrupted

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
    from .bench.normal_map import bench_normal_map, format_normal_map

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
