"""``view``: a field in the browser, traced while one looks at it."""

from .server import Viewer, show_field

__all__ = ["Viewer", "show_field"]
