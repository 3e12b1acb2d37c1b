"""The commands that draw: ``mplicits render``, ``slice``, ``animate`` and ``view``."""

from __future__ import annotations

import argparse
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ..training.settings import SHADINGS, ShadeOptions, add_config_flags, given_flags, input_error, load_config
from .common import Command, add_flags, between, check_output, finite, refuse, whole

PICTURES = (".png", ".jpg", ".jpeg")
FILMS = (".mp4", ".gif")
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "gray": (0.5, 0.5, 0.5), "transparent": None}
RADIANCE = "radiance"
MEASURED = ("depth", "curvature", "error")  # shadings that show numbers


def _draw(out: Path, title: str | None, work: Callable[[Callable[[int, int], None] | None], str]) -> int:
    """Do the work, which says what it has drawn, and say that; with a progress bar if it has a title."""
    from ..training.progress import counter_bar

    started = time.monotonic()
    with nullcontext() if title is None else counter_bar(title) as progress:
        drawn = work(progress)
    print(f"{out}: {drawn}, in {time.monotonic() - started:.1f} s")
    return 0


def _check_size(size: Sequence[int] | None) -> None:
    if size is not None and len(size) > 2:
        raise input_error(f"--size: got {len(size)} numbers; expected a width, or a width and a height")


def _pair(size: Sequence[int] | None) -> Sequence[int] | None:
    """``--size`` as width and height; one number stands for both."""
    _check_size(size)
    return None if size is None else (size[0], size[-1])


def _color(text: str) -> tuple[float, float, float] | None:
    """A converter for argparse: a name or #rrggbb → display RGB in [0, 1]; None for transparent."""
    if text in BACKGROUNDS:
        return BACKGROUNDS[text]
    if not re.fullmatch(r"#?[0-9a-fA-F]{6}", text):
        raise argparse.ArgumentTypeError(f"got {text!r}, expected #rrggbb or one of {', '.join(BACKGROUNDS)}")
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red / 255, green / 255, blue / 255


def _render_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="RUN|MESH", help="run directory, .safetensors file, mesh or cloud")
    what = f"{', '.join(PICTURES)}; with {' or '.join(FILMS)} the camera goes around the shape"
    add_flags(parser, "--out", help=what)
    add_flags(parser, "--size", help="width, or width and height (640, or that of the images)")
    add_flags(parser, "--time", "--level")
    add_flags(parser, "--normal-level", help="take the normals of this level (neural normal mapping)")
    add("--levels", action="store_true", help="all levels side by side, and the coarsest with the finest's normals")
    shadings = "; ".join(f"{name}: {text}" for name, text in SHADINGS.items())
    photographed = f"{RADIANCE}: of a reconstruct run, as photographs show it, by volume rendering"
    add("--shading", choices=(*SHADINGS, RADIANCE), help=f"{shadings}; {photographed} (lambert)")
    add("--fast", action="store_true", help="no shadows, no occlusion")
    add("--reference", metavar="FILE", help="cloud or mesh for the error (default: what the run was fitted to)")
    add_flags(parser, "--azimuth", "--elevation", "--up")
    add("--fov", type=between(0.1, 170), metavar="F", help="vertical angle of view, degrees (25)")
    add_flags(parser, "--zoom", help="magnification of the middle (1: the whole shape)")
    add("--sides", type=whole(1, 12), metavar="N", help="from N directions around it, side by side (1)")
    add("--cameras", metavar="FILE", help="look from posed images instead: transforms.json or cameras_sphere.npz")
    add("--frame", metavar="NAME", help="which of them: a name, or an index from 0; a film goes through all")
    colors = f"#rrggbb or {', '.join(BACKGROUNDS)} (white)"
    add("--background", type=_color, default=BACKGROUNDS["white"], metavar="COLOR", help=colors)
    add("--no-legend", dest="legend", action="store_false", help="leave out the colour bar")
    add_flags(parser, "--samples", "--fps", "--device")
    add_flags(parser, "--frames", help="of a film around the shape (96)")
    add_config_flags(parser, ShadeOptions, about="of the shading")


