"""``shape.show()``: a field of a script in the browser until its page is closed, of a notebook as a picture."""

from __future__ import annotations

import sys
import time
import webbrowser
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...neural_fields import WorldField
from ..render.draw import render_shape
from .server import Viewer, show_field

__all__ = ["Picture", "in_notebook", "show", "until_closed"]

# Seconds between looks at who is there, and for how long nobody may be: a page that is loaded anew leaves for a moment.
LOOK, GONE = 0.5, 5.0


class Picture(NamedTuple):
    """What notebooks show as a picture.

    Attributes:
        png: the file's content.
    """

    png: bytes

    def _repr_png_(self) -> bytes:
        return self.png


def show(shape: WorldField, *, up: str = "y", block: bool = True, browser: bool = True) -> Any:
    """See `WorldField.show`.

    Raises:
        InputError: viser is not installed, or there is no surface.
    """
    if in_notebook():
        picture = np.ascontiguousarray(render_shape(shape, up=up)[..., ::-1])
        return Picture(cv2.imencode(".png", picture)[1].tobytes())
    viewer = Viewer(show_field(shape.field, similarity=shape.similarity), up=up)
    print(f"open {viewer.url} in a browser" + ("; Ctrl-C ends it" if block else ""), flush=True)
    if browser:
        webbrowser.open(viewer.url)
    if not block:
        return viewer
    with viewer:
        until_closed(lambda: viewer.num_clients)
    return None


def in_notebook() -> bool:
    """Whether this runs in a notebook's kernel."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


def until_closed(clients: Callable[[], int], *, look: float = LOOK, gone: float = GONE) -> None:
    """Wait until somebody has come and all have left again, or for Ctrl-C.

    Args:
        clients: how many are there.
        look: seconds between two looks.
        gone: seconds for which nobody must be there.
    """
    seen: float | None = None
    try:
        while seen is None or time.monotonic() - seen < gone:
            if clients():
                seen = time.monotonic()
            time.sleep(look)
    except KeyboardInterrupt:
        print()
