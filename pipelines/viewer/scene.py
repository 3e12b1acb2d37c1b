"""What stands in a browser's scene beside the traced image: mesh, cloud, band shells, slice plane, pointer mark.

Meshes and points are made when they are first asked for, once for all browsers (`Shapes`); which of them stand in the
scene of one browser follows its controls (`SceneNodes`).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from ...datasets import read_cloud
from ...neural_fields import Field, InputError, Jet, Similarity
from ...neural_fields.fields.field import OneLevelField
from ...neural_fields.meshing.extract import Mesh, NoSurfaceError, extract_mesh
from ..render.slice import draw_slice, plane_axes, round_step, take_slice
from .camera import Reading
from .controls import Controls
from .frames import Superseded
from .paint import KEPT, Moments

__all__ = ["ImagePose", "OffsetField", "SceneNodes", "Shapes", "slice_image"]

T = TypeVar("T")

MESH_COLOR = (204, 199, 189)
WIRE_COLOR = (40, 60, 90)
CLOUD_COLOR = (40, 90, 170)
SHELL_COLORS = ((225, 120, 60), (70, 130, 220))  # f = −δ, f = δ
SHELL_OPACITY = 0.3
# Points are half as wide as they would be apart, spread over a sphere of half the unit's radius; within these limits.
POINT_SIZES = (0.002, 0.02)
MARK_COLOR = (220, 40, 40)
MARK_LENGTH = 0.15
MARK_RADIUS = 0.012
# Wires lie on the surface itself; a little larger, they are not half hidden by it.
WIRE_SCALE = 1.002
# Cells along the cube: an offset surface has no detail to lose, and this takes a second or two on two cores.
MESH_RESOLUTION = 160
SHELL_RESOLUTION = 96
# More points than this make browsers slow, and cover the screen all the same.
MOST_POINTS = 200_000
ISO_STEP = 0.05


class OffsetField(OneLevelField):
    """One level of a field, less a constant: its zero set is where that level has the value ``offset``."""

    def __init__(self, field: Field, *, level: int, offset: float) -> None:
        super().__init__(field.in_dim)
        self.field, self.level, self.offset = field, field.resolve_level(level), float(offset)

    def value(self, x: Tensor, *, level: int = -1) -> Tensor:
        """See `Field.value`."""
        self.resolve_level(level)
        return self.field.value(x, level=self.level) - self.offset

    def jet(self, x: Tensor, *, level: int = -1) -> Jet:
        """See `Field.jet`."""
        self.resolve_level(level)
        value, gradient, features = self.field.jet(x, level=self.level)
        return Jet(value - self.offset, gradient, features)


class Shapes:
    """Meshes of a field's levels and bands, and the cloud it was fitted to, in unit-sphere coordinates.

    Each is made once, in the thread that asks first; whoever asks meanwhile waits for it.

    Args:
        field: the field, three- or four-dimensional.
        similarity: from input to unit-sphere coordinates.
        cloud: the file that the field was fitted to, if it is known and still there.
    """

    def __init__(self, field: Field, similarity: Similarity, *, cloud: Path | None = None) -> None:
        self.moments, self._similarity = Moments(field), similarity
        self._closed = threading.Event()
        self.cloud_file = cloud
        self._meshes: dict[tuple[float, int, float], Mesh | None] = {}
        self._points: NDArray[np.float32] | None = None
        self._lock = threading.Lock()

    def surface(self, level: int, *, time: float = 0.0) -> Mesh | None:
        """The zero set of a level; None where it has none."""
        return self._mesh(time, level, 0.0, MESH_RESOLUTION)

    def shells(self, level: int, *, time: float = 0.0) -> tuple[Mesh | None, Mesh | None]:
        """The surfaces f_i = −δ_i and f_i = δ_i of a level but the last; where all is thin there is no inner one."""
        delta = float(self.moments.field.deltas[level])
        inner, outer = (self._mesh(time, level, offset, SHELL_RESOLUTION) for offset in (-delta, delta))
        return inner, outer

    def cloud(self) -> NDArray[np.float32]:
        """Points of the input ``(N, 3)``, at most `MOST_POINTS` of them, evenly taken.

        Raises:
            InputError: the file is not known, or cannot be read any more.
        """
        with self._lock:
            if self._points is None:
                if self.cloud_file is None:
                    raise InputError("the cloud that the field was fitted to is not to be found")
                points = read_cloud(self.cloud_file).points
                points = points[np.isfinite(points).all(axis=1)]
                step = max(1, math.ceil(len(points) / MOST_POINTS))
                self._points = self._similarity.to_unit(points[::step]).astype(np.float32)
            return self._points

    def close(self) -> None:
        """Give up what is being made; whoever waits for it gets a `Superseded`."""
        self._closed.set()

    def _go_on(self, *_progress: object) -> None:
        if self._closed.is_set():
            raise Superseded

    def _mesh(self, time: float, level: int, offset: float, resolution: int) -> Mesh | None:
        with self._lock:
            key = (time if self.moments.moves else 0.0, level, offset)
            if key not in self._meshes:
                field = self.moments.at(time)
                while self.moments.moves and len(self._meshes) >= KEPT:
                    del self._meshes[next(iter(self._meshes))]  # the oldest
                reach = 1.02 + abs(offset)
                try:
                    self._meshes[key] = extract_mesh(
                        OffsetField(field, level=level, offset=offset) if offset else field,
                        resolution=resolution,
                        level=0 if offset else level,
                        bounds=((-reach, -reach, -reach), (reach, reach, reach)),
                        normals=False,
                        batch=1 << 15,
                        progress=self._go_on,
                    )
                except NoSurfaceError:
                    self._meshes[key] = None
            return self._meshes[key]


@dataclass(frozen=True)
class ImagePose:
    """Where an image stands in the scene: its columns run along its own x axis, its rows along its own y axis.

    Attributes:
        size: width and height in the scene.
        wxyz: ``(4,)`` quaternion of its rotation.
        center: ``(3,)`` its middle.
    """

    size: tuple[float, float]
    wxyz: NDArray[np.float64]
    center: NDArray[np.float64]


def slice_image(
    field: Field, axis: int, position: float, *, level: int, scale: float, pixels: int = 384
) -> tuple[NDArray[np.uint8], ImagePose]:
    """The picture of a plane across an axis, and its place in the cube [−1, 1]³.

    Args:
        field: what to cut.
        axis: 0, 1 or 2.
        position: where on it.
        level: the finest level drawn.
        scale: input units per unit of the field; iso-lines are a round number of input units apart.
        pixels: along each side.
    """
    normal, center = np.zeros(3), np.zeros(3)
    normal[axis], center[axis] = 1.0, position
    u, v = plane_axes(normal)
    taken = take_slice(field, origin=center, u=u, v=v, half_size=1.0, size=(pixels, pixels), level=level)
    image = draw_slice(taken, iso_step=round_step(ISO_STEP * scale) / scale)
    quaternion = Rotation.from_matrix(np.stack((u, -v, -np.cross(u, v)), axis=1)).as_quat()
    return image, ImagePose((2.0, 2.0), np.roll(quaternion, 1), center)


class SceneNodes:
    """Keeps viser's scene as the controls want it.

    Args:
        scene: viser's interface to the scene of one browser.
        shapes: knows the field, and makes the meshes.
        controls: say what is wanted.
        scale: input units per unit of the field.
        check: raises `Superseded` when the browser has left.
    """

    def __init__(
        self, scene: Any, shapes: Shapes, controls: Controls, *, scale: float, check: Callable[[], None]
    ) -> None:
        self._scene, self._shapes, self._controls = scene, shapes, controls
        self._scale, self._check = scale, check
        self._nodes: dict[str, list[Any]] = {}
        self._wanted: dict[str, object] = {}
        self._lock = threading.Lock()

    @property
    def is_filled(self) -> bool:
        """Whether anything stands beside the traced image."""
        return any(self._nodes.values())

    def arrange(self, busy: Callable[[], None]) -> None:
        """Add what is wanted and is not there, and remove what is there and not wanted.

        Several threads may call it; each sees the controls as they are when its turn comes, so that of many
        movements of a slider only the last is drawn.

        Args:
            busy: called before a mesh is made that may take a while.

        Raises:
            InputError: the input cloud cannot be read.
        """
        with self._lock:
            plane, mesh, band, time = (
                self._controls.slice,
                self._controls.mesh,
                self._controls.band,
                self._controls.time,
            )
            self._want("slice", plane and (*plane, self._controls.level, time), self._add_slice)
            self._want("cloud", self._controls.cloud or None, self._add_cloud)
            self._want("mesh", mesh and (*mesh, time), self._add_mesh, busy)
            self._want("shells", None if band is None else (band, time), self._add_shells, busy)

    def mark(self, reading: Reading | None) -> None:
        """Mark the point that was read, with its normal."""
        with self._lock:
            self._want("mark", reading, self._add_mark)

    def pin(self, places: Sequence[tuple[int, NDArray[np.float64]]]) -> None:
        """Mark landmarks: a ball at each, with its number."""
        wanted = tuple((number, *point.tolist()) for number, point in places)
        with self._lock:
            self._want("pins", wanted or None, self._add_pins)

    def _want(
        self, name: str, wanted: T | None, add: Callable[[T], list[Any]], busy: Callable[[], None] = lambda: None
    ) -> None:
        if self._wanted.get(name) == wanted:
            return
        for node in self._nodes.pop(name, []):
            node.remove()
        self._wanted[name] = None
        if wanted is not None:
            busy()
            self._nodes[name] = add(wanted)
        self._wanted[name] = wanted

    def _add_mesh(self, wanted: tuple[int, bool, float]) -> list[Any]:
        level, wires, time = wanted
        mesh = self._shapes.surface(level, time=time)
        self._check()
        if mesh is None:
            return []
        look: dict[str, Any] = {"color": MESH_COLOR}
        if wires:
            look = {"color": WIRE_COLOR, "wireframe": True, "scale": WIRE_SCALE}
        return [self._scene.add_mesh_simple("/mesh", mesh.vertices, mesh.faces, cast_shadow=False, **look)]

    def _add_cloud(self, _wanted: bool) -> list[Any]:
        points = self._shapes.cloud()
        size = float(np.clip(np.sqrt(np.pi / len(points)) / 2, *POINT_SIZES))
        self._check()
        look: dict[str, Any] = {"point_size": size, "point_shape": "circle", "precision": "float32"}
        return [self._scene.add_point_cloud("/cloud", points, CLOUD_COLOR, **look)]

    def _add_shells(self, wanted: tuple[int, float]) -> list[Any]:
        band, time = wanted
        shells = self._shapes.shells(band, time=time)
        self._check()
        look: dict[str, Any] = {"opacity": SHELL_OPACITY, "side": "double", "cast_shadow": False}
        return [
            self._scene.add_mesh_simple(f"/shells/{index}", mesh.vertices, mesh.faces, color=color, **look)
            for index, (mesh, color) in enumerate(zip(shells, SHELL_COLORS, strict=True))
            if mesh is not None
        ]

    def _add_slice(self, wanted: tuple[int, float, int, float]) -> list[Any]:
        axis, position, level, time = wanted
        image, pose = slice_image(self._shapes.moments.at(time), axis, position, level=level, scale=self._scale)
        self._check()
        look: dict[str, Any] = {"format": "png", "cast_shadow": False, "receive_shadow": False}
        return [self._scene.add_image("/slice", image, *pose.size, wxyz=pose.wxyz, position=pose.center, **look)]

    def _add_pins(self, wanted: tuple[tuple[int, float, float, float], ...]) -> list[Any]:
        nodes = []
        for index, (number, *place) in enumerate(wanted):
            nodes.append(self._scene.add_icosphere(f"/pins/{index}", MARK_RADIUS, MARK_COLOR, position=place))
            nodes.append(self._scene.add_label(f"/pins/{index}/number", str(number)))
        return nodes

    def _add_mark(self, reading: Reading) -> list[Any]:
        point, tip = reading.point, reading.point + MARK_LENGTH * reading.normal
        return [
            self._scene.add_icosphere("/mark/point", MARK_RADIUS, MARK_COLOR, position=point),
            self._scene.add_line_segments(
                "/mark/normal", np.array([[point, tip]]), MARK_COLOR, thickness=3.0, thickness_units="screen"
            ),
        ]
