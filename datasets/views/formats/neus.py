"""cameras_sphere.npz of NeuS and IDR: projections, and the sphere that the object is in."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ....neural_fields import InputError, Similarity
from ...cameras import Camera, intrinsics
from ...files import read_arrays
from .shots import Shot, image_size, list_images

IMAGE_FOLDERS = ("image", "images", "rgb")  # beside the file; NeuS has the first
MASK_FOLDERS = ("mask", "masks")
MAX_SKEW = 0.5  # pixels that skew may move a point at the image's edge, before the camera is refused
SAME_SPHERE = 1e-5  # how far two spheres, or the axes of one, may be apart, as a share of their radius


def read_neus(path: Path) -> list[Shot]:
    """The projections ``world_mat_i``, with the i-th image and mask in name order beside the file."""
    matrices = _arrays(path, "world_mat")
    if not matrices:
        raise InputError(f"{path}: world_mat_0: no such array; is it a cameras_sphere.npz?")
    images = _files(path, IMAGE_FOLDERS)
    if not images:
        folder = path.parent / IMAGE_FOLDERS[0]
        raise InputError(f"{path}: no images in {folder} to take names and sizes from; put them there")
    masks = _files(path, MASK_FOLDERS)
    for kind, files in (("images", images), ("masks", masks)):
        if files and len(files) != len(matrices):
            count = f"{len(matrices)} world_mat_i, but {len(files)} {kind} in {files[0].parent}"
            raise InputError(f"{path}: {count}; make them match")
    shots = []
    for index, image in enumerate(images):
        name = f"world_mat_{index}"
        if name not in matrices:
            raise InputError(f"{path}: {name}: no such array; number them from 0 without gaps")
        camera = _camera(matrices[name], image_size(image), f"{path}: {name}")
        mask = masks[index] if masks else None
        shots.append(Shot(image.relative_to(path.parent).as_posix(), camera, image, mask, f"{path}: {name}"))
    return shots


def read_neus_sphere(path: Path) -> Similarity | None:
    """The region of the object: ``scale_mat_i`` is ``x_world = scale · x_unit + center``; None without such arrays."""
    matrices = _arrays(path, "scale_mat")
    if not matrices:
        return None
    first, expected = next(iter(matrices)), "expected one uniform scale and shift"
    for name, matrix in matrices.items():
        if matrix.shape != (4, 4) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
            raise InputError(f"{path}: {name}: {matrix.dtype} of shape {matrix.shape}; {expected}, (4, 4) and finite")
        scale = float(matrix[0, 0])
        uniform = np.eye(4) * (scale, scale, scale, 1)
        uniform[:3, 3] = matrix[:3, 3]
        if scale <= 0 or np.abs(matrix - uniform).max() > SAME_SPHERE * scale:
            raise InputError(f"{path}: {name}: {matrix.tolist()}; {expected}")
        if np.abs(matrix - matrices[first]).max() > SAME_SPHERE * scale:
            raise InputError(f"{path}: {name}: differs from {first}; {expected} for all views")
    center = matrices[first][:3, 3].astype(np.float64)
    return Similarity((float(center[0]), float(center[1]), float(center[2])), float(matrices[first][0, 0]))


def _arrays(path: Path, kind: str) -> Mapping[str, NDArray[Any]]:
    """The arrays ``kind_i`` of the archive; others are not read."""
    arrays = read_arrays(path, lambda names: [name for name in names if re.fullmatch(rf"{kind}_\d+", name)])
    return arrays if isinstance(arrays, dict) else {}


def _files(path: Path, folders: Sequence[str]) -> list[Path]:
    """The images of the first folder beside the file that has any."""
    return next(filter(None, (list_images(path.parent / folder) for folder in folders)), [])


def _camera(matrix: NDArray[Any], size: tuple[int, int], named: str) -> Camera | None:
    """The camera of ``P = K R [I | −eye]``, which maps homogeneous world points to pixels; None if not finite."""
    if matrix.shape not in ((4, 4), (3, 4)) or matrix.dtype.kind not in "fiu":
        raise InputError(f"{named}: {matrix.dtype} of shape {matrix.shape}; expected numbers of shape (4, 4)")
    projection = matrix[:3].astype(np.float64)
    if not np.isfinite(projection).all():
        return None
    if np.linalg.cond(projection[:, :3]) > 1e12:
        raise InputError(f"{named}: its left 3 × 3 part is singular; expected intrinsics times a rigid pose")
    # P and −P are one projection; only the one with a positive determinant has z forward.
    projection *= np.sign(np.linalg.det(projection[:, :3]))
    calibration, rotation, eye, *_ = (
        np.asarray(part, np.float64) for part in cv2.decomposeProjectionMatrix(projection)
    )
    calibration = calibration / calibration[2, 2]
    width, height = size
    if (skew := abs(calibration[0, 1]) * height / 2 / calibration[1, 1]) > MAX_SKEW:
        raise InputError(f"{named}: its pixels are skewed by {skew:.2g} at the image's edge; undistort the images")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, eye[:3, 0] / eye[3, 0]
    fx, fy, cx, cy = (float(calibration[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(intrinsics(fx, fy, cx, cy), torch.from_numpy(pose), width, height)
