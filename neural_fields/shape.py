"""A field in the coordinates and units of its input, in numpy or in torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .fields.csg import Bounded, Difference, Intersection, Offset, Placed, Shell, Union
from .fields.field import Field, FieldLike, solid
from .fields.similarity import Similarity
from .meshing._cells import Bounds
from .meshing.extract import DEFAULT_BOUNDS, Mesh, extract_mesh
from .tracing.sphere import project_to_surface, sphere_trace
from .upward import upward

Points = TypeVar("Points", NDArray[np.floating], Tensor)


class Closest(NamedTuple):
    """Points of a surface near given ones, as arrays or tensors, in input coordinates.

    Attributes:
        position: ``(..., 3)`` where `WorldField.closest` ended.
        normal: ``(..., 3)`` unit normal there, outward.
        reached: ``(...,)`` bool, whether that is on the surface.
    """

    position: Any
    normal: Any
    reached: Any


class WorldHits(NamedTuple):
    """Intersections of rays with a surface, as arrays or tensors, in input coordinates and units.

    Attributes:
        mask: ``(...,)`` bool, whether the ray meets it.
        depth: ``(...,)`` along the ray, in lengths of its direction; infinite for a ray that misses.
        position: ``(..., 3)`` the point at that depth; NaN for a ray that misses.
        normal: ``(..., 3)`` unit normal there, outward; NaN for a ray that misses.
    """

    mask: Any
    depth: Any
    position: Any
    normal: Any


class WorldField:
    """A signed distance in the coordinates of a scan, a scene or a map: the result of a fit.

    Points and distances are in input coordinates and units, the field in the unit sphere. Arrays in, arrays out, in
    float64; tensors in, tensors out, in their precision, on their device, and with their graph. The shift is made in
    float64, so that map coordinates keep their digits.

    Args:
        field: three-dimensional, in its own coordinates; or a function of points ``(..., 3)`` → ``(...,)``.
        similarity: from input to the field's coordinates; the identity by default.

    Raises:
        ValueError: the field is not three-dimensional; fix the time of one in space-time with `TimeSlice`.

    Example:
        >>> import numpy as np
        >>> from mplicits.neural_fields import Similarity, Sphere, WorldField
        >>> ball = WorldField(Sphere(radius=0.5), Similarity((500_000.0, 0.0, 0.0), 20.0))  # of radius 10, far away
        >>> ball.distance(np.array([[500_012.0, 0.0, 0.0]])).round(4)
        array([2.])
    """

    def __init__(self, field: FieldLike, similarity: Similarity | None = None) -> None:
        field = solid(field)
        self.field, self.similarity = field, similarity or Similarity.identity()

    def __repr__(self) -> str:
        center = ", ".join(f"{number:.10g}" for number in self.similarity.center)
        return f"WorldField(center=({center}), scale={self.similarity.scale:.10g}, field={self.field!r})"

    def distance(self, points: Points, *, level: int = -1) -> Points:
        """Signed distance ``(...,)`` of ``points`` ``(..., 3)``, negative inside, in input units.

        ``level`` is that of detail, 0 the coarsest, -1 the finest. ValueError for other shapes, or if there is no such
        level.
        """
        scale = self.similarity.scale
        return self._ask(points, lambda unit: (self.field.value(unit, level=level).double() * scale,))[0]

    def normals(self, points: Points, *, level: int = -1) -> Points:
        """Unit normals ``(..., 3)`` at ``points`` ``(..., 3)``: the direction in which the distance grows."""
        return self._ask(points, lambda unit: (_unit(self.field.jet(unit, level=level).gradient),))[0]

    def closest(self, points: Points, *, level: int = -1, steps: int = 10, tolerance: float = 1e-5) -> Closest:
        """The surface points down the gradient of ``points`` ``(..., 3)``.

        They are the closest ones if the field is an exact distance. Tensors get no graph here.

        Args:
            points: in input coordinates.
            level: see `distance`.
            steps: largest number of evaluations for a point.
            tolerance: on the distance, in units of the field.
        """

        def ask(unit: Tensor) -> tuple[Tensor, ...]:
            feet, reached = project_to_surface(self.field, unit, level=level, steps=steps, tolerance=tolerance)
            return self._to_input(feet), _unit(self.field.jet(feet, level=level).gradient), reached

        with torch.no_grad():
            return Closest(*self._ask(points, ask))

    def trace(
        self,
        origins: Points,
        directions: Points,
        *,
        level: int = -1,
        tolerance: float = 1e-5,
        differentiable: bool = False,
    ) -> WorldHits:
        """First intersections of rays with the surface.

        Args:
            origins: ``(..., 3)`` in input coordinates.
            directions: ``(..., 3)``, of any length but 0; broadcast with ``origins``.
            level: see `distance`.
            tolerance: of the depth, in units of the field.
            differentiable: whether depths and positions of tensors carry gradients; see `sphere_trace`.

        Raises:
            ValueError: see `sphere_trace`; or one is an array and the other a tensor.
        """
        if isinstance(origins, Tensor) != isinstance(directions, Tensor):
            raise ValueError("origins and directions: expected two arrays or two tensors")
        if isinstance(origins, Tensor):
            rays: Sequence[Any] = torch.broadcast_tensors(origins, directions)
        else:
            rays = np.broadcast_arrays(np.asarray(origins, np.float64), np.asarray(directions, np.float64))

        def ask(unit: Tensor, along: Tensor) -> tuple[Tensor, ...]:
            hits = sphere_trace(
                self.field, unit, along, level=level, tolerance=tolerance, differentiable=differentiable
            )
            away = ~hits.mask[..., None]
            normal = _unit(self.field.jet(hits.position, level=level).gradient)
            depth = torch.where(hits.mask, hits.depth.double() * self.similarity.scale, torch.inf)
            position = self._to_input(hits.position).masked_fill(away, torch.nan)
            return hits.mask, depth, position, normal.masked_fill(away, torch.nan)

        return WorldHits(*self._ask(rays[0], ask, rays[1]))

    def mesh(
        self, resolution: int = 256, *, level: int = -1, bounds: Bounds | None = None, normals: bool = True
    ) -> Mesh:
        """A triangle mesh of the surface, in input coordinates; errors are those of `extract_mesh`.

        Args:
            resolution: cells along the longest side of the box.
            level: see `distance`.
            bounds: lowest and highest corner of the box, in input coordinates; by default around the unit sphere.
            normals: whether vertices get normals.
        """
        box = DEFAULT_BOUNDS
        if bounds is not None:
            low, high = map(self.similarity.to_unit, bounds)
            box = ((low[0], low[1], low[2]), (high[0], high[1], high[2]))
        mesh = extract_mesh(self.field, resolution=resolution, level=level, bounds=box, normals=normals)
        return dataclasses.replace(mesh, vertices=self.similarity.to_input(mesh.vertices))

    def render(
        self,
        path: str | Path | None = None,
        *,
        size: int | tuple[int, int] = 640,
        level: int = -1,
        up: str = "y",
        azimuth: float = 30.0,
        elevation: float = 15.0,
    ) -> NDArray[np.uint8]:
        """A picture of the surface ``(H, W, 3)``, display RGB, traced, with the light of ``mplicits render``.

        Args:
            path: a .png or .jpg file to write as well.
            size: pixels along each side, or width and height.
            level: see `distance`.
            up: the axis that points up, "y" or "z".
            azimuth: degrees around that axis, from the front.
            elevation: degrees above the horizon.

        Raises:
            InputError: there is no surface, or the file cannot be written.
        """
        return upward("render")(self, path, size=size, level=level, up=up, azimuth=azimuth, elevation=elevation)

    def show(self, *, up: str = "y", block: bool = True, browser: bool = True) -> Any:
        """Open the surface in the browser, or in a notebook's cell; in a script, until the page is closed, or Ctrl-C.

        Args:
            up: the axis that points up, "y" or "z".
            block: whether to wait; otherwise the running `PageServer` is returned, for the caller to close.
            browser: whether to open one; otherwise only the address is printed.

        Returns:
            The `PageServer`, or None once it is closed; in a notebook the object that shows the page.

        Raises:
            NoSurfaceError: there is no surface.
            InputError: no port is free.
        """
        return upward("show")(self, up=up, block=block, browser=browser)

    def union(self, *others: WorldField, smooth: float = 0.0) -> WorldField:
        """This solid and others, in the same input coordinates, as one; in a unit sphere around all (`in_one_frame`).

        ``smooth`` is the width of the blend in input units (`Union`); ValueError if it is negative.

        Example:
            >>> from mplicits.neural_fields import Similarity, Sphere, WorldField
            >>> near, far = (WorldField(Sphere(), Similarity((x, 0.0, 0.0), 10.0)) for x in (0.0, 100.0))
            >>> near.union(far).distance([[7.0, 0.0, 0.0], [92.0, 0.0, 0.0]]).round(4)
            array([2., 3.])
        """
        fields, frame = in_one_frame([self, *others])
        return WorldField(Union(*fields, smooth=smooth / frame.scale), frame)

    def intersection(self, *others: WorldField, smooth: float = 0.0) -> WorldField:
        """The points in this solid and in all others; see `union` and `Intersection`."""
        fields, frame = in_one_frame([self, *others])
        return WorldField(Intersection(*fields, smooth=smooth / frame.scale), frame)

    def difference(self, *others: WorldField, smooth: float = 0.0) -> WorldField:
        """The points in this solid and in none of the others; see `union` and `Difference`."""
        fields, frame = in_one_frame([self, *others])
        return WorldField(Difference(*fields, smooth=smooth / frame.scale), frame)

    def offset(self, by: float) -> WorldField:
        """This solid grown by a finite length in input units, or shrunk by a negative one; see `Offset`."""
        fields, frame = in_one_frame([self], margin=max(by, 0.0))
        return WorldField(Offset(*fields, by=by / frame.scale), frame)

    def shell(self, *, inside: float = 0.0, outside: float = 0.0) -> WorldField:
        """A wall of this depth inside and height outside the solid, in input units; errors and more at `Shell`."""
        fields, frame = in_one_frame([self], margin=max(outside, 0.0))
        return WorldField(Shell(*fields, inside=inside / frame.scale, outside=outside / frame.scale), frame)

    def _ask(self, points: Any, function: Callable[..., tuple[Tensor, ...]], *others: Any) -> tuple[Any, ...]:
        """``function`` of the points in the field's coordinates, in the kind and shape of the points given.

        ``others`` are rows beside the points that need no change of coordinates, such as directions.
        """
        like = self.field.like
        if isinstance(points, Tensor):
            if points.ndim == 0 or points.shape[-1] != 3:
                raise ValueError(f"points has shape {tuple(points.shape)}; expected (..., 3)")
            kind = points.dtype if points.dtype.is_floating_point else torch.get_default_dtype()
            found = function(self._to_unit(points).to(like), *(other.to(like) for other in others))
            return tuple(part.to(points.device, part.dtype if part.dtype == torch.bool else kind) for part in found)
        array = np.asarray(points, np.float64)
        if array.ndim == 0 or array.shape[-1] != 3:
            raise ValueError(f"points has shape {array.shape}; expected (..., 3)")
        rows = [torch.from_numpy(np.ascontiguousarray(part, np.float64).reshape(-1, 3)) for part in (array, *others)]
        with torch.no_grad():
            parts = [
                function(self._to_unit(unit).to(like), *(other.to(like) for other in beside))
                for unit, *beside in zip(*(part.split(1 << 18) for part in rows), strict=True)
            ]
        whole = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
        return tuple(
            (part if part.dtype == torch.bool else part.double()).reshape((*array.shape[:-1], *part.shape[1:])).numpy()
            for part in whole
        )

    def _to_unit(self, points: Tensor) -> Tensor:
        center = torch.tensor(self.similarity.center, dtype=torch.float64, device=points.device)
        return (points.double() - center) / self.similarity.scale

    def _to_input(self, points: Tensor) -> Tensor:
        center = torch.tensor(self.similarity.center, dtype=torch.float64, device=points.device)
        return points.double() * self.similarity.scale + center


def in_one_frame(shapes: Sequence[WorldField], *, margin: float = 0.0) -> tuple[list[Field], Similarity]:
    """Fields of different unit spheres in one that holds them all, and the similarity from input coordinates to theirs.

    What was learned is cut off at its own unit sphere (`Bounded`); a closed form holds everywhere. ``margin`` is room
    around the shapes, in input units. ValueError if there are no shapes, or the margin is negative or not finite.
    """
    if not shapes or not 0 <= margin < np.inf:
        raise ValueError(f"{len(shapes)} shapes, margin={margin}: expected at least one, and a finite number ≥ 0")
    centers = np.array([shape.similarity.center for shape in shapes], np.float64)
    scales = np.array([shape.similarity.scale for shape in shapes], np.float64)
    center = ((centers - scales[:, None]).min(axis=0) + (centers + scales[:, None]).max(axis=0)) / 2
    if (centers == centers[0]).all():
        center = centers[0]  # without rounding
    scale = float((np.linalg.norm(centers - center, axis=1) + scales).max()) + margin
    frame = Similarity((float(center[0]), float(center[1]), float(center[2])), scale)
    return [_placed(shape, frame) for shape in shapes], frame


def _placed(shape: WorldField, frame: Similarity) -> Field:
    if shape.similarity == frame:
        return shape.field
    field, learned = shape.field, next(shape.field.parameters(), None) is not None
    field = Bounded(field) if learned and not isinstance(field, Bounded) else field
    return Placed(field, shape.similarity.within(frame))


def _unit(gradient: Tensor) -> Tensor:
    return torch.nn.functional.normalize(gradient, dim=-1)
