"""The shapes that ``evolve`` moves: fits and exact shapes, and how they are put into one frame."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...datasets.landmarks import read_landmarks
from ...neural_fields import (
    Box,
    Capsule,
    Field,
    InputError,
    Jet,
    Mesh,
    Similarity,
    Sphere,
    Torus,
    extract_mesh,
    load_field,
    project_to_surface,
)
from ...neural_fields.backend.arrays import Float64
from ...neural_fields.fields.csg import Bounded
from ...neural_fields.meshing.extract import surface_needed
from ..surface.surface import sample_points
from ..training.folder import find_field

_SIZES: Mapping[str, int] = MappingProxyType({"sphere": 1, "torus": 2, "box": 3, "capsule": 2})
_EXACT: Mapping[str, Callable[..., Field]] = MappingProxyType(
    {
        "sphere": lambda radius=0.5: Sphere(radius=radius),
        "torus": lambda major=0.5, minor=0.2: Torus(major=major, minor=minor),
        "box": lambda x=0.4, y=0.4, z=0.4: Box(half_size=(x, y, z)),
        "capsule": lambda half=0.4, radius=0.2: Capsule(start=(0.0, 0.0, -half), end=(0.0, 0.0, half), radius=radius),
    }
)


@dataclass(frozen=True, eq=False)
class Placement:
    """``x ← s R x + c``: where a shape is put.

    Attributes:
        rotation: R, ``(3, 3)``.
        scale: s.
        shift: c, ``(3,)``.
    """

    rotation: Float64 = dataclasses.field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    shift: Float64 = dataclasses.field(default_factory=lambda: np.zeros(3))

    def apply(self, points: Float64) -> Float64:
        """Points ``(N, 3)`` after it."""
        return self.scale * points @ self.rotation.T + self.shift

    def then(self, other: Placement) -> Placement:
        """This one, and after it another."""
        rotation, scale = other.rotation @ self.rotation, other.scale * self.scale
        return Placement(rotation, scale, other.apply(self.shift[None])[0])

    def inverse(self) -> Placement:
        """The way back."""
        return Placement(self.rotation.T, 1 / self.scale, -self.shift @ self.rotation / self.scale)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"rotation": self.rotation.tolist(), "scale": self.scale, "shift": self.shift.tolist()}

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> Placement:
        """What `as_dict` gave."""
        return cls(np.array(numbers["rotation"]), float(numbers["scale"]), np.array(numbers["shift"]))


class Placed(Field):
    """A static field moved, turned and scaled: ``f(x) = s g(Rᵀ (x − c) / s)``, a distance if g is one.

    Args:
        field: g, three-dimensional; shared, not copied.
        placement: R, s and c.
    """

    rotation: Tensor
    shift: Tensor

    def __init__(self, field: Field, placement: Placement) -> None:
        super().__init__()
        self.field, self.scale = field, placement.scale
        self.in_dim, self.num_levels = 3, field.num_levels
        self.register_buffer("rotation", torch.as_tensor(placement.rotation, dtype=torch.float32), persistent=False)
        self.register_buffer("shift", torch.as_tensor(placement.shift, dtype=torch.float32), persistent=False)

    @property
    def deltas(self) -> Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Half-widths of the bands, scaled."""
        return self.field.deltas * self.scale

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        return self.scale * self.field.value(self._home(x), level=level)

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        value, gradient, features = self.field.jet(self._home(x), level=level)
        return Jet(self.scale * value, gradient @ self.rotation.to(x).T, features)

    def _home(self, x: Tensor) -> Tensor:
        return (self.check_points(x) - self.shift.to(x)) @ self.rotation.to(x) / self.scale


@dataclass(frozen=True, eq=False)
class StaticShape:
    """A static shape."""

    name: str  # what the user called it
    field: Field  # three-dimensional, on the CPU
    similarity: Similarity  # from input coordinates to the shape's own unit sphere
    surface: Mesh  # in the coordinates of ``field``
    # from its own unit sphere to the coordinates of ``field``
    placement: Placement = dataclasses.field(default_factory=Placement)

    def points(self, count: int, seed: int) -> Tensor:
        """Points uniform on the surface, ``(count, 3)`` float32: of the mesh, then moved to f = 0."""
        points, _ = sample_points(self.surface, count, np.random.default_rng(seed))
        return project_to_surface(self.field, torch.from_numpy(points).float(), steps=3)[0]

    def placed(self, placement: Placement) -> StaticShape:
        """This shape moved."""
        return dataclasses.replace(
            self,
            field=Placed(self.field, placement),
            surface=Mesh(placement.apply(self.surface.vertices), self.surface.faces),
            placement=self.placement.then(placement),
        )


def read_shape(text: str) -> StaticShape:
    """A run directory, a .safetensors file, or an exact shape in coordinates of the unit sphere.

    Exact shapes are ``sphere:RADIUS``, ``torus:MAJOR,MINOR``, ``box:X,Y,Z`` (half sizes) and ``capsule:HALF,RADIUS``
    (around the z axis), each with ``@X,Y,Z`` for its centre.

    Raises:
        InputError: there is no such run or shape, it moves already, or it has no surface in the unit sphere.
    """
    kind = text.split(":")[0].split("@")[0]
    if kind in _EXACT and not Path(text).exists():
        shape = _meshed(text, _exact(text, kind), Similarity.identity())
        sizes = text.partition("@")[2]
        return shape.placed(Placement(shift=_numbers(text, sizes, 3))) if sizes else shape
    if not Path(text).exists() and Path(text).suffix != ".safetensors":
        raise InputError(
            f"{text}: no such run directory or file, and no exact shape; those are {', '.join(_EXACT)}, as in "
            "sphere:0.4@0.2,0,0"
        )
    file = find_field(text)
    field, similarity, _ = load_field(file)
    if field.in_dim != 3:
        raise InputError(f"{file}: moves already; evolve takes static fields, as `mplicits fit` makes them")
    # In the frame of a larger shape a network is evaluated far from where it was trained, with arbitrary values.
    return _meshed(text, Bounded(field), similarity)


