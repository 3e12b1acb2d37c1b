"""Functions of rooms above, by name, for methods that end there, such as ``shape.show()``. Imports go downwards."""

from __future__ import annotations

import importlib
from typing import Any

OFFERED = {"render": ("pipelines.render.draw", "render_shape"), "show": ("pipelines.web.window", "show")}


def upward(name: str) -> Any:
    """A function of a room above; ImportError if this package lies alone."""
    module, function = OFFERED[name]
    return getattr(importlib.import_module(f"{(__package__ or '').rpartition('.')[0]}.{module}"), function)
