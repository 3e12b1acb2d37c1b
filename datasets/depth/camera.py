"""``DepthCamera``: the lens of a depth sensor, from JSON files of two kinds, four numbers, or an angle of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...neural_fields import InputError
from ..cameras import COEFFICIENTS, Camera, intrinsics, pinhole_intrinsics
from ..files import finite_number, read_json, reader

__all__ = ["DepthCamera", "read_intrinsics"]

Float64 = NDArray[np.float64]

MODELLED = 5  # of the coefficients, in depth cameras; lenses with others are not read


@dataclass(frozen=True)
class DepthCamera:
    """The lens of a `Camera` that may stand anywhere, with at most five coefficients, and the scale of its images.

    Attributes:
        width: of the depth image, in pixels.
        height: of the depth image, in pixels.
        fx: focal length in widths of a pixel.
        fy: focal length in heights of a pixel.
        cx: where the axis meets the image, in pixels; the centre of the first pixel is at 0.
        cy: the same along the height.
        distortion: k1, k2, p1, p2, k3 of OpenCV's model; all zero for undistorted images.
        depth_scale: how many steps of an integer depth image are one unit, or None if that is not known.

    Raises:
        ValueError: a size, focal length or scale is not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy", "depth_scale"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name}={value}: expected a finite number > 0")
        for name, value in (
            ("cx", self.cx),
            ("cy", self.cy),
            *zip(COEFFICIENTS[:MODELLED], self.distortion, strict=True),
        ):
            if not math.isfinite(value):
                raise ValueError(f"{name}={value}: expected a finite number")

    @classmethod
    def from_fov(cls, fov: float, width: int, height: int) -> DepthCamera:
        """Square pixels, the axis through the middle of the image.

        Args:
            fov: full vertical angle of view, degrees.
            width: of the image, in pixels.
            height: of the image, in pixels.

        Raises:
            ValueError: ``fov`` is not between 0 and 180.
        """
        (fx, _, cx), (_, fy, cy), _ = pinhole_intrinsics(fov, width, height).tolist()
        return cls(width, height, fx, fy, cx, cy)

    @classmethod
    def from_camera(cls, camera: Camera) -> DepthCamera:
        """The pinhole of a `Camera`; its place and its distortion are left aside."""
        return cls(camera.width, camera.height, *camera.fx_fy_cx_cy)

    def at(self, world_from_camera: Float64) -> Camera:
        """The `Camera` with this lens in a pose ``(4, 4)``.

        Raises:
            ValueError: the pose is not rigid.
        """
        pose = torch.from_numpy(np.asarray(world_from_camera, np.float64))
        matrix = intrinsics(self.fx, self.fy, self.cx, self.cy)
        return Camera(matrix, pose, self.width, self.height, self.distortion)

    @property
    def matrix(self) -> Float64:
        """``(3, 3)``: ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``."""
        return intrinsics(self.fx, self.fy, self.cx, self.cy).numpy()

    @property
    def pixel_angle(self) -> float:
        """The slope from the middle of a pixel to that of the next: a pixel at depth z is this times z wide."""
        return 1 / math.sqrt(self.fx * self.fy)

    def rays(self) -> Tensor:
        """``(H, W, 3)`` float64: the points at depth 1 that the pixels see, in camera coordinates."""
        return self.at(np.eye(4)).sight_lines()

    def unproject(self, depth: Float64) -> Float64:
        """The points ``(H, W, 3)`` in camera coordinates that pixels with these depths z ``(H, W)`` see."""
        return self.rays().numpy() * depth[..., None]

    def project(self, points: Float64) -> tuple[Float64, NDArray[np.bool_]]:
        """Pixels ``(N, 2)`` where points ``(N, 3)`` in camera coordinates fall, and which of them are in the image."""
        pixels, _, inside = self.at(np.eye(4)).in_view(points)
        return pixels, inside


@reader
def read_intrinsics(path: str | Path) -> DepthCamera:
    """Read the intrinsics of a depth camera from JSON.

    - ours: ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``, and if known ``depth_scale`` and the distortion
      ``k1``, ``k2``, ``p1``, ``p2``, ``k3``;
    - Open3D's: ``width``, ``height`` and ``intrinsic_matrix``, nine numbers column by column.

    Raises:
        InputError: the file is missing or no such JSON, or a field is missing or not a number that it can be.
    """
    path = Path(path)
    content = read_json(path, missing="check the path, or give --intrinsics FX FY CX CY")
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object with width, height, fx, fy, cx and cy")
    if "intrinsic_matrix" in content:
        content = {**content, **_open3d(content["intrinsic_matrix"], path)}
    missing = [name for name in ("width", "height", "fx", "fy", "cx", "cy") if content.get(name) is None]
    if missing:
        raise InputError(f"{path}: {', '.join(missing)}: missing; add {'it' if len(missing) == 1 else 'them'}")
    numbers = {
        name: finite_number(content[name], f"{path}: {name}")
        for name in ("width", "height", "fx", "fy", "cx", "cy", "depth_scale", *COEFFICIENTS)
        if content.get(name) is not None
    }
    for name in COEFFICIENTS[MODELLED:]:
        if numbers.get(name):
            raise InputError(f"{path}: {name}: lenses with k4 to k6 are not supported; undistort the images first")
    for name in ("width", "height"):
        if not numbers[name].is_integer():
            raise InputError(f"{path}: {name}: {numbers[name]:g}; expected a whole number of pixels")
    k1, k2, p1, p2, k3 = (numbers.get(name, 0.0) for name in COEFFICIENTS[:MODELLED])
    try:
        return DepthCamera(
            int(numbers["width"]),
            int(numbers["height"]),
            *(numbers[name] for name in ("fx", "fy", "cx", "cy")),
            distortion=(k1, k2, p1, p2, k3),
            depth_scale=numbers.get("depth_scale"),
        )
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def _open3d(matrix: Any, path: Path) -> dict[str, Any]:
    if not isinstance(matrix, list) or len(matrix) != 9:
        raise InputError(f"{path}: intrinsic_matrix: expected nine numbers, column by column")
    fx, low, a, skew, fy, b, cx, cy, one = (finite_number(value, f"{path}: intrinsic_matrix") for value in matrix)
    if any((low, a, skew, b)) or one != 1:
        raise InputError(f"{path}: intrinsic_matrix: {matrix}; expected [fx, 0, 0, 0, fy, 0, cx, cy, 1]")
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
