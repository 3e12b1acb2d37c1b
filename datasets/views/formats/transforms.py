"""transforms.json in its dialects: nerfstudio, instant-ngp and the Blender scenes of NeRF."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ....neural_fields import InputError
from ...cameras import COEFFICIENTS, OPENGL, Camera, intrinsics, rigid_pose
from ...files import finite_number, read_json
from .shots import IMAGE_SUFFIXES, Shot, image_size

# Camera models of nerfstudio and COLMAP that are pinholes, once undistorted.
LENSES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL")
COMMON, DIVISOR = COEFFICIENTS[:5], COEFFICIENTS[5:]


@dataclass(frozen=True)
class _Frame:
    """One frame of a transforms.json; keys that it lacks stand at the top of the file."""

    path: Path
    index: int
    own: dict[str, Any]
    shared: dict[str, Any]

    def named(self, key: str) -> str:
        """File and field, as the beginning of a message."""
        place = key if key in self.shared and key not in self.own else f"frames[{self.index}].{key}"
        return f"{self.path}: {place}"

    def get(self, key: str) -> Any:
        return self.own.get(key, self.shared.get(key))

    def number(self, key: str) -> float | None:
        value = self.get(key)
        return None if value is None else finite_number(value, self.named(key))

    def positive(self, key: str) -> float | None:
        value = self.number(key)
        if value is not None and value <= 0:
            raise InputError(f"{self.named(key)}: {value:g}; expected more than 0")
        return value

    def angle(self, key: str) -> float | None:
        value = self.positive(key)
        if value is not None and value >= math.pi:
            raise InputError(f"{self.named(key)}: {value:g}; expected radians, less than π")
        return value


def read_transforms(path: Path) -> list[Shot]:
    """The photographs of a transforms.json; see `read_cameras` for its keys."""
    content = read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of at least one camera; is it a transforms.json?")
    shots = []
    for index, own in enumerate(frames):
        if not isinstance(own, dict):
            raise InputError(f"{path}: frames[{index}]: expected an object with file_path and transform_matrix")
        shots.append(_shot(_Frame(path, index, own, content)))
    return shots


def _shot(frame: _Frame) -> Shot:
    name, mask = (_file_name(frame, key) for key in ("file_path", "mask_path"))
    if name is None:
        raise InputError(f"{frame.named('file_path')}: None; expected the name of the image")
    folder = frame.path.parent
    image = _image(folder, name)
    # The keys of nerfstudio, and of instant-ngp, which also gives the size of an integer step.
    depth = _file_name(frame, "depth_file_path") or _file_name(frame, "depth_path")
    step = None if depth is None else frame.positive("integer_depth_scale")
    return Shot(
        name,
        _camera(frame, image),
        image,
        None if mask is None else _beside(folder, mask),
        f"{frame.path}: frames[{frame.index}]",
        None if depth is None else _beside(folder, depth),
        None if step is None else 1 / step,
    )


def _beside(folder: Path, name: str) -> Path:
    """The file of that name; names that were written on Windows may have backslashes."""
    beside = folder / name
    return beside if beside.exists() or "\\" not in name else folder / name.replace("\\", "/")


def _image(folder: Path, name: str) -> Path:
    """The image of that name, which may be missing; Blender's scenes omit its extension."""
    beside = _beside(folder, name)
    files = [beside, *(beside.with_name(beside.name + suffix) for suffix in IMAGE_SUFFIXES)]
    return next((file for file in files if file.is_file()), beside)


def _file_name(frame: _Frame, key: str) -> str | None:
    name = frame.own.get(key)
    if name == "" and key != "file_path":
        return None
    if name is not None and (not isinstance(name, str) or not name):
        raise InputError(f"{frame.named(key)}: {name!r}; expected the name of the image")
    return name


def _camera(frame: _Frame, image: Path) -> Camera | None:
    lens = frame.get("camera_model")
    unknown = lens is not None and str(lens).upper() not in LENSES
    foreign = {"camera_model": unknown, "is_fisheye": frame.get("is_fisheye")}
    for key in filter(foreign.get, foreign):
        raise InputError(f"{frame.named(key)}: {frame.get(key)!r}: no pinhole; undistort the images and export again")
    width, height = _size(frame, image)
    fx, fy = frame.positive("fl_x"), frame.positive("fl_y")
    if fx is None and (angle_x := frame.angle("camera_angle_x")) is not None:
        fx = width / 2 / math.tan(angle_x / 2)
        if fy is None and (angle_y := frame.angle("camera_angle_y")) is not None:
            fy = height / 2 / math.tan(angle_y / 2)
    if fx is None:
        raise InputError(f"{frame.named('fl_x')}: missing, and so is camera_angle_x; add one of them")
    cx, cy = frame.number("cx"), frame.number("cy")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    named = frame.named("transform_matrix")
    if "transform_matrix" not in frame.own:
        raise InputError(f"{named}: missing; add the pose of the camera, four rows of four numbers")
    value = frame.own["transform_matrix"]
    if value is None or np.isnan(pose := rigid_pose(value, named, scaled=True)).any():
        return None
    matrix = intrinsics(fx, fx if fy is None else fy, cx - 0.5, cy - 0.5)
    return Camera(matrix, torch.from_numpy(pose @ OPENGL), width, height, _distortion(frame))


def _distortion(frame: _Frame) -> tuple[float, ...]:
    """OpenCV's coefficients. k4 to k6 are the divisor of its full model; elsewhere k4 is a fourth radial term."""
    common = tuple(frame.number(key) or 0.0 for key in COMMON)
    divisor = tuple(frame.number(key) or 0.0 for key in DIVISOR)
    if not any(divisor):
        return common
    if str(frame.get("camera_model")).upper() != "FULL_OPENCV":
        key = DIVISOR[[bool(value) for value in divisor].index(True)]
        raise InputError(
            f"{frame.named(key)}: {frame.get(key):g}; expected 0 unless camera_model is FULL_OPENCV; "
            "undistort the images and export again"
        )
    return common + divisor


def _size(frame: _Frame, image: Path) -> tuple[int, int]:
    width, height = frame.positive("w"), frame.positive("h")
    if width is None or height is None:
        if not image.is_file():
            raise InputError(f"{frame.named('file_path')}: no image {image} to take the size from; add it, or w and h")
        return image_size(image)
    for key, value in (("w", width), ("h", height)):
        if value != int(value):
            raise InputError(f"{frame.named(key)}: {value:g}; expected whole pixels")
    return int(width), int(height)
