"""``mplicits web``: a run as one HTML file."""

from __future__ import annotations

import argparse
import time

from ..run.config import given_flags, input_error
from .common import Command, add_flags, check_output, whole

__all__ = ["WEB"]

PAGES = (".html", ".htm")
# At the beginning of each page that was written here, so that no other page of a user's is overwritten.
MARK = 'id="header">{"format":"mplicits-web"'


def _web_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add_flags(parser, "run", "--time")
    add_flags(parser, "--out", help=", ".join(PAGES))
    add("--levels", type=whole(1), metavar="N", help="only the N coarsest levels (default: all)")
    add("--no-colors", dest="colors", action="store_false", help="leave out the colours of the run's texture")
    add("--float32", action="store_true", help="keep the weights as they are (default: 16 bits each)")
    add_flags(parser, "--up")
    add("--title", metavar="TEXT", help="of the page (default: the name of the run)")
    add("--force", action="store_true", help="overwrite a file that is no page of this command")


def _web(arguments: argparse.Namespace) -> int:
    out = arguments.out
    check_output(out, PAGES)
    if out.exists() and not arguments.force and MARK not in out.read_text(encoding="utf-8", errors="replace"):
        raise input_error(f"{out}: is there, and no page of this command; name another file, or say --force")
    from ..web.export import WebOptions, web_run

    started = time.monotonic()
    done = web_run(arguments.run, out, WebOptions(**given_flags(arguments, WebOptions)), say=print)
    levels = f"{done.levels} level{'s' if done.levels > 1 else ''}"
    levels += " with colours" if done.colored else ""
    seconds = time.monotonic() - started
    print(f"{out}: {done.size / 1024:,.0f} KiB, {levels}, {done.triangles:,} triangles around them, in {seconds:.1f} s")
    return 0


WEB = Command(
    "write a fit as one HTML file, traced in the browser of who opens it",
    """  mplicits web runs/scan -o scan.html
  mplicits web runs/scan -o small.html --levels 1
  mplicits web runs/scan -o exact.html --float32 --up z""",
    _web_arguments,
    _web,
    "Write a fit as one HTML file that needs no network, no server and no Python: the networks themselves, traced by "
    "the GPU of whoever opens it (WebGL 2).",
)
