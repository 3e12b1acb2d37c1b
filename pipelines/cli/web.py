"""``mplicits web``: a run as one HTML file, or as a folder with an element for other pages."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from ..training.settings import given_flags, input_error
from .common import Command, add_flags, check_output, stoppable, whole

PAGES = (".html", ".htm")
# At the beginning of each page that was written here, so that no other page of a user's is overwritten.
MARK = 'id="header">{"format":"mplicits-web"'


def _web_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("run", metavar="RUN|FILE", help="run directory, .safetensors file, mesh or cloud")
    add_flags(parser, "--time")
    add_flags(parser, "--out", help=f"{', '.join(PAGES)}, or a folder: field, module and page")
    add("--levels", type=whole(1), metavar="N", help="only the N coarsest levels (default: all)")
    add("--no-colors", dest="colors", action="store_false", help="leave out the colours of the run's texture")
    add("--cloud", metavar="FILE", help="show this cloud too, coloured by its distance from the surface")
    add("--float32", action="store_true", help="keep the weights as they are (default: 13 bits each)")
    add_flags(parser, "--up")
    add("--title", metavar="TEXT", help="of the page (default: the name of the run)")
    add("--force", action="store_true", help="overwrite what was not written by this command")


def _check_place(out: Path, *, force: bool) -> None:
    """Refuse a file or folder in which something else is than what this command writes."""
    from ...neural_fields.backend.files import check_place

    page = out if out.suffix else out / "index.html"
    if out.suffix:
        check_output(out, PAGES)
    elif out.exists() and not out.is_dir():
        raise input_error(f"{out}: is a file; name a folder, or a file that ends with {' or '.join(PAGES)}")
    else:
        check_place(page)
    taken = page.exists() or (out.is_dir() and any(out.iterdir()))
    if taken and not force and not (page.is_file() and MARK in page.read_text(encoding="utf-8", errors="replace")):
        raise input_error(f"{out}: is not empty, and no page of this command; name another place, or say --force")


def _web(arguments: argparse.Namespace) -> int:
    out = arguments.out
    _check_place(out, force=arguments.force)
    from ..web.export import WebOptions, web_run

    started = time.monotonic()
    with stoppable("nothing was written", at_any_time=True):
        done = web_run(arguments.run, out, WebOptions(**given_flags(arguments, WebOptions)), say=print)
    levels = f"{done.levels} level{'s' if done.levels > 1 else ''}" if done.levels else "no field to trace"
    levels += " with colours" if done.colored else ""
    around = " around them" if done.levels else ""
    seconds = time.monotonic() - started
    print(f"{out}: {done.size / 1024:,.0f} KiB, {levels}, {done.triangles:,} triangles{around}, in {seconds:.1f} s")
    return 0


WEB = Command(
    "write a fit, a mesh or a cloud as one HTML file",
    """  mplicits web runs/scan -o scan.html
  mplicits web runs/scan -o small.html --levels 1
  mplicits web runs/scan -o exact.html --float32 --up z
  mplicits web scan.ply -o cloud.html
  mplicits web runs/scan -o site/scan""",
    _web_arguments,
    _web,
    "Write a fit as one HTML file that needs no network, no server and no Python: the networks themselves, traced by "
    "the GPU of whoever opens it (WebGPU or WebGL 2). Meshes, clouds and other fields are shown as "
    "triangles and points. With a folder's name it writes an element for other pages.",
)
