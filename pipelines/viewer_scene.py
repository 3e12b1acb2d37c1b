"""What stands in one browser's scene beside the traced image: mesh, cloud, band shells, slice plane, pointer mark."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from .viewer_controls import Controls
from .viewer_probe import Reading
from .viewer_shapes import Shapes, slice_image

__all__ = ["Scene"]

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


class Scene:
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

    def _add_mark(self, reading: Reading) -> list[Any]:
        point, tip = reading.point, reading.point + MARK_LENGTH * reading.normal
        return [
            self._scene.add_icosphere("/mark/point", MARK_RADIUS, MARK_COLOR, position=point),
            self._scene.add_line_segments("/mark/normal", np.array([[point, tip]]), MARK_COLOR, line_width=3.0),
        ]
