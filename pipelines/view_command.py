"""``mplicits view``: its arguments, and how it is started and stopped."""

from __future__ import annotations

import argparse
import threading

from .command import Command, whole

__all__ = ["COMMAND"]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run", metavar="RUN", help="run directory or .safetensors file")
    parser.add_argument("--up", choices=("y", "z"), default="y", help="the axis that points up (y)")
    parser.add_argument(
        "--size", type=whole(64, 4096), default=512, metavar="N", help="images of about N × N pixels (512)"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (127.0.0.1: this machine only)")
    parser.add_argument("--port", type=_port, metavar="N", help="port to listen on (default: a free one from 8080 up)")
    parser.add_argument("--device", default="auto", help="where to evaluate the field: auto, cpu, cuda, … (auto)")
    parser.add_argument("--open", action=argparse.BooleanOptionalAction, default=False, help="open a browser")


def _port(text: str) -> int | None:
    """A port; 0 and "auto" let us choose."""
    return None if text in ("0", "auto") else whole(0, 65535)(text)


def _view(arguments: argparse.Namespace) -> int:
    from .run.machine import choose_device
    from .viewer.server import Viewer, open_run

    shown = open_run(arguments.run, side=arguments.size, device=choose_device(arguments.device))
    with Viewer(shown, host=arguments.host, port=arguments.port, up=arguments.up) as viewer:
        try:
            print(f"{arguments.run}: open {viewer.url} in a browser; Ctrl-C ends it", flush=True)
            if arguments.open:
                import webbrowser

                webbrowser.open(viewer.url)
            while not threading.Event().wait(3600):  # with a time limit, or Windows would not notice Ctrl-C
                pass
        except KeyboardInterrupt:
            print()
    return 0


COMMAND = Command(
    "look at a fit in the browser",
    """  mplicits view runs/scan
  mplicits view runs/scan --up z --open
  mplicits view runs/scan --port 9000""",
    _arguments,
    _view,
    "Look at a fit in the browser: the traced field, its levels, meshes, bands and slices.",
)
