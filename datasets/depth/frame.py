"""``RgbdFrame``: a depth map, its lens, its colours and where it was seen from, each from its file.

Poses are those of Open3D's trajectory.log, or of the JSON files that `read_cameras` knows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...neural_fields import InputError
from ..cameras import Camera
from ..files import readable, reader
from ..views.formats.reading import read_cameras
from .camera import DepthCamera
from .images import fit_color, read_color, read_depth

__all__ = ["PosedFrame", "RgbdFrame", "read_frame", "read_poses", "read_trajectory"]

Float64 = NDArray[np.float64]
PosedFrame = tuple[str | None, Float64, DepthCamera | None]
"""Name of the frame's image, if the file has names; its world_from_camera (4, 4); its lens, if the file has one."""

RIGID = 1e-3  # how far the axes in a file, written with few digits, may be from orthonormal


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """What a depth camera saw at one moment.

    Attributes:
        depth: ``(H, W)`` float64, z along the camera's axis; NaN where there is no reading.
        camera: its lens.
        color: ``(H, W, 3)`` uint8 display RGB, or None.
        world_from_camera: ``(4, 4)`` float64 rigid pose in OpenCV's axes; by default the world is the camera's.
        source: what messages call the frame.

    Raises:
        ValueError: an array has the wrong shape or type, or the lens is of another size than the depth map.
    """

    depth: Float64
    camera: DepthCamera
    color: NDArray[np.uint8] | None = None
    world_from_camera: Float64 = field(default_factory=lambda: np.eye(4))
    source: str = "depth map"

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.depth.shape != size or self.depth.dtype != np.float64:
            raise ValueError(f"depth: {self.depth.dtype} of shape {self.depth.shape}; expected float64 of {size}")
        if self.color is not None and (self.color.shape != (*size, 3) or self.color.dtype != np.uint8):
            raise ValueError(f"color: {self.color.dtype} of shape {self.color.shape}; expected uint8 of {(*size, 3)}")
        self.view  # noqa: B018 (a pose that is not rigid is refused there)

    @property
    def view(self) -> Camera:
        """The camera where it stood."""
        return self.camera.at(self.world_from_camera)

    @property
    def eye(self) -> Float64:
        """``(3,)`` where the camera stood, in world coordinates."""
        return self.world_from_camera[:3, 3]


def read_frame(
    depth: str | Path,
    camera: DepthCamera,
    *,
    color: str | Path | None = None,
    world_from_camera: Float64 | None = None,
    scale: float | None = None,
    inverse: bool = False,
    resize_color: bool = False,
) -> RgbdFrame:
    """Read one depth map and its picture.

    Args:
        depth: PNG, TIFF, NPY or NPZ file; see `read_depth`.
        camera: the lens; its size must be that of the map.
        color: a picture from the same place, pixel on pixel.
        world_from_camera: ``(4, 4)`` rigid pose; None is the camera's own coordinates.
        scale: numbers in the file per unit; None is the camera's ``depth_scale`` for integer images.
        inverse: whether the file holds inverse depths.
        resize_color: whether to scale a picture of another size.

    Raises:
        InputError: a file cannot be read, or the sizes do not fit.
    """
    values = read_depth(depth, scale=scale, integer_scale=camera.depth_scale, inverse=inverse)
    height, width = values.shape
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{depth}: {width} × {height} pixels, but the intrinsics are for {camera.width} × {camera.height}; "
            "give those of the depth map (scale fx, fy, cx, cy with its size)"
        )
    picture = None
    if color is not None:
        picture = fit_color(read_color(color), (width, height), source=str(color), resize=resize_color)
    pose = np.eye(4) if world_from_camera is None else world_from_camera
    return RgbdFrame(values, camera, picture, pose, str(depth))


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


@reader
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
    with readable(path):
        data = path.read_bytes()
    try:
        lines = [line.split() for line in data.decode("utf-8").splitlines() if line.strip()]
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
        raise InputError(f"{path}: {str(error)[:80]}; expected five lines per frame, as Open3D writes them") from error
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
