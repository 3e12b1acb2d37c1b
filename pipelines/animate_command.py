"""``mplicits animate``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from .command import Command, positive, whole
from .run.config import input_error
from .run.progress import counter_bar

__all__ = ["COMMAND"]

FILMS = (".mp4", ".gif", ".png")
SHADINGS = ("lambert", "headlight", "normals", "matcap", "color")
OF_FILMS = ("size", "up", "azimuth", "elevation", "zoom", "shading", "samples")


def _angle(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not abs(number) <= 3600:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected degrees")
    return number


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("run", metavar="RUN", help="run directory or .safetensors file of `mplicits evolve`")
    what = "an .mp4 or .gif film, a .png of all frames, a .glb of one mesh that moves, or a folder for one .ply a frame"
    add("-o", "--out", required=True, type=Path, metavar="OUT", help=what)
    add("--frames", type=whole(1, 100_000), default=48, metavar="N", help="times from 0 to 1 (48)")
    add("--fps", type=positive, default=24.0, metavar="F", help="frames per second (24)")
    add("--level", type=whole(0), metavar="L", help="0 is the coarsest (default: the finest)")
    add("--colors", metavar="RUN", help="a textured run of the first shape, to ride along (default: RUN's own)")
    add("--no-colors", action="store_true", help="leave colours out")
    add("--resolution", type=whole(8, 2048), metavar="N", help="meshes: cells per side (128)")
    add("--size", type=whole(16, 8192), nargs="+", metavar="N", help="film: width, or width and height (640)")
    add("--up", choices=("y", "z"), help="film: the axis that points up (y)")
    add("--azimuth", type=_angle, metavar="A", help="film: degrees around the up axis from the front (30)")
    add("--elevation", type=_angle, metavar="E", help="film: degrees above the horizon (15)")
    add("--zoom", type=positive, metavar="Z", help="film: magnification of the middle (1)")
    add("--shading", choices=SHADINGS, help="film: how it is shaded (lambert)")
    add("--shadows", action="store_true", help="film: shadows and occlusion, for twice the time or more")
    add("--samples", type=whole(1, 8), metavar="N", help="film: rays per pixel and direction (2)")
    add("--device", default="auto", help="where to evaluate the field: auto, cpu, cuda, … (auto)")


def _animate(arguments: argparse.Namespace) -> int:
    film = arguments.out.suffix.lower() in FILMS
    for name in OF_FILMS:
        if not film and getattr(arguments, name) is not None:
            raise input_error(f"--{name}: goes with a film (.mp4, .gif) or a sheet (.png)")
    if film and arguments.resolution is not None:
        raise input_error("--resolution: goes with meshes; a film is traced in pixels (--size)")
    if arguments.size is not None and len(arguments.size) > 2:
        raise input_error("--size: give the width, or width and height")
    if arguments.no_colors and arguments.colors is not None:
        raise input_error("--colors: --no-colors leaves them out; leave one of the two out")

    from .evolve.animate import SequenceOptions, animate_run
    from .render.scene import Orbit

    chosen = {name: getattr(arguments, name) for name in ("resolution", "shading", "samples")}
    orbit = {name: getattr(arguments, name) for name in ("up", "azimuth", "elevation", "zoom")}
    size = arguments.size or [640]
    options = SequenceOptions(
        frames=arguments.frames,
        fps=arguments.fps,
        size=(size[0], size[-1]),
        level=arguments.level,
        colors=arguments.colors,
        no_colors=arguments.no_colors,
        orbit=Orbit(**{name: value for name, value in orbit.items() if value is not None}),
        shadows=arguments.shadows,
        device=arguments.device,
        **{name: value for name, value in chosen.items() if value is not None},
    )
    started = time.monotonic()
    with counter_bar("animate") as progress:
        written = animate_run(arguments.run, arguments.out, options, progress=progress)
    print(f"{arguments.out}: {written}, in {time.monotonic() - started:.1f} s")
    return 0


COMMAND = Command(
    "write a surface that moves: a film, meshes, or one mesh that moves",
    """  mplicits animate runs/morph -o morph.mp4 --frames 96
  mplicits animate runs/morph -o morph.gif --size 320 --fps 12
  mplicits animate runs/morph -o morph.png --frames 14 --size 240
  mplicits animate runs/turn -o turn.glb --colors runs/spot
  mplicits animate runs/morph -o meshes --frames 20 --resolution 256""",
    _arguments,
    _animate,
    "Write the surface of an evolution at times from 0 to 1. Films are traced, each frame from what the last one knew. "
    "A .glb holds one mesh whose vertices follow the surface, as long as it neither tears nor joins.",
)
