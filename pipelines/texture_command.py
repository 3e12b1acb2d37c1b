"""``mplicits texture``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from .command import Command, check_output, whole
from .run.config import add_config_flags, given_flags, input_error, load_config, preset_names
from .run.settings import TextureConfig

if TYPE_CHECKING:
    from .texture.train import FittedTexture

__all__ = ["COMMAND", "tell_texture"]


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
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--resume", action="store_true", help="continue an interrupted training, with its settings")
    begin.add_argument("--force", action="store_true", help="replace a texture that is there already")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    source = parser.add_mutually_exclusive_group()
    names = ", ".join(preset_names("texture"))
    source.add_argument("--preset", metavar="NAME", help=f"one of {names} (default: default)")
    source.add_argument("--config", type=Path, metavar="FILE", help="a YAML file of settings")
    add_config_flags(parser, TextureConfig)


def _texture(arguments: argparse.Namespace) -> int:
    preset, flags = arguments.config or arguments.preset, given_flags(arguments, TextureConfig)
    if arguments.resume and (preset or flags or arguments.level is not None):
        raise input_error("--resume: continues with its own settings; leave out --preset, --level and the rest")
    config = load_config(TextureConfig, preset or "default", flags, thing="texture")
    check_output(arguments.out, (".safetensors",))
    from .run.folder import TEXTURE_FILE, find_field
    from .texture.train import texture_run

    field = find_field(arguments.run)
    target = arguments.out or field.with_name(TEXTURE_FILE)
    if target.exists() and target.samefile(field):
        raise input_error(f"{target}: is the field itself; name another -o")
    _check_state(target, resume=arguments.resume, force=arguments.force)
    from .run.progress import progress_bars

    with nullcontext() if arguments.quiet else progress_bars() as report:
        fitted = texture_run(
            arguments.run,
            arguments.source,
            config,
            out=arguments.out,
            level=arguments.level,
            resume=arguments.resume,
            progress=report,
        )
    tell_texture(target, fitted)
    if not fitted.record["finished"]:
        where = "" if arguments.out is None else f" -o {arguments.out}"
        print(
            f"interrupted; the texture holds what was learnt so far; to continue: mplicits texture {arguments.run} "
            f"{arguments.source}{where} --resume",
            file=sys.stderr,
        )
        return 130
    return 0


def _check_state(target: Path, *, resume: bool, force: bool) -> None:
    """Refuse what would lose a texture or a training, or resume where there is nothing to resume."""
    from .run.folder import texture_state_file

    state = texture_state_file(target)
    if resume and not state.is_file():
        reason = "is finished" if target.exists() else "was not begun"
        raise input_error(f"{target}: {reason}, so there is nothing to resume; leave out --resume")
    if (target.exists() or state.is_file()) and not (resume or force):
        found = f"{target}: exists;" if target.exists() else f"{state}: an interrupted training;"
        hint = " --resume continues it," if state.is_file() else ""
        raise input_error(f"{found}{hint} --force replaces it, or choose another -o")


def tell_texture(target: Path, fitted: FittedTexture) -> None:
    """Print what has been trained, and warn of points that were left out."""
    record, config = fitted.record, fitted.record["config"]
    if record["left_out"]:
        everything = record["points"] + record["left_out"]
        print(
            f"warning: {record['left_out']:,} of {everything:,} points lie outside the band (--delta), left out",
            file=sys.stderr,
        )
    seconds = record["sampling_seconds"] + record["training_seconds"]
    print(
        f"{target}: ({config['width']}, {config['depth']}), {record['parameters']:,} parameters, "
        f"{record['steps']:,} steps in {seconds:.1f} s; {record['psnr_at_points']:.1f} dB at the points"
    )


COMMAND = Command(
    "train the colours of a fit from a coloured cloud or a textured mesh",
    """  mplicits texture runs/scan scan.ply
  mplicits texture runs/spot spot.obj
  mplicits texture runs/spot spot.glb --preset fast --force
  mplicits texture runs/scan scan.ply --resume
  mplicits texture runs/scan scan.ply -o other.safetensors --omega 40 --time-budget 30""",
    _arguments,
    _texture,
    "Train a texture field in the band around the surface of a run. It is written to texture.safetensors in RUN. "
    "The colours must be in the coordinates of the points that were fitted.",
)
