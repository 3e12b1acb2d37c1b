"""``DepthCamera``: the lens of a depth sensor, from JSON, YAML, four numbers, or an angle of view."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor

from ...neural_fields import InputError
from ..cameras import COEFFICIENTS, Camera, Float64, intrinsics, pinhole_intrinsics
from ..files import decoded, finite_number, read_json, readable


@dataclass(frozen=True)
class DepthCamera:
    """The lens of a depth camera without a pose, and the scale of its integer images.

    Attributes:
        width: of the depth image, in pixels.
        height: of the depth image, in pixels.
        fx: focal length in widths of a pixel.
        fy: focal length in heights of a pixel.
        cx: principal point in pixels; the centre of the first pixel is at 0.
        cy: the same along the height.
        distortion: k1, k2, p1, p2, k3 of OpenCV's model; all zero for undistorted images.
        depth_scale: steps of an integer depth image per unit, or None if unknown.

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
        for name, value in (("cx", self.cx), ("cy", self.cy), *zip(COEFFICIENTS[:5], self.distortion, strict=True)):
            if not math.isfinite(value):
                raise ValueError(f"{name}={value}: expected a finite number")

    @classmethod
    def from_fov(cls, fov: float, width: int, height: int) -> DepthCamera:
        """Square pixels and an axis through the middle of the image; ``fov`` is the vertical angle in degrees."""
        (fx, _, cx), (_, fy, cy), _ = pinhole_intrinsics(fov, width, height).tolist()
        return cls(width, height, fx, fy, cx, cy)

    @classmethod
    def from_camera(cls, camera: Camera) -> DepthCamera:
        """The pinhole of a `Camera`, without its pose and distortion."""
        return cls(camera.width, camera.height, *camera.fx_fy_cx_cy)

    def at(self, world_from_camera: Float64) -> Camera:
        """The `Camera` with this lens and a rigid pose ``(4, 4)``."""
        pose = torch.from_numpy(np.asarray(world_from_camera, np.float64))
        return Camera(intrinsics(self.fx, self.fy, self.cx, self.cy), pose, self.width, self.height, self.distortion)

    @property
    def pixel_angle(self) -> float:
        """Width of a pixel at depth 1."""
        return 1 / math.sqrt(self.fx * self.fy)

    def rays(self) -> Tensor:
        """``(H, W, 3)`` float64: the points of the pixels at depth 1, in camera coordinates."""
        return self.at(np.eye(4)).sight_lines()

    def unproject(self, depth: Float64) -> Float64:
        """The points ``(H, W, 3)`` in camera coordinates of pixels with depths z ``(H, W)``."""
        return self.rays().numpy() * depth[..., None]


def read_intrinsics(path: str | Path, *, size: tuple[int, int] | None = None) -> DepthCamera:
    """Read the intrinsics of a depth camera.

    - JSON and YAML with numbers (ours, Polycam's): ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``. Optional
      are ``depth_scale`` and the distortion ``k1``, ``k2``, ``p1``, ``p2``, ``k3``.
    - JSON and YAML with a matrix, by rows or by columns. Read are Open3D's intrinsics and camera parameters,
      Record3D's metadata, ROS's camera information and OpenCV's calibration.
    - Text: four numbers fx fy cx cy, or a matrix of 3 × 3 or more.

    Args:
        path: the file.
        size: width and height of the images, for files without them.

    Raises:
        InputError: the file is missing or none of these, or a field is missing or impossible.
    """
    path = Path(path)
    fix = "give --intrinsics FX FY CX CY in pixels"
    advice = f"check the path, or {fix}"
    with readable(path, missing=advice):
        is_json = path.suffix.lower() == ".json"
        content = read_json(path, missing=advice) if is_json else _from_text(decoded(path.read_bytes()), path)
        if not isinstance(content, dict):
            raise InputError(f"{path}: expected width, height, fx, fy, cx and cy, or a 3 × 3 matrix; or {fix}")
        fields = _fields({} if size is None else {"width": size[0], "height": size[1]}, content, path)
    if missing := [name for name in _FIELDS if fields.get(name) is None]:
        add = "it" if len(missing) == 1 else "them"
        raise InputError(f"{path}: {', '.join(missing)}: missing; add {add}, or {fix}")
    numbers = {
        name: finite_number(fields[name], f"{path}: {name}")
        for name in (*_FIELDS, "depth_scale", *COEFFICIENTS)
        if fields.get(name) is not None
    }
    for name in COEFFICIENTS[5:]:
        if numbers.get(name):
            raise InputError(f"{path}: {name}: lenses with k4 to k6 are not supported; undistort the images first")
    for name in ("width", "height"):
        if not numbers[name].is_integer():
            raise InputError(f"{path}: {name}: {numbers[name]:g}; expected a whole number of pixels")
    k1, k2, p1, p2, k3 = (numbers.get(name, 0.0) for name in COEFFICIENTS[:5])
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


