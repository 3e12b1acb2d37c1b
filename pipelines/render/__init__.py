"""``render`` and ``slice``: pictures of fields, meshes and clouds."""

from .trace import Seen, trace_view

__all__ = ["Seen", "trace_view"]
