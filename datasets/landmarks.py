"""Points of two shapes that are known to be the same, as a text file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..neural_fields import InputError
from ..neural_fields.backend.files import write_whole
from .files import readable

__all__ = ["read_landmarks", "write_landmarks"]

Float64 = NDArray[np.float64]


def read_landmarks(path: str | Path) -> tuple[Float64, Float64]:
    """Pairs of points from a text file, ``(P, 3)`` each, in the input coordinates of either shape.

    A line has six numbers, x y z of the first shape and x y z of the second, with spaces or commas between them; what
    follows a # is a comment.

    Raises:
        InputError: there is no such file, it has no pairs, or a line is no six finite numbers.
    """
    path = Path(path)
    with readable(path):
        lines = path.read_text(encoding="utf-8").splitlines()
    pairs = []
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            pair = [float(word) for word in words]
        except ValueError:
            pair = []
        if len(pair) != 6 or not np.isfinite(pair).all():
            raise InputError(f"{path}, line {number}: expected six numbers, x y z of one shape and x y z of the next")
        pairs.append(pair)
    if not pairs:
        raise InputError(f"{path}: no landmarks; write six numbers in a line, x y z of one shape and x y z of the next")
    both = np.array(pairs)
    return both[:, :3], both[:, 3:]


def write_landmarks(path: str | Path, before: ArrayLike, after: ArrayLike) -> None:
    """Write pairs of points as `read_landmarks` reads them; a file without any has its heading alone.

    Args:
        path: a text file, replaced as a whole.
        before: ``(P, 3)`` in the input coordinates of the first shape.
        after: ``(P, 3)``, the same points of the second.

    Raises:
        InputError: it cannot be written.
    """
    pairs = np.concatenate([np.asarray(side, np.float64).reshape(-1, 3) for side in (before, after)], axis=1)
    lines = ["# x y z of one shape, x y z of the next", *(" ".join(f"{number:.9g}" for number in row) for row in pairs)]
    write_whole(path, "\n".join(lines) + "\n")
