"""Points of two shapes that are known to be the same, as a text file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..neural_fields import InputError
from ..neural_fields.backend.arrays import Float64
from ..neural_fields.backend.files import write_whole
from .clouds.readers.tables import numbers
from .files import decoded, readable


def read_landmarks(path: str | Path) -> tuple[Float64, Float64]:
    """Pairs of points from a text file, ``(P, 3)`` each, in the input coordinates of either shape.

    A line has six numbers, x y z of the first shape and x y z of the second, separated by spaces or commas; a comment
    begins with #.
    """
    path = Path(path)
    with readable(path):
        both = numbers(decoded(path.read_bytes()).replace(",", " "), path, first_line=1, what="line")
    if both.shape[1] != 6 or not np.isfinite(both).all():
        raise InputError(f"{path}: expected six finite numbers in a line, x y z of one shape and x y z of the next")
    return both[:, :3], both[:, 3:]


def write_landmarks(path: str | Path, before: ArrayLike, after: ArrayLike) -> None:
    """Write pairs of points ``(P, 3)`` of two shapes, in their input coordinates, for `read_landmarks`."""
    pairs = np.concatenate([np.asarray(side, np.float64).reshape(-1, 3) for side in (before, after)], axis=1)
    lines = ["# x y z of one shape, x y z of the next", *(" ".join(f"{number:.9g}" for number in row) for row in pairs)]
    write_whole(path, "\n".join(lines) + "\n")
