"""Two runs side by side on a page, and the pairs of points that are clicked there: ``mplicits view --landmarks``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...datasets.landmarks import read_landmarks, write_landmarks
from ...neural_fields import Similarity
from ..texture.train import texture_of
from ..training.folder import find_field, load_still
from .export import Packed, WebOptions, pack_shapes
from .shapes import field_shapes


class Pairs:
    """Landmarks of two runs that do not move, kept in the file ``path`` while there are any.

    The page shows the meshes of the finest levels at half size, about (−½, 0, 0) and (½, 0, 0). Raises InputError.
    """

    def __init__(self, runs: Sequence[str | Path], path: str | Path, *, up: str = "y") -> None:
        self.path, self.runs, self.up = Path(path), runs, up
        self.saved = [load_still(run) for run in runs]
        self.places = [Similarity((side - 0.5, 0.0, 0.0), 0.5) for side in range(2)]  # of the shapes on the page
        self.pairs = np.zeros((0, 2, 3))
        if self.path.exists():
            self.pairs = np.stack(read_landmarks(self.path), axis=1)

    def pack(self) -> Packed:
        """Pack both shapes and the pairs."""
        shapes, names, marks = [], [], []
        sides = zip(self.runs, self.saved, self.places, self.pairs.swapaxes(0, 1), strict=True)
        for run, saved, place, points in sides:
            mesh = field_shapes(saved.field, texture_of(find_field(run), saved.field))[-1]
            names.append(Path(run).resolve().stem)
            shapes.append(replace(mesh, name=names[-1], vertices=place.to_input(mesh.vertices)))
            marks.append(place.to_input(saved.similarity.to_unit(points)))
        packed = pack_shapes(shapes, Similarity.identity(), WebOptions(up=self.up), name=" and ".join(names))
        packed.header["landmarks"] = {"names": names, "pairs": np.stack(marks, axis=1).tolist()}
        return packed

    def keep(self, pairs: Any) -> None:
        """Write pairs ``(P, 2, 3)`` of places in the scene, in the input coordinates of either run.

        Raises a ValueError for anything else, and an InputError if the file cannot be written.
        """
        try:
            places = np.array(pairs, np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError("landmarks: expected a list of pairs of points") from error
        if places.shape not in ((0,), (len(places), 2, 3)) or not np.isfinite(places).all():
            raise ValueError("landmarks: expected a list of pairs of finite points")
        sides = [
            saved.similarity.to_input(place.to_unit(points))
            for saved, place, points in zip(
                self.saved, self.places, places.reshape(-1, 2, 3).swapaxes(0, 1), strict=True
            )
        ]
        self.pairs = np.stack(sides, axis=1)
        if len(places):
            write_landmarks(self.path, *sides)
        else:
            self.path.unlink(missing_ok=True)