def _render(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (*PICTURES, *FILMS))
    given = given_flags(arguments, ShadeOptions)
    arguments.shading = _shading(arguments, given)
    _check(arguments)
    lit = not arguments.fast
    shade = load_config(ShadeOptions, overrides={"shadows": lit, "occlusion": lit, **given})

    from ..render.draw import Orbit, RenderOptions, render_run

    chosen: dict[str, Any] = given_flags(arguments, RenderOptions) | {"background": arguments.background}
    draw = render_run
    if arguments.shading == RADIANCE:
        from ..reconstruct.photograph import photograph

        draw = photograph
        # A photograph's ray goes through the middle of its pixel, as in training; more cost as much again.
        chosen = {"samples": 1} | chosen
    options = RenderOptions(shade=shade, orbit=Orbit(**given_flags(arguments, Orbit)), **chosen)
    return _draw(arguments.out, "render", lambda bar: draw(arguments.source, arguments.out, options, progress=bar))


def _shading(arguments: argparse.Namespace, given: dict[str, object]) -> str | None:
    """The shading given by a flag; ``--reference`` implies its own."""
    shading = arguments.shading or (None if arguments.reference is None else "error")
    if arguments.reference is not None and shading != "error":
        raise input_error("--reference: goes with --shading error")
    if "limits" in given and shading not in MEASURED:
        raise input_error(f"--limits: goes with --shading {' or '.join(MEASURED)}")
    return shading


def _check(arguments: argparse.Namespace) -> None:
    """Refuse what does not go together."""
    _check_size(arguments.size)
    if arguments.levels:
        refuse(arguments, ("level", "normal_level"), "--levels draws all of them; leave one of the two out")
    if arguments.shading == RADIANCE and arguments.background != BACKGROUNDS["white"]:
        raise input_error(f"--background: --shading {RADIANCE} has that of the photographs; leave it out")
    if arguments.background is None and (
        arguments.levels or (arguments.sides or 1) > 1 or arguments.out.suffix.lower() != ".png"
    ):
        raise input_error("--background transparent: needs a .png of a single level and side; give it a colour")
    if arguments.cameras is not None:
        why = f"the cameras of {arguments.cameras} say where to look from; leave it out"
        refuse(arguments, ("azimuth", "elevation", "up", "fov", "zoom"), why)


RENDER = Command(
    "draw a fit, a mesh or a cloud: pictures and turntables",
    """  mplicits render runs/scan -o scan.png
  mplicits render runs/scan -o levels.png --levels --size 480
  mplicits render runs/scan -o mapped.png --level 0 --normal-level 2
  mplicits render runs/scan -o error.png --shading error --limits 0 0.01
  mplicits render runs/scan -o cutout.png --background transparent --size 1600 1200 --azimuth -40
  mplicits render runs/scan -o turntable.mp4 --frames 120 --fps 30
  mplicits render scan.ply -o mesh.png --up z
  mplicits render scan.ply -o sides.png --sides 4 --azimuth 0 --size 400
  mplicits render runs/scan -o view.png --cameras transforms.json --frame 12""",
    _render_arguments,
    _render,
    "Draw a field by sphere tracing, or a mesh or a cloud, from a camera around it or from those of posed images. "
    "Lengths and places are those of the input.",
)


def _place(text: str) -> dict[str, float]:
    """A converter for argparse: a coordinate, or a number and % → that field of `SliceOptions`."""
    number = finite(text.removesuffix("%"))
    if text.endswith("%") and not 0 <= number <= 100:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected 0% to 100%, or a coordinate")
    return {"percent" if text.endswith("%") else "at": number}


