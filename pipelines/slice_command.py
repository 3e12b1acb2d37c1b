"""``mplicits slice``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import math
import time
from contextlib import nullcontext
from pathlib import Path

from .command import Command, check_output, positive, whole
from .run.config import input_error
from .run.progress import counter_bar

__all__ = ["COMMAND"]

PICTURES = (".png", ".jpg", ".jpeg")
FILMS = (".mp4", ".gif")


def _finite(text: str) -> float:
    """A converter for argparse: finite numbers."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number")
    return number


def _place(text: str) -> tuple[float, bool]:
    """A converter for argparse: a coordinate, or a number and % → (number, whether it is per cent)."""
    number = _finite(text.removesuffix("%"))
    if text.endswith("%") and not 0 <= number <= 100:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected 0% to 100%, or a coordinate")
    return number, text.endswith("%")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument(
        "-o",
        "--out",
        required=True,
        type=Path,
        metavar="FILE",
        help=f"{', '.join(PICTURES)}; with {' or '.join(FILMS)} the plane sweeps through the shape",
    )
    parser.add_argument("--level", type=whole(0), metavar="L", help="0 is the coarsest (default: the finest)")
    direction = parser.add_mutually_exclusive_group()
    direction.add_argument("--axis", choices=("x", "y", "z"), default="z", help="the plane is across this axis (z)")
    direction.add_argument(
        "--normal", type=_finite, nargs=3, metavar=("NX", "NY", "NZ"), help="or it is seen from this direction"
    )
    parser.add_argument(
        "--at", type=_place, metavar="C", help="coordinate on the axis, or per cent of the shape's extent: 30%% (50%%)"
    )
    parser.add_argument(
        "--point", type=_finite, nargs=3, metavar=("X", "Y", "Z"), help="with --normal: a point of the plane"
    )
    parser.add_argument("--up", choices=("y", "z"), default="y", help="the axis that points up in the picture (y)")
    parser.add_argument(
        "--size", type=whole(64, 8192), nargs="+", default=[800], metavar="N", help="width, or width and height (800)"
    )
    parser.add_argument("--iso", type=whole(2, 400), default=40, metavar="N", help="about so many iso-lines fit (40)")
    parser.add_argument("--zoom", type=positive, default=1.0, metavar="Z", help="magnification (1: the whole shape)")
    parser.add_argument(
        "--center", type=_finite, nargs=3, metavar=("X", "Y", "Z"), help="what to zoom in on (default: the middle)"
    )
    parser.add_argument("--no-bands", action="store_true", help="leave out the bands |f_i| < δ_i")
    parser.add_argument("--frames", type=whole(1, 100_000), default=96, metavar="N", help="of a film (96)")
    parser.add_argument("--fps", type=positive, default=24.0, metavar="F", help="frames per second of a film (24)")


def _slice(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (*PICTURES, *FILMS))
    film = arguments.out.suffix.lower() in FILMS
    for flag, value in (("--at", arguments.at), ("--point", arguments.point)):
        if film and value is not None:
            raise input_error(f"{flag}: a film goes through the whole shape; leave it out, or write a picture (.png)")
    if arguments.at is not None and arguments.normal is not None:
        raise input_error("--at: is a place on an axis; with --normal say --point X Y Z")
    if arguments.point is not None and arguments.normal is None:
        raise input_error("--point: goes with --normal; with --axis say --at C")
    if arguments.normal is not None and not any(arguments.normal):
        raise input_error("--normal: has no direction; give three numbers that are not all 0")
    if len(arguments.size) > 2:
        raise input_error(f"--size: got {len(arguments.size)} numbers; expected a width, or a width and a height")

    from .render.slicing import SliceOptions, slice_run

    number, percent = arguments.at or (None, False)
    options = SliceOptions(
        level=arguments.level,
        axis=arguments.axis,
        at=None if percent else number,
        percent=number if percent else None,
        normal=_triple(arguments.normal),
        point=_triple(arguments.point),
        up=arguments.up,
        size=(arguments.size[0], arguments.size[-1]),
        lines=arguments.iso,
        zoom=arguments.zoom,
        center=_triple(arguments.center),
        bands=not arguments.no_bands,
        frames=arguments.frames,
        fps=arguments.fps,
    )
    started = time.monotonic()
    with counter_bar("slices") if film else nullcontext() as bar:
        progress = None if bar is None else lambda done: bar(done, arguments.frames)
        drawn = slice_run(arguments.run, arguments.out, options, progress=progress)
    print(f"{arguments.out}: {drawn}, in {time.monotonic() - started:.1f} s")
    return 0


def _triple(values: list[float] | None) -> tuple[float, float, float] | None:
    return None if values is None else (values[0], values[1], values[2])


COMMAND = Command(
    "draw a plane through a field: distances, surfaces and bands",
    """  mplicits slice runs/scan -o slice.png
  mplicits slice runs/scan -o side.png --axis x --at 40%
  mplicits slice runs/scan -o detail.png --at 0.1 --zoom 8 --center 0.35 0.45 0
  mplicits slice runs/scan -o oblique.png --normal 1 0 1 --point 0 0.2 0
  mplicits slice runs/scan -o sweep.mp4 --axis y --frames 120""",
    _arguments,
    _slice,
    "Draw a plane through a field: sign and distance as colour, iso-lines, the surface of every level, and the bands "
    "in which the levels are evaluated. Coordinates are those of the input.",
)
