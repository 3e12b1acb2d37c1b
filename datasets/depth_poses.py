"""Poses of depth frames: Open3D's trajectory.log, and the JSON files that `read_cameras` knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .depth_camera import DepthCamera
from .views.reading import read_cameras

__all__ = ["PosedFrame", "read_poses", "read_trajectory"]

Float64 = NDArray[np.float64]
PosedFrame = tuple[str | None, Float64, DepthCamera | None]
"""Name of the frame's image, if the file has names; its world_from_camera (4, 4); its lens, if the file has one."""

RIGID = 1e-3  # how far the axes in a file, written with few digits, may be from orthonormal


def read_poses(path: str | Path) -> list[PosedFrame]:
    """Read the poses of frames, camera to world in OpenCV's axes, in the order of the file.

    Args:
        path: ``*.log`` of Open3D, or ``transforms.json``, which also brings names and lenses.

    Raises:
        InputError: see `read_trajectory` and `read_cameras`.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        return [
            (name, camera.world_from_camera.numpy(), DepthCamera.from_camera(camera))
            for name, camera in read_cameras(path)
        ]
    return [(None, pose, None) for pose in read_trajectory(path)]


def read_trajectory(path: str | Path) -> Float64:
    """Read an Open3D trajectory: per frame a line of three whole numbers, and four of a 4 × 4 matrix.

    The matrices are camera to world. Printed digits leave their axes not quite orthonormal; the nearest rotation
    (polar factor) is taken.

    Returns:
        ``(F, 4, 4)``.

    Raises:
        InputError: the file is missing, a line is not as it should be, or a matrix is no rigid pose.
    """
    path = Path(path)
    try:
        lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except ValueError as error:
        raise InputError(f"{path}: is not text; expected a trajectory.log or a transforms.json") from error
    if not lines or len(lines) % 5:
        raise InputError(f"{path}: {len(lines)} lines; expected five per frame: three numbers, then a 4 × 4 matrix")
    try:
        if any(len(words) != 3 for words in lines[::5]):
            raise ValueError("the first line of a frame has not three numbers")
        rows = [words for index, words in enumerate(lines) if index % 5]
        poses = np.array(rows, np.float64).reshape(-1, 4, 4)
    except ValueError as error:
        raise InputError(f"{path}: {error}; expected five lines per frame, as Open3D writes them") from error
    return np.stack([_rigid(pose, f"{path}: frame {index}") for index, pose in enumerate(poses)])


def _rigid(pose: Float64, named: str) -> Float64:
    axes = pose[:3, :3]
    finite = bool(np.isfinite(pose).all())
    off = np.abs(axes.T @ axes - np.eye(3)).max() if finite else np.inf
    if off > RIGID or np.linalg.det(axes) < 0 or bool((pose[3] != (0, 0, 0, 1)).any()):
        raise InputError(f"{named}: {pose.round(4).tolist()}; expected a rigid pose, camera to world")
    left, _, right = np.linalg.svd(axes)
    rigid = pose.copy()
    rigid[:3, :3] = left @ right
    return rigid