def aligned(shapes: list[StaticShape], how: Literal["none", "center", "pca"]) -> list[StaticShape]:
    """All shapes, each in its own unit sphere, in that of the first.

    "none" keeps the places and sizes of their input coordinates; "center" lays the unit spheres on each other; "pca"
    turns each shape as well, to the principal axes of the first, the way round in which both have most volume in
    common.
    """
    first = shapes[0]
    placed = [first]
    for shape in shapes[1:]:
        if how == "none":
            # own → input → the first's
            scale = shape.similarity.scale / first.similarity.scale
            shift = first.similarity.to_unit(np.asarray(shape.similarity.center))
            placed.append(shape.placed(Placement(scale=scale, shift=shift)))
        elif how == "center":
            placed.append(shape)
        else:
            placed.append(shape.placed(Placement(rotation=_turned(first, shape))))
    return placed


def into_unit_sphere(shapes: list[StaticShape], reach: Float64) -> tuple[list[StaticShape], Similarity]:
    """The shapes shrunk until all points ``(N, 3)`` that they reach lie in the unit sphere, and the similarity."""
    # A mesh leaves its unit sphere by less than a thousandth.
    if np.linalg.norm(reach, axis=1).max() <= 1.001:
        return shapes, Similarity.identity()
    region = Similarity.to_unit_sphere(reach)
    shrunk = Placement(scale=1 / region.scale, shift=-np.asarray(region.center) / region.scale)
    return [shape.placed(shrunk) for shape in shapes], region


def _exact(text: str, kind: str) -> Field:
    sizes = text.removeprefix(kind).partition("@")[0].removeprefix(":")
    try:
        return _EXACT[kind](*(_numbers(text, sizes, _SIZES[kind]) if sizes else ()))
    except ValueError as error:
        raise InputError(f"{text}: {error}") from error


def _numbers(text: str, numbers: str, count: int) -> Float64:
    try:
        parsed = np.array([float(part) for part in numbers.split(",")])
    except ValueError:
        parsed = np.empty(0)
    if len(parsed) != count or not np.isfinite(parsed).all():
        raise InputError(f"{text}: got {numbers!r}, expected {count} number{'s' * (count > 1)} with commas in between")
    return parsed


def _meshed(name: str, field: Field, similarity: Similarity) -> StaticShape:
    with surface_needed(f"{name}: has no surface in the unit sphere"):
        mesh = extract_mesh(field, resolution=128, normals=False)
    return StaticShape(name, field, similarity, mesh)


def _turned(first: StaticShape, shape: StaticShape) -> Float64:
    """The rotation that lays the principal axes on each other, and the insides as well as they go."""
    ours, theirs = (_axes(each.surface) for each in (shape, first))
    flips = [np.diag((a, b, a * b)) for a, b in itertools.product((1.0, -1.0), repeat=2)]
    rotations = [theirs @ flip @ ours.T for flip in flips]
    x = 2 * torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) - 1
    inside = first.field.value(x) < 0
    common = [
        int((inside & (shape.placed(Placement(rotation=rotation)).field.value(x) < 0)).sum()) for rotation in rotations
    ]
    return rotations[int(np.argmax(common))]


def _axes(surface: Mesh) -> Float64:
    """Principal axes as columns, of a right-handed system, the longest last."""
    points, _ = sample_points(surface, 20_000, np.random.default_rng(0))
    _, axes = np.linalg.eigh(np.cov(points.T))
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return axes


FAR_OUT = 0.1  # how far from its surface a landmark may lie, in units of the field: fits and picks are not exact


class Landmarks(NamedTuple):
    """Pairs of points: ``(P, 3)`` of a shape, and the same points of the next shape."""

    before: Tensor
    after: Tensor


def placed_landmarks(paths: Sequence[str], shapes: Sequence[StaticShape]) -> list[Landmarks]:
    """The landmarks of each two shapes, in the frame that the shapes were put in; none where there are no files.

    Raises:
        InputError: a file cannot be read, or a landmark is not on its shape.
    """
    if not paths:
        none = torch.empty(0, 3)
        return [Landmarks(none, none)] * (len(shapes) - 1)
    found = []
    for index, path in enumerate(paths):
        both = zip(read_landmarks(path), shapes[index : index + 2], strict=True)
        found.append(Landmarks(*(_placed(path, points, shape) for points, shape in both)))
    return found


def nearness(points: Tensor, landmarks: Tensor) -> Tensor:
    """exp(−|x − a|² / 2σ²) of points ``(N, 3)`` and landmarks ``(P, 3)``, ``(N, P)``: alike for points that match."""
    # 0.3: the distance within which a landmark says something about its neighbours.
    return torch.exp(-torch.cdist(points, landmarks).square() / (2 * 0.3**2))


@torch.no_grad()
def _placed(path: str, points: Float64, shape: StaticShape) -> Tensor:
    placed = torch.from_numpy(shape.placement.apply(shape.similarity.to_unit(points))).float()
    value = shape.field.value(placed).abs()
    worst = int(value.argmax())
    if not float(value[worst]) <= FAR_OUT:
        where = " ".join(f"{number:g}" for number in points[worst])
        raise InputError(f"{path}: landmark {where} is not on {shape.name}; give coordinates of that shape's own input")
    return placed
