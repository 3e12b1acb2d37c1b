"""The moments of a field that moves, as the viewer asks for them."""

from __future__ import annotations

import threading
from collections import OrderedDict

from ..neural_fields import Field
from ..neural_fields.dynamic_tracing import moment

__all__ = ["Moments"]

# Moments are small, but each has the meshes that were made of it.
KEPT = 16


class Moments:
    """Three-dimensional fields by time; of a field that does not move there is one.

    Args:
        field: three- or four-dimensional.
    """

    def __init__(self, field: Field) -> None:
        self.field, self.moves = field, field.in_dim == 4
        self._kept: OrderedDict[float, Field] = OrderedDict()
        self._lock = threading.Lock()

    def at(self, time: float) -> Field:
        """The field at a time."""
        if not self.moves:
            return self.field
        with self._lock:
            if time not in self._kept:
                self._kept[time] = moment(self.field, time)
            self._kept.move_to_end(time)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return self._kept[time]
