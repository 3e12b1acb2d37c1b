"""``mplicits render``: its arguments, and the checks before any work."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path

from .command import Command, check_output, positive, whole
from .run.config import add_config_flags, given_flags, input_error, load_config
from .run.progress import counter_bar
from .run.settings import SHADINGS, ShadeOptions

__all__ = ["COMMAND"]

PICTURES = (".png", ".jpg", ".jpeg")
FILMS = (".mp4", ".gif")
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "gray": (0.5, 0.5, 0.5), "transparent": None}
ORBIT_FLAGS = ("azimuth", "elevation", "up", "fov", "zoom")
# Settings that one shading alone heeds.
MEASURED = ("depth", "curvature", "error")
OWNED = {"limits": MEASURED, "matcap": ("matcap",), "reference": ("error",)}


def _between(low: float, high: float) -> Callable[[str], float]:
    """A converter for argparse: numbers from ``low`` to ``high``."""

    def convert(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if not low <= number <= high:
            raise argparse.ArgumentTypeError(f"got {text!r}, expected a number from {low:g} to {high:g}")
        return number

    return convert


def _color(text: str) -> tuple[float, float, float] | None:
    """A converter for argparse: a name or #rrggbb → display RGB in [0, 1]; None for transparent."""
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    if not re.fullmatch(r"#?[0-9a-fA-F]{6}", text):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected #rrggbb or one of {', '.join(BACKGROUNDS)}")
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red / 255, green / 255, blue / 255


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="RUN|MESH", help="run directory, .safetensors file, mesh or cloud")
    what = f"{', '.join(PICTURES)}; with {' or '.join(FILMS)} the camera goes around the shape"
    add("-o", "--out", required=True, type=Path, metavar="FILE", help=what)
    size = whole(1, 16384)
    add("--size", type=size, nargs="+", metavar="N", help="width, or width and height (640, or that of the images)")
    add("--time", type=_between(0, 1), metavar="T", help="the moment from 0 to 1, of a run that moves")
    add("--level", type=whole(0), metavar="L", help="0 is the coarsest (default: the finest)")
    add("--normal-level", type=whole(0), metavar="L", help="take the normals of this level (neural normal mapping)")
    add("--levels", action="store_true", help="all levels side by side, and the coarsest with the finest's normals")
    shadings = "; ".join(f"{name}: {text}" for name, text in SHADINGS.items())
    add("--shading", choices=tuple(SHADINGS), help=f"{shadings} (lambert)")
    add("--fast", action="store_true", help="no shadows, no occlusion")
    add("--reference", metavar="FILE", help="cloud or mesh for the error (default: what the run was fitted to)")
    add("--azimuth", type=_between(-3600, 3600), metavar="A", help="degrees around the up axis from the front (30)")
    add("--elevation", type=_between(-90, 90), metavar="E", help="degrees above the horizon (15)")
    add("--up", choices=("y", "z"), help="the axis that points up (y)")
    add("--fov", type=_between(0.1, 170), metavar="F", help="vertical angle of view, degrees (25)")
    add("--zoom", type=positive, metavar="Z", help="magnification of the middle (1: the whole shape)")
    add("--cameras", metavar="FILE", help="look from posed images instead: transforms.json or cameras_sphere.npz")
    add("--frame", metavar="NAME", help="which of them: a name, or an index from 0; a film goes through all")
    colors = f"#rrggbb or {', '.join(BACKGROUNDS)} (white)"
    add("--background", type=_color, default=BACKGROUNDS["white"], metavar="COLOR", help=colors)
    add("--no-legend", action="store_true", help="leave out the colour bar")
    add("--samples", type=whole(1, 8), default=2, metavar="N", help="rays per pixel and direction (2)")
    add("--frames", type=whole(1, 100_000), default=96, metavar="N", help="of a film around the shape (96)")
    add("--fps", type=positive, default=24.0, metavar="F", help="frames per second of a film (24)")
    add("--device", default="auto", help="where to evaluate the field: auto, cpu, cuda, ... (auto)")
    add_config_flags(parser, ShadeOptions, about="of the shading")


def _render(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (*PICTURES, *FILMS))
    given = given_flags(arguments, ShadeOptions)
    shading = _shading(arguments, given)
    _check(arguments)
    lit = not arguments.fast
    shade = load_config(ShadeOptions, overrides={"shadows": lit, "occlusion": lit, **given}, thing="render")

    from .render.draw import RenderOptions, render_run
    from .render.scene import Orbit

    chosen = {name: value for name in ORBIT_FLAGS if (value := getattr(arguments, name)) is not None}
    options = RenderOptions(
        size=None if arguments.size is None else tuple(arguments.size),
        time=arguments.time,
        level=arguments.level,
        normal_level=arguments.normal_level,
        levels=arguments.levels,
        shading=shading,
        shade=shade,
        reference=arguments.reference,
        orbit=Orbit(**chosen),
        cameras=arguments.cameras,
        frame=arguments.frame,
        background=arguments.background,
        legend=not arguments.no_legend,
        samples=arguments.samples,
        frames=arguments.frames,
        fps=arguments.fps,
        device=arguments.device,
    )
    started = time.monotonic()
    with counter_bar("render") as progress:
        drawn = render_run(arguments.source, arguments.out, options, progress=progress)
    print(f"{arguments.out}: {drawn}, in {time.monotonic() - started:.1f} s")
    return 0


def _shading(arguments: argparse.Namespace, given: dict[str, object]) -> str | None:
    """The shading that is asked for; a matcap or a reference asks for its own."""
    asked = {name for name in OWNED if name in given or getattr(arguments, name, None) is not None}
    if arguments.shading is None:
        wanted = [OWNED[name][0] for name in ("matcap", "reference") if name in asked]
        arguments.shading = wanted[0] if wanted else None
    for name in sorted(asked):
        if arguments.shading not in OWNED[name]:
            raise input_error(f"--{name}: goes with --shading {' or '.join(OWNED[name])}")
    return arguments.shading


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what does not go together."""
    if arguments.size is not None and len(arguments.size) > 2:
        raise input_error(f"--size: got {len(arguments.size)} numbers; expected a width, or a width and a height")
    for name in ("level", "normal_level"):
        if arguments.levels and getattr(arguments, name) is not None:
            raise input_error(f"--{name.replace('_', '-')}: --levels draws all of them; leave one of the two out")
    if arguments.background is None and (arguments.levels or arguments.out.suffix.lower() != ".png"):
        raise input_error("--background transparent: needs a .png of a single level; give it a colour")
    for name in ORBIT_FLAGS:
        if arguments.cameras is not None and getattr(arguments, name) is not None:
            raise input_error(f"--{name}: the cameras of {arguments.cameras} say where to look from; leave it out")


COMMAND = Command(
    "draw a fit, a mesh or a cloud: pictures and turntables",
    """  mplicits render runs/scan -o scan.png
  mplicits render runs/scan -o levels.png --levels --size 480
  mplicits render runs/scan -o mapped.png --level 0 --normal-level 2
  mplicits render runs/scan -o error.png --shading error --limits 0 0.01
  mplicits render runs/scan -o cutout.png --background transparent --size 1600 1200 --azimuth -40
  mplicits render runs/scan -o turntable.mp4 --frames 120 --fps 30
  mplicits render scan.ply -o mesh.png --up z
  mplicits render runs/scan -o view.png --cameras transforms.json --frame 12""",
    _arguments,
    _render,
    "Draw a field by sphere tracing, or a mesh or a cloud, from a camera around it or from those of posed images. "
    "Lengths and places are those of the input.",
)
