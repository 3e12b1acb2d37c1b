"""``mplicits texture``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path

from .command import Command, check_output, whole
from .config import add_config_flags, given_flags, input_error, load_config, preset_names
from .texture_config import TextureConfig

__all__ = ["COMMAND"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument(
        "source",
        metavar="CLOUD|MESH",
        help="points with colours (PLY, NPZ, LAS, ...), or a mesh with a texture or vertex colours (OBJ, GLB, PLY)",
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help=".safetensors (default: texture.safetensors beside the field)"
    )
    parser.add_argument("--level", type=whole(0), metavar="L", help="0 is the coarsest (default: the finest)")
    parser.add_argument("--force", action="store_true", help="replace a texture that is there already")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names("texture"))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: default)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, TextureConfig)


def _texture(arguments: argparse.Namespace) -> int:
    preset = arguments.config or arguments.preset or "default"
    config = load_config(TextureConfig, preset, given_flags(arguments, TextureConfig), thing="texture")
    check_output(arguments.out, (".safetensors",))
    from .runs import find_field
    from .texture import TEXTURE_FILE, texture_run

    field = find_field(arguments.run)
    target = arguments.out or field.with_name(TEXTURE_FILE)
    if target.exists() and target.samefile(field):
        raise input_error(f"{target}: is the field itself; name another -o")
    if target.exists() and not arguments.force:
        raise input_error(f"{target}: exists; --force replaces it, or choose another -o")
    from .progress_bar import progress_bars

    with nullcontext() if arguments.quiet else progress_bars() as report:
        fitted = texture_run(
            arguments.run, arguments.source, config, out=arguments.out, level=arguments.level, progress=report
        )
    record = fitted.record
    if record["left_out"]:
        everything = record["points"] + record["left_out"]
        print(
            f"warning: {record['left_out']:,} of {everything:,} points lie outside the band (--delta), left out",
            file=sys.stderr,
        )
    seconds = record["sampling_seconds"] + record["training_seconds"]
    print(
        f"{target}: ({config.width}, {config.depth}), {record['parameters']:,} parameters, {record['steps']:,} steps "
        f"in {seconds:.1f} s; {record['psnr_at_points']:.1f} dB at the points"
    )
    if not record["finished"]:
        print("interrupted; the texture holds what was learnt so far", file=sys.stderr)
        return 130
    return 0


COMMAND = Command(
    "train the colours of a fit from a coloured cloud or a textured mesh",
    """  mplicits texture runs/scan scan.ply
  mplicits texture runs/spot spot.obj
  mplicits texture runs/spot spot.glb --preset fast --force
  mplicits texture runs/scan scan.ply -o other.safetensors --omega 40 --time-budget 30""",
    _arguments,
    _texture,
    "Train a texture field in the band around the surface of a run. It is written to texture.safetensors in RUN. "
    "The colours must be in the coordinates of the points that were fitted.",
)
