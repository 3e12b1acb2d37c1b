"""``shape.show()``: a field of a script in the browser until its page is closed, or in a notebook's cell."""

from __future__ import annotations

import sys
import time
import webbrowser
from collections.abc import Callable
from html import escape
from typing import Any, NamedTuple

from ...neural_fields import WorldField
from .assembly import fill_page
from .export import WebOptions, pack_field
from .serve import PageServer


class Frame(NamedTuple):
    """A page, as HTML, in a notebook's cell."""

    page: str

    def _repr_html_(self) -> str:
        style = "width: 100%; height: 480px; border: 0"
        return f'<iframe srcdoc="{escape(self.page)}" style="{style}"></iframe>'


def show(shape: WorldField, *, up: str = "y", block: bool = True, browser: bool = True) -> Any:
    """See `WorldField.show`; raises NoSurfaceError, or an InputError if no port is free."""
    packed = pack_field(shape.field, shape.similarity, WebOptions(up=up))
    if in_notebook():
        return Frame(fill_page(packed.header, packed.data))
    server = PageServer(lambda: packed)
    print(f"open {server.url} in a browser" + ("; Ctrl-C ends it" if block else ""), flush=True)
    if browser:
        webbrowser.open(server.url)
    if not block:
        return server
    with server:
        until_closed(lambda: server.num_clients)
    return None


def in_notebook() -> bool:
    """Whether this runs in a notebook's kernel."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in getattr(shell, "config", {})


def until_closed(clients: Callable[[], int], *, look: float = 0.5, gone: float = 5.0) -> None:
    """Wait until a browser has come and none is left for ``gone`` seconds (a reload leaves briefly), or Ctrl-C."""
    seen: float | None = None
    try:
        while seen is None or time.monotonic() - seen < gone:
            if clients():
                seen = time.monotonic()
            time.sleep(look)
    except KeyboardInterrupt:
        print()
