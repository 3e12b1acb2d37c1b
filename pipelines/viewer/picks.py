"""Landmarks that are picked: two shapes side by side, and what a click on one of them and on the other means."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.landmarks import read_landmarks, write_landmarks
from ...neural_fields import Field, InputError, Jet, Similarity, load_field
from ...neural_fields.fields.field import OneLevelField
from ..training.folder import find_field

__all__ = ["Picks", "SideBySide", "open_picks"]

Float64 = NDArray[np.float64]
HALF = 0.5  # the size of each shape beside the other: both unit spheres fit into one
ASIDE = 0.05  # what is outside a shape's unit sphere is taken to be this much further from its surface


class SideBySide(OneLevelField):
    """Two static shapes, each at half its size: the first about (−½, 0, 0), the second about (½, 0, 0).

    Beyond the unit sphere of its fit a field is not known; there the distance to that sphere takes its place.

    Args:
        first: three-dimensional; its finest level is shown.
        second: likewise.
    """

    def __init__(self, first: Field, second: Field) -> None:
        super().__init__()
        self.shapes = torch.nn.ModuleList((first, second))

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.jet(x, level=level).value

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        self.resolve_level(level)
        rows = self.check_points(x).reshape(-1, 3)
        value, gradient = rows.new_empty(len(rows)), torch.empty_like(rows)
        for side in (0, 1):
            here = ((rows[:, 0] >= 0) == bool(side)).nonzero()[:, 0]
            value[here], gradient[here] = self._nearest(side, rows[here])
        return Jet(HALF * value.reshape(x.shape[:-1]), gradient.reshape(x.shape), x.new_empty((*x.shape[:-1], 0)))

    def there(self, side: int, x: Tensor) -> Tensor:
        """Points ``(..., 3)`` in the coordinates of the first shape, 0, or of the second, 1."""
        return x / HALF - x.new_tensor((2.0 * side - 1, 0.0, 0.0))

    def back(self, side: int, x: Tensor) -> Tensor:
        """The way from there."""
        return HALF * (x + x.new_tensor((2.0 * side - 1, 0.0, 0.0)))

    def _nearest(self, side: int, x: Tensor) -> tuple[Tensor, Tensor]:
        """Values and gradients on one side, where no more is asked of the other shape than how far its sphere is."""
        shape, own, other = self.shapes[side], self.there(side, x), self.there(1 - side, x)
        assert isinstance(shape, Field)
        value, gradient = _from_sphere(own)
        inside = (own.norm(dim=-1) < 1).nonzero()[:, 0]
        if len(inside):
            jet = shape.jet(own[inside])
            value, gradient = value.index_copy(0, inside, jet.value), gradient.index_copy(0, inside, jet.gradient)
        beyond, away = _from_sphere(other)
        nearer = beyond < value
        return torch.where(nearer, beyond, value), torch.where(nearer[:, None], away, gradient)


def _from_sphere(x: Tensor) -> tuple[Tensor, Tensor]:
    """How far points ``(N, 3)`` are from the unit sphere, and a little more; and the gradient of that."""
    radius = x.norm(dim=-1)
    return radius - 1 + ASIDE, x / radius.clamp(min=1e-6)[:, None]


class Picks:
    """Landmarks of two shapes that are shown side by side, kept in a file while there are any.

    Clicks of one pair may come in any order; a second one on the same shape takes the place of the first.

    Args:
        field: the shapes.
        similarities: of each, from input to unit-sphere coordinates.
        names: of each.
        path: the file; pairs that it has already are kept.

    Raises:
        InputError: there is such a file, and it holds no landmarks.
    """

    def __init__(
        self, field: SideBySide, similarities: Sequence[Similarity], names: Sequence[str], path: str | Path
    ) -> None:
        self.field, self.path = field, Path(path)
        self._similarities, self._names, self._lock = tuple(similarities), tuple(names), threading.Lock()
        self._pairs: list[list[Float64]] = []
        self._pending: dict[int, Float64] = {}
        if self.path.exists():
            self._pairs = [list(pair) for pair in zip(*read_landmarks(self.path), strict=True)]

    @property
    def pairs(self) -> int:
        """How many are complete."""
        return len(self._pairs)

    def pick(self, point: Float64) -> None:
        """A point ``(3,)`` of the surface was clicked.

        Raises:
            InputError: the file cannot be written.
        """
        side = int(point[0] >= 0)
        with self._lock:
            there = self.field.there(side, torch.from_numpy(point).double()).numpy()
            self._pending[side] = self._similarities[side].to_input(there)
            if len(self._pending) == 2:
                self._pairs.append([self._pending[0], self._pending[1]])
                self._pending = {}
                self._write()

    def undo(self) -> None:
        """Take back the click that waits for its partner, or else the last pair.

        Raises:
            InputError: the file cannot be written.
        """
        with self._lock:
            if self._pending:
                self._pending = {}
            elif self._pairs:
                self._pairs.pop()
                if self._pairs:
                    self._write()
                else:
                    self.path.unlink(missing_ok=True)

    def places(self) -> list[tuple[int, Float64]]:
        """Of all clicks the number of their pair, from 1, and where they are, ``(3,)``."""
        with self._lock:
            numbered = [
                (number, side, point) for number, pair in enumerate(self._pairs, 1) for side, point in enumerate(pair)
            ]
            numbered += [(len(self._pairs) + 1, side, point) for side, point in self._pending.items()]
        return [
            (number, self.field.back(side, torch.from_numpy(self._similarities[side].to_unit(point))).numpy())
            for number, side, point in numbered
        ]

    def text(self) -> str:
        """What to do next, in Markdown."""
        with self._lock:
            number, waits = len(self._pairs) + 1, next(iter(self._pending), None)
        if waits is None:
            said = f"Click on a point of {self._names[0]} (left) and on the same one of {self._names[1]} (right)."
        else:
            side = ("left", "right")[1 - waits]
            said = f"**Pair {number}**: now click on the same point of {self._names[1 - waits]} ({side})."
        return f"{said}\n\n{number - 1} pair{'s' * (number != 2)} in {self.path}"

    def _write(self) -> None:
        write_landmarks(self.path, *([pair[side] for pair in self._pairs] for side in (0, 1)))


def open_picks(runs: Sequence[str | Path], path: str | Path, *, device: torch.device | str = "cpu") -> Picks:
    """Two runs, for picking landmarks of them.

    Args:
        runs: run directories or .safetensors files.
        path: of the landmarks.
        device: where to evaluate the fields.

    Raises:
        InputError: there is no such run, one moves, or the file of landmarks is another one.
    """
    fields, similarities, names = [], [], []
    for run in runs:
        file = find_field(run)
        field, similarity, _ = load_field(file, device=device)
        if field.in_dim != 3:
            raise InputError(f"{file}: moves; landmarks are picked on shapes that stand still")
        fields.append(field)
        similarities.append(similarity)
        names.append(Path(run).resolve().stem)
    return Picks(SideBySide(*fields), similarities, names, path)
