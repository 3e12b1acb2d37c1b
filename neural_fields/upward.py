"""What rooms above offer to the objects of this one, by name.

Imports go downwards. A few methods that a user expects on the object in hand, ``shape.show()``, end in a room above:
they ask for it here, when they are called, and nowhere else.
"""

from __future__ import annotations

import importlib
from typing import Any

OFFERED = {
    "render": ("pipelines.render.draw", "render_shape"),
    "show": ("pipelines.web.window", "show"),
}


def upward(name: str) -> Any:
    """A function of a room above.

    Raises:
        ImportError: this package lies alone, without the rooms above.
    """
    module, function = OFFERED[name]
    return getattr(importlib.import_module(f"{(__package__ or '').rpartition('.')[0]}.{module}"), function)
