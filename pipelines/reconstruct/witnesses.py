"""How many photographs see a place of a known surface: what to ask of a reconstruction there."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ...datasets.cameras import Camera
from ..render.rasterise import mesh_view
from ..render.studio import sees
from ..surface.surface import Surface
from ..surface.witnessed import Witnesses

__all__ = ["witnesses_of"]

FINEST = 1024


def witnesses_of(
    cameras: Sequence[Camera], *, finest: int = FINEST, progress: Callable[[int, int], None] | None = None
) -> Callable[[Surface], Witnesses]:
    """Who says how many cameras see points of a surface: those in whose picture they are, with nothing before them.

    Masks say nothing here: a place that is in a picture is seen.

    Args:
        cameras: in the coordinates of the surface.
        finest: pixels of the longer side, in which it is decided what hides what. Ten of them wide is the strip beyond
            a rim that may count as seen.
        progress: called with ``(done, total)`` after every camera.

    Returns:
        For `evaluate_files`.
    """
    large = [camera.resized(*_large(camera, finest)) for camera in cameras]

    def of(surface: Surface) -> Witnesses:
        def count(points: NDArray[np.float64]) -> NDArray[np.int64]:
            counts = np.zeros(len(points), dtype=np.int64)
            for index, camera in enumerate(large):
                counts += sees(camera, mesh_view(surface, camera), points)
                if progress is not None:
                    progress(index + 1, len(large))
            return counts

        return count

    return of


def _large(camera: Camera, finest: int) -> tuple[int, int]:
    """Width and height in which the longer side has so many pixels."""
    share = finest / max(camera.width, camera.height)
    return max(1, round(share * camera.width)), max(1, round(share * camera.height))