def _slice_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add_flags(parser, "run", "--level")
    what = f"{', '.join(PICTURES)}; with {' or '.join(FILMS)} the plane sweeps through the shape"
    add_flags(parser, "--out", help=what)
    add("--axis", choices=("x", "y", "z"), help="the plane is across this axis (z)")
    add("--at", type=_place, metavar="C", help="coordinate on the axis, or per cent of the shape's extent: 30%% (50%%)")
    add_flags(parser, "--up", help="the axis that points up in the picture (y)")
    add_flags(parser, "--size", type=whole(64, 8192), help="width, or width and height (800)")
    add("--iso", dest="lines", type=whole(2, 400), metavar="N", help="about so many iso-lines fit (40)")
    add_flags(parser, "--zoom", help="magnification (1: the whole shape)")
    add("--center", type=finite, nargs=3, metavar=("X", "Y", "Z"), help="what to zoom in on (default: the middle)")
    add("--no-bands", dest="bands", action="store_false", help="leave out the bands |f_i| < δ_i")
    add_flags(parser, "--frames", help="of a film (96)")
    add_flags(parser, "--fps")


def _slice(arguments: argparse.Namespace) -> int:
    check_output(arguments.out, (*PICTURES, *FILMS))
    film = arguments.out.suffix.lower() in FILMS
    if film:
        refuse(arguments, ["at"], "a film goes through the whole shape; leave it out, or write a picture (.png)")
    arguments.size = _pair(arguments.size)

    from ..render.slicing import SliceOptions, slice_run

    given = given_flags(arguments, SliceOptions)
    place = given.pop("at", {})
    options = SliceOptions(**given, **place)
    title = "slices" if film else None
    return _draw(arguments.out, title, lambda bar: slice_run(arguments.run, arguments.out, options, progress=bar))


SLICE = Command(
    "draw a plane through a field: distances, surfaces and bands",
    """  mplicits slice runs/scan -o slice.png
  mplicits slice runs/scan -o side.png --axis x --at 40%
  mplicits slice runs/scan -o detail.png --at 0.1 --zoom 8 --center 0.35 0.45 0
  mplicits slice runs/scan -o sweep.mp4 --axis y --frames 120""",
    _slice_arguments,
    _slice,
    "Draw a plane through a field: sign and distance as colour, iso-lines, the surface of every level, and the bands "
    "in which the levels are evaluated. Coordinates are those of the input.",
)


def _animate_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("run", metavar="RUN", help="run directory or .safetensors file of `mplicits evolve`")
    what = "an .mp4 or .gif film, a .png of all frames, a .glb of one mesh that moves, or a folder for one .ply a frame"
    add_flags(parser, "--out", metavar="OUT", help=what)
    add_flags(parser, "--frames", help="times from 0 to 1 (48)")
    add_flags(parser, "--fps", help="frames per second (24)")
    add("--ease", action="store_true", help="begin and end at rest, instead of times that are evenly spaced")
    add("--loop", action="store_true", help="film: there and back, so that it can repeat without a jump")
    add_flags(parser, "--level", "--device")
    add("--colors", metavar="RUN", help="a textured run of the first shape, to transport (default: RUN's own)")
    add("--last-colors", metavar="RUN", help="a textured run of the last shape, whose colours fade in on the way")
    add("--no-colors", action="store_true", help="leave colours out")
    add_flags(parser, "--resolution", help="meshes: cells per side (128)")
    add_flags(parser, "--size", type=whole(16, 8192), help="film: width, or width and height (640)")
    add_flags(parser, "--up", of="film, and a .glb, which is turned y-up: ")
    add_flags(parser, "--azimuth", "--elevation", "--samples", of="film: ")
    add_flags(parser, "--zoom", help="film: magnification of the middle (1)")
    add("--shading", choices=("lambert", "headlight", "normals", "color"), help="film: how it is shaded (lambert)")
    add("--shadows", action="store_true", help="film: shadows and occlusion, for twice the time or more")


def _animate(arguments: argparse.Namespace) -> int:
    film = arguments.out.suffix.lower() in (*FILMS, ".png")
    if film:
        refuse(arguments, ["resolution"], "goes with meshes; a film is traced in pixels (--size)")
    else:
        of_films = ("size", "up", "azimuth", "elevation", "zoom", "shading", "samples")
        refuse(arguments, of_films, "goes with a film (.mp4, .gif) or a sheet (.png)")
    if arguments.out.suffix.lower() not in FILMS:
        refuse(arguments, ["loop"], "goes with a film (.mp4, .gif)")
    arguments.size = _pair(arguments.size)
    if arguments.no_colors:
        refuse(arguments, ("colors", "last_colors"), "--no-colors leaves them out; leave one of the two out")

    from ..evolve.animate import SequenceOptions, animate_run
    from ..render.draw import Orbit

    given = given_flags(arguments, SequenceOptions)
    options = SequenceOptions(orbit=Orbit(**given_flags(arguments, Orbit)), **given)
    return _draw(arguments.out, "animate", lambda bar: animate_run(arguments.run, arguments.out, options, progress=bar))


