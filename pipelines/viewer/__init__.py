"""``view``: a field in the browser, traced while one looks at it."""

from .server import Viewer, show_field
from .window import show

__all__ = ["Viewer", "show", "show_field"]
