"""``web`` and ``view``: a field, a mesh or a cloud as a page that the browser draws."""

from .export import WebOptions, WebPage, web_run
from .serve import PageServer

__all__ = ["PageServer", "WebOptions", "WebPage", "web_run"]