ANIMATE = Command(
    "write a surface that moves: a film, meshes, or one mesh that moves",
    """  mplicits animate runs/morph -o morph.mp4 --frames 96
  mplicits animate runs/morph -o morph.gif --size 320 --fps 12 --ease --loop
  mplicits animate runs/morph -o morph.png --frames 14 --size 240
  mplicits animate runs/turn -o turn.glb --colors runs/spot
  mplicits animate runs/morph -o meshes --frames 20 --resolution 256""",
    _animate_arguments,
    _animate,
    "Write the surface of an evolution at times from 0 to 1. Films are traced, each frame from what the last one knew. "
    "A .glb holds one mesh whose vertices follow the surface, as long as it neither tears nor joins.",
)


def _view_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("run", metavar="RUN|FILE", help="run directory, .safetensors file, mesh or cloud")
    add("other", nargs="?", metavar="OTHER", help="with --landmarks: the run to pick the same points on")
    add("--landmarks", type=Path, metavar="FILE", help="click pairs of points on RUN and OTHER, kept for `evolve`")
    add_flags(parser, "--time")
    add_flags(parser, "--up", default="y")
    add("--cloud", metavar="FILE", help="a cloud beside the field (default: what the run was fitted to)")
    add("--host", default="127.0.0.1", help="address to listen on (127.0.0.1: this machine only)")
    add("--port", type=whole(1, 65535), metavar="N", help="port to listen on (default: a free one from 8080 up)")
    add("--open", action=argparse.BooleanOptionalAction, default=False, help="open a browser")


def _view(arguments: argparse.Namespace) -> int:
    if (arguments.other is None) != (arguments.landmarks is None):
        raise input_error("--landmarks: goes with two runs, `mplicits view RUN OTHER --landmarks FILE`")
    if arguments.landmarks is not None:
        refuse(arguments, ("cloud", "time"), "does not go with --landmarks; leave one of the two out")
    from ..web.export import WebOptions, pack
    from ..web.landmarks import Pairs
    from ..web.serve import PageServer
    from ..web.watch import Watcher

    place = {"host": arguments.host, "port": arguments.port}
    if arguments.landmarks is not None:
        from ...neural_fields.backend.files import check_place

        check_place(arguments.landmarks)
        pairs = Pairs((arguments.run, arguments.other), arguments.landmarks, up=arguments.up)
        shown = server = PageServer(pairs.pack, keep=pairs.keep, **place)
    else:
        options = WebOptions(time=arguments.time, up=arguments.up, cloud=arguments.cloud or "auto")
        server = PageServer(lambda: pack(arguments.run, options), **place)
        shown = Watcher(Path(arguments.run), server=server)
    with shown:
        try:
            print(f"{arguments.run}: open {server.url} in a browser; Ctrl-C ends it", flush=True)
            if arguments.open:
                import webbrowser

                webbrowser.open(server.url)
            while not threading.Event().wait(3600):  # with a time limit, or Windows would not notice Ctrl-C
                pass
        except KeyboardInterrupt:
            print()
    return 0


VIEW = Command(
    "look at a fit, a mesh or a cloud in the browser",
    """  mplicits view runs/scan
  mplicits view runs/scan --up z --open
  mplicits view runs/scan --port 9000
  mplicits view scan.ply
  mplicits view runs/cat runs/dog --landmarks pairs.txt""",
    _view_arguments,
    _view,
    "Look at a fit, a mesh or a cloud in the browser: the page of `mplicits web`, drawn by the browser's own graphics "
    "adapter, with each new checkpoint of a run that is still fitted. With --landmarks two fits stand side by side; "
    "pairs of clicks are kept for `evolve --landmarks`.",
)
