"""How many photographs see a place of a known surface: what to ask of a reconstruction there."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ....datasets.cameras import Camera
from ....neural_fields import Mesh
from ...render.rasterise import mesh_view
from ...render.studio import sees

__all__ = ["count_witnesses"]

FINEST = 1024


def count_witnesses(
    cameras: Sequence[Camera],
    surface: Mesh,
    points: NDArray[np.float64],
    *,
    finest: int = FINEST,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.int64]:
    """How many cameras ``(N,)`` see points ``(N, 3)`` of a surface: in their picture, with nothing before them.

    Masks say nothing here: a place that is in a picture is seen.

    Args:
        cameras: in the coordinates of the surface.
        surface: what there is to see, and to hide.
        points: of it.
        finest: pixels of the longer side, in which it is decided what hides what. Ten of them wide is the strip beyond
            a rim that may count as seen.
        progress: called with ``(done, total)`` after every camera.
    """
    counts = np.zeros(len(points), dtype=np.int64)
    for index, camera in enumerate(cameras):
        share = finest / max(camera.width, camera.height)
        large = camera.resized(max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        counts += sees(large, mesh_view(surface, large), points)
        if progress is not None:
            progress(index + 1, len(cameras))
    return counts
