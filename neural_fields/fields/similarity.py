"""Coordinates: from the user's to the unit sphere in which fields live, to other programs' axes and units; chords."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ..backend.arrays import Float64


@dataclass(frozen=True)
class Similarity:
    """``x_unit = (x_input - center) / scale``, kept in float64.

    Map coordinates (UTM metres, say) have seven digits before the point, float32 seven in all: the shift is made in
    float64.

    Attributes:
        center: three numbers, in input units.
        scale: input units per unit of the field.
    """

    center: tuple[float, float, float]
    scale: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.center).all() and np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"center={self.center}, scale={self.scale}: expected finite numbers and scale > 0")

    @classmethod
    def identity(cls) -> Similarity:
        """The similarity that changes nothing."""
        return cls((0.0, 0.0, 0.0), 1.0)

    @classmethod
    def to_unit_sphere(cls, points: Float64) -> Similarity:
        """Centre ``points`` ``(N, 3)`` on their bounding box and scale them into the unit sphere.

        Raises:
            ValueError: all points coincide.
        """
        center = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = float(np.sqrt(((points - center) ** 2).sum(axis=1).max()))
        if radius == 0:
            raise ValueError("points: all of them coincide, so there is no scale")
        return cls((float(center[0]), float(center[1]), float(center[2])), radius)

    def within(self, frame: Similarity) -> Similarity:
        """The similarity to these coordinates from those of ``frame``, in place of from the input."""
        x, y, z = (float(number) for number in frame.to_unit(self.center))
        return Similarity((x, y, z), self.scale / frame.scale)

    def to_unit(self, points: ArrayLike) -> Float64:
        """Map ``(..., 3)`` input coordinates into the unit sphere, in float64."""
        return (np.asarray(points, np.float64) - np.asarray(self.center)) / self.scale

    def to_input(self, points: NDArray[np.floating]) -> Float64:
        """Map ``(..., 3)`` unit-sphere coordinates back to input coordinates, in float64."""
        return np.asarray(points, np.float64) * self.scale + np.asarray(self.center)


def ball_chord(origins: Tensor, directions: Tensor, radius: Tensor | float) -> tuple[Tensor, Tensor]:
    """Depth at which lines ``(R, 3)`` are nearest to 0, and half the length of their chord of a ball, 0 if they miss.

    Directions are of unit length; ``radius`` of the ball around 0 is a number or ``(R,)``.
    """
    middle = -(origins * directions).sum(dim=-1)
    # From the nearest point, and not from |o|² − middle², which cancels for far cameras.
    squared = radius**2 - (origins + middle[:, None] * directions).square().sum(dim=-1)
    return middle, squared.clamp(min=0).sqrt()


METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "km": 1e3, "in": 0.0254, "ft": 0.3048}
UP_AXES = ("y", "z")

# Turns by a right angle about x, exactly. Z_TO_Y: (x, y, z) → (x, z, −y).
Z_TO_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class Frame(NamedTuple):
    """The coordinates that programs expect of a format."""

    up: str  # axis
    unit: str  # a key of `METRES`
    always: bool  # whether the standard fixes them, so that files follow unasked


# glTF 2.0, Sec. 3.4: +y up, metres. Slicers take STL for millimetres on the xy-plane. Blender's importers take PLY and
# STL for z-up, OBJ for y-up, and their units for metres.
FRAMES = {
    ".glb": Frame("y", "m", always=True),
    ".obj": Frame("y", "m", always=False),
    ".ply": Frame("z", "m", always=False),
    ".stl": Frame("z", "mm", always=False),
}


@dataclass(frozen=True)
class Placement:
    """Known properties of an input's coordinates, and whether the shape is centred at the origin.

    A GLB is y-up and in metres by its standard, and so is the input unless given here. In PLY, OBJ and STL coordinates
    change only as given here.

    Attributes:
        up: the axis that points up in the input, "y" or "z".
        unit: length of one input unit, a key of `METRES`: "mm", "cm", "m", ….
        center: whether the middle of the shape's bounding box goes to the origin.

    Raises:
        ValueError: there is no such axis or unit.
    """

    up: str | None = None
    unit: str | None = None
    center: bool = False

    def __post_init__(self) -> None:
        if self.up is not None and self.up not in UP_AXES:
            raise ValueError(f"up={self.up!r}: expected one of {', '.join(UP_AXES)}")
        if self.unit is not None and self.unit not in METRES:
            raise ValueError(f"unit={self.unit!r}: expected one of {', '.join(METRES)}")

    def into(self, suffix: str, vertices: Float64) -> FileTransform:
        """The map from input coordinates to those of a file (``suffix`` a key of `FRAMES`); centres ``vertices``."""
        frame = FRAMES[suffix.lower()]
        turn = np.eye(3)
        if self.up is not None and self.up != frame.up:
            turn = Z_TO_Y if frame.up == "y" else Z_TO_Y.T
        scale = 1.0 if self.unit is None else METRES[self.unit] / METRES[frame.unit]
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2 if self.center else np.zeros(3)
        return FileTransform(turn, scale, middle)

    def describe(self, suffix: str) -> str | None:
        """A line about a file's coordinates and what was assumed; None if they are the input's."""
        frame = FRAMES[suffix.lower()]
        words = []
        if self.up is not None or frame.always:
            words.append(f"{frame.up} up")
        if self.unit is not None or frame.always:
            scale = 1.0 if self.unit is None else METRES[self.unit] / METRES[frame.unit]
            words.append(f"in {frame.unit}" + (f" (1 input unit = {scale:.6g} {frame.unit})" if scale != 1 else ""))
        if self.center:
            words.append("centred at the origin")
        if not words:
            return None
        assumed = []
        if frame.always and self.unit is None:
            assumed.append(f"one input unit is taken for 1 {frame.unit} (--unit says what it is)")
        if frame.always and self.up is None:
            assumed.append(f"{frame.up} is taken to be up (--up says otherwise)")
        return "; ".join([", ".join(words), *assumed])


class FileTransform(NamedTuple):
    """The map ``x → scale · turn (x − middle)``, float64."""

    turn: Float64  # (3, 3), a rotation by right angles
    scale: float  # file units per input unit
    middle: Float64  # (3,) in input coordinates

    @property
    def changes(self) -> bool:
        """Whether it is not the identity."""
        return bool(self.scale != 1 or self.middle.any() or (self.turn != np.eye(3)).any())

    def points(self, rows: Float64) -> Float64:
        """Points ``(..., 3)`` in input coordinates → in those of the file."""
        return self.scale * (rows - self.middle) @ self.turn.T

    def directions(self, rows: NDArray[np.floating]) -> NDArray[np.floating]:
        """Directions ``(..., 3)``, turned; length and precision stay."""
        return rows @ self.turn.T.astype(rows.dtype)

    def home(self, similarity: Similarity) -> Similarity:
        """Place and size of the shape in the file, from those in the input."""
        x, y, z = self.points(np.asarray(similarity.center)).tolist()
        return Similarity((x, y, z), similarity.scale * self.scale)

    def node(self, origin: tuple[float, float, float]) -> dict[str, Any]:
        """The map as translation, rotation and scale of a glTF node, for positions relative to ``origin``."""
        translation = (self.points(np.asarray(origin)) + 0.0).tolist()  # no negative zero
        node: dict[str, Any] = {"translation": translation}
        if (self.turn != np.eye(3)).any():
            half = float(np.sqrt(0.5)) * float(np.sign(self.turn[2, 1]))  # x y z w of a quarter turn about x
            node["rotation"] = [half, 0.0, 0.0, float(np.sqrt(0.5))]
        if self.scale != 1:
            node["scale"] = [self.scale] * 3
        return node
