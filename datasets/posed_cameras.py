"""Cameras of posed images: transforms.json in its dialects, and NeuS's cameras_sphere.npz.

Lens distortion (k1, k2, p1, p2 and their like) is left aside: the cameras are the pinholes that undistorted images
have, which is right for drawing, but not for reading colours out of distorted photographs.
"""

from __future__ import annotations

import json
import math
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..neural_fields import InputError
from .cameras import Camera

__all__ = ["read_cameras"]

Float64 = NDArray[np.float64]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
IMAGE_FOLDERS = ("image", "images", "rgb")  # beside a cameras_sphere.npz; NeuS has the first
# Camera models of nerfstudio and COLMAP that are pinholes, once undistorted.
LENSES = ("PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL")
OBLIQUE = 1e-3  # how far the axes of a pose may be from orthogonal and of one length, as a share of their length
MAX_SKEW = 0.5  # pixels that skew may move a point at the image's edge, before we say that we cannot draw it


def read_cameras(path: str | Path) -> list[tuple[str, Camera]]:
    """Read the cameras of posed images, with the images' names, in the file's own world coordinates.

    - ``*.json``: transforms.json of nerfstudio, instant-ngp and the Blender scenes of NeRF. ``transform_matrix`` is
      the pose in OpenGL's convention (x right, y up, z backward) and becomes OpenCV's. The focal length is ``fl_x``,
      ``fl_y`` or ``camera_angle_x``; ``cx`` and ``cy`` count from the image's corner, so half a pixel is taken off; all
      may stand at the top or in a frame. Without ``w`` and ``h`` the image itself is asked.
    - ``*.npz``: NeuS and IDR; ``world_mat_i`` projects onto pixels and is taken apart. The i-th image in name order of
      the folder ``image`` beside the file gives name and size.

    Raises:
        InputError: the file is missing, damaged or of another kind, or a camera in it cannot be one.

    Example:
        >>> read_cameras("cameras.txt")
        Traceback (most recent call last):
        ...
        mplicits.neural_fields.errors.InputError: cameras.txt: no such file; check the path
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; name the transforms.json or cameras_sphere.npz in it")
    if not path.exists():
        raise InputError(f"{path}: no such file; check the path")
    readers = {".json": _read_transforms, ".npz": _read_neus}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: unknown extension {path.suffix!r}; cameras are read from .json and .npz")
    try:
        return readers[path.suffix.lower()](path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check its permissions") from error


@dataclass(frozen=True)
class _Frame:
    """One frame of a transforms.json; what it does not say itself stands at the top of the file."""

    path: Path
    index: int
    own: dict[str, Any]
    shared: dict[str, Any]

    def named(self, key: str) -> str:
        """File and field, as the beginning of a message."""
        return f"{self.path}: {key}" if key in self.shared and key not in self.own else self._own(key)

    def _own(self, key: str) -> str:
        return f"{self.path}: frames[{self.index}].{key}"

    def get(self, key: str) -> Any:
        return self.own.get(key, self.shared.get(key))

    def number(self, key: str) -> float | None:
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{self.named(key)}: {value!r}; expected a finite number")
        return float(value)

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


def _read_transforms(path: Path) -> list[tuple[str, Camera]]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # both of JSON and of UTF-8
        raise InputError(f"{path}: is not JSON ({error}); export it again") from error
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of at least one camera; is it a transforms.json?")
    cameras = []
    for index, own in enumerate(frames):
        if not isinstance(own, dict):
            raise InputError(f"{path}: frames[{index}]: expected an object with file_path and transform_matrix")
        frame = _Frame(path, index, own, content)
        name = own.get("file_path")
        if not isinstance(name, str) or not name:
            raise InputError(f"{frame.named('file_path')}: {name!r}; expected the name of the image")
        cameras.append((name, _transforms_camera(frame, name)))
    return cameras


def _transforms_camera(frame: _Frame, name: str) -> Camera:
    from kornia.geometry.conversions import camtoworld_graphics_to_vision_4x4  # here: it takes a fifth of a second

    lens = frame.get("camera_model")
    unknown = lens is not None and str(lens).upper() not in LENSES
    foreign = {"camera_model": unknown, "is_fisheye": frame.get("is_fisheye")}
    for key in filter(foreign.get, foreign):
        raise InputError(f"{frame.named(key)}: {frame.get(key)!r}: no pinhole; undistort the images and export again")
    width, height = _transforms_size(frame, name)
    fx, fy = frame.positive("fl_x"), frame.positive("fl_y")
    angle_x, angle_y = frame.angle("camera_angle_x"), frame.angle("camera_angle_y")
    if fx is None and angle_x is not None:
        fx = width / 2 / math.tan(angle_x / 2)
        if fy is None and angle_y is not None:
            fy = height / 2 / math.tan(angle_y / 2)
    if fx is None:
        raise InputError(f"{frame.named('fl_x')}: missing, and so is camera_angle_x; add one of them")
    cx, cy = frame.number("cx"), frame.number("cy")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    pose = _matrix(frame.own.get("transform_matrix"), frame.named("transform_matrix"))
    turned = camtoworld_graphics_to_vision_4x4(torch.from_numpy(pose)[None])[0]
    return Camera(_intrinsics(fx, fx if fy is None else fy, cx - 0.5, cy - 0.5), turned, width, height)


def _transforms_size(frame: _Frame, name: str) -> tuple[int, int]:
    width, height = frame.positive("w"), frame.positive("h")
    if width is None or height is None:
        beside = frame.path.parent / name
        # Blender's scenes name their images without an extension.
        files = [beside, *(beside.with_name(beside.name + suffix) for suffix in IMAGE_SUFFIXES)]
        found = [file for file in files if file.is_file()]
        if not found:
            raise InputError(f"{frame.named('file_path')}: no image {beside} to take the size from; add it, or w and h")
        return _image_size(found[0])
    for key, value in (("w", width), ("h", height)):
        if value != int(value):
            raise InputError(f"{frame.named(key)}: {value:g}; expected whole pixels")
    return int(width), int(height)


def _matrix(value: Any, named: str) -> Float64:
    """A rigid pose ``(4, 4)`` from the lists of a file; a common scale of its axes, which moves no ray, is dropped."""
    if value is None:
        raise InputError(f"{named}: missing; add the pose of the camera, four rows of four numbers")
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{named}: expected four rows of four numbers") from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{named}: shape {matrix.shape}; expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise InputError(f"{named}: holds a number that is not finite; leave that frame out")
    left, lengths, right = np.linalg.svd(matrix[:3, :3])
    axes = left @ right  # the nearest rotation: files have the digits of float32, or fewer
    if lengths[2] < (1 - OBLIQUE) * lengths[0] or not lengths[0] or np.linalg.det(axes) < 0:
        raise InputError(f"{named}: is singular, mirrored or oblique; expected a rotation and a place")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, matrix[:3, 3]
    return pose


def _read_neus(path: Path) -> list[tuple[str, Camera]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            # scale_mat_i, and the inverses that some files hold as well, are not needed for the cameras.
            matrices = {name: archive[name] for name in archive.files if re.fullmatch(r"world_mat_\d+", name)}
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: damaged or not an NPZ archive of numbers; export it again") from error
    if not matrices:
        raise InputError(f"{path}: world_mat_0: no such array; is it a cameras_sphere.npz?")
    images = _images_beside(path)
    if len(images) != len(matrices):
        folder = images[0].parent
        raise InputError(f"{path}: {len(matrices)} world_mat_i, but {len(images)} images in {folder}; make them match")
    cameras = []
    for index, image in enumerate(images):
        name = f"world_mat_{index}"
        if name not in matrices:
            raise InputError(f"{path}: {name}: no such array; number them from 0 without gaps")
        camera = _neus_camera(matrices[name], _image_size(image), f"{path}: {name}")
        cameras.append((image.relative_to(path.parent).as_posix(), camera))
    return cameras


def _images_beside(path: Path) -> list[Path]:
    for folder in IMAGE_FOLDERS:
        if (path.parent / folder).is_dir():
            files = (path.parent / folder).iterdir()
            images = sorted(file for file in files if file.suffix.lower() in IMAGE_SUFFIXES)
            if images:
                return images
    folder = path.parent / IMAGE_FOLDERS[0]
    raise InputError(f"{path}: no images in {folder} to take names and sizes from; put them there")


def _neus_camera(matrix: NDArray[Any], size: tuple[int, int], named: str) -> Camera:
    """Take ``P = K R [I | −eye]``, which maps homogeneous world points to pixels, apart."""
    import cv2  # here, like imageio below, because only reading cameras needs it

    if matrix.shape not in ((4, 4), (3, 4)) or matrix.dtype.kind not in "fiu":
        raise InputError(f"{named}: {matrix.dtype} of shape {matrix.shape}; expected numbers of shape (4, 4)")
    projection = matrix[:3].astype(np.float64)
    if not np.isfinite(projection).all():
        raise InputError(f"{named}: holds a number that is not finite; leave that camera out")
    if np.linalg.cond(projection[:, :3]) > 1e12:
        raise InputError(f"{named}: its left 3 × 3 part is singular; expected intrinsics times a rigid pose")
    # P and −P are one projection; only the one with a positive determinant has z forward.
    projection *= np.sign(np.linalg.det(projection[:, :3]))
    calibration, rotation, eye, *_ = (
        np.asarray(part, np.float64) for part in cv2.decomposeProjectionMatrix(projection)
    )
    calibration = calibration / calibration[2, 2]
    width, height = size
    skew = abs(calibration[0, 1]) * height / 2 / calibration[1, 1]
    if skew > MAX_SKEW:
        raise InputError(f"{named}: its pixels are skewed by {skew:.2g} at the image's edge; undistort the images")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, eye[:3, 0] / eye[3, 0]
    fx, fy, cx, cy = (float(calibration[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(_intrinsics(fx, fy, cx, cy), torch.from_numpy(pose), width, height)


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)


def _image_size(path: Path) -> tuple[int, int]:
    """Width and height, from the header alone."""
    import imageio.v3 as iio

    try:
        shape = iio.improps(path).shape
    except (OSError, ValueError, SyntaxError) as error:  # Pillow's PNG reader raises SyntaxError
        raise InputError(f"{path}: cannot be read as an image; export it again") from error
    return int(shape[1]), int(shape[0])
