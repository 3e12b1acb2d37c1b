"""``web``: a fitted field as one HTML file, traced on the GPU of whoever opens it."""

from .export import WebOptions, WebPage, web_run

__all__ = ["WebOptions", "WebPage", "web_run"]