_FIELDS = ("width", "height", "fx", "fy", "cx", "cy")
_OTHER_NAMES = {"w": "width", "h": "height", "image_width": "width", "image_height": "height"}
_MATRICES = ("intrinsic_matrix", "camera_matrix", "K", "k", "matrix")
_DISTORTIONS = ("distortion_coefficients", "dist_coeffs", "D", "d")


def _from_text(text: str, path: Path) -> Any:
    """YAML with names, or bare numbers."""
    words = re.sub(r"#.*|[][,]", " ", text).split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        try:
            return yaml.safe_load(re.sub(r"^%YAML.*$|!!opencv-matrix", "", text, flags=re.MULTILINE))
        except yaml.YAMLError as error:
            reason = " ".join(str(error).split())[:80]
            raise InputError(f"{path}: neither numbers nor YAML ({reason}); give --intrinsics FX FY CX CY") from error
    if len(numbers) == 4:
        return dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
    return {"matrix": numbers}


def _fields(known: dict[str, Any], content: dict[str, Any], path: Path) -> dict[str, Any]:
    """The fields of a file under the names of `DepthCamera`, over those that are known already."""
    if isinstance(content.get("intrinsic"), dict):
        content = {**content, **content["intrinsic"]}
    fields = {**known, **{_OTHER_NAMES.get(name, name): value for name, value in content.items()}}
    for name in (name for name in _MATRICES if content.get(name) is not None):
        fields |= _matrix(_flat(content[name]), f"{path}: {name}")
    for name in (name for name in _DISTORTIONS if content.get(name) is not None):
        model = str(content.get("distortion_model", "plumb_bob"))
        coefficients = _flat(content[name])
        if model not in ("plumb_bob", "rational_polynomial") and any(coefficients):
            raise InputError(f"{path}: distortion_model: {model}: no pinhole; undistort the images first")
        fields |= dict(zip(COEFFICIENTS, coefficients, strict=False))
    return fields


def _flat(value: Any) -> list[Any]:
    """The numbers of lists in lists, or of a matrix with its ``data``."""
    value = value.get("data") if isinstance(value, dict) else value
    return [x for row in value for x in _flat(row)] if isinstance(value, list) else [value]


def _matrix(numbers: list[Any], named: str) -> dict[str, float]:
    """fx, fy, cx and cy of a matrix by rows or columns: 3 × 3, 3 × 4 or 4 × 4."""
    values = np.array([finite_number(number, named) for number in numbers])
    expected = f"{named}: {values.tolist()}; expected fx 0 cx, 0 fy cy, 0 0 1, by rows or by columns"
    if len(values) not in (9, 12, 16):
        raise InputError(expected)
    matrix = values.reshape(4 if len(values) == 16 else 3, -1)[:3]
    if len(values) == 9 and matrix[2, :2].any():
        matrix = matrix.T
    (fx, skew, cx), (a, fy, cy), last = matrix[:, :3].tolist()
    if skew or a or last != [0, 0, 1] or matrix[:, 3:].any():
        raise InputError(expected)
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
