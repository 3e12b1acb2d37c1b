"""``RgbdFrame``: a depth map with its lens, colours and pose, each from its file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...neural_fields import InputError
from ...neural_fields.backend.files import files_in
from ..cameras import OPENGL, Camera, Float64, rigid_pose
from ..files import decoded, read_json, readable
from ..views.images import read_shots
from .camera import DepthCamera, read_intrinsics
from .images import fit_color, read_color, read_depth

PosedFrame = tuple[str | None, Float64, DepthCamera | None]
"""Name of the frame's image, if the file has names; its world_from_camera (4, 4), NaN for a frame whose pose was lost;
its lens, if the file has one."""


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """A depth map, its lens, its picture and its pose.

    Attributes:
        depth: ``(H, W)`` float64, z along the camera's axis; NaN without reading.
        camera: its lens.
        color: ``(H, W, 3)`` uint8 display RGB, or None.
        world_from_camera: ``(4, 4)`` float64 rigid pose in OpenCV's axes; by default the identity.
        source: name in messages.

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
        """The camera with its pose."""
        return self.camera.at(self.world_from_camera)

    @property
    def eye(self) -> Float64:
        """``(3,)`` position of the camera, in world coordinates."""
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
        camera: the lens, of the size of the map.
        color: a picture that is registered to the map.
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

    - text: Open3D's ``trajectory.log``; TUM's ``timestamp tx ty tz qx qy qz qw`` (``qw`` first, if a comment says so);
      KITTI's rows of 3 × 4 matrices.
    - a folder with a 4 × 4 (or 3 × 4) matrix for each frame (ScanNet, 7-Scenes), or with Polycam's cameras in JSON.
    - JSON: ``transforms.json``, which also brings names and lenses; Open3D's camera trajectories and parameters;
      Record3D's ``metadata``.

    A frame without a single finite number, as ScanNet and trackers write it where they lost the camera, has a pose of
    NaN.

    Raises:
        InputError: the file is none of these, or a pose in it is not rigid.
    """
    path = Path(path)
    with readable(path):
        if not path.is_dir():
            return _file_poses(path)
        files = files_in(path, (".txt", ".json"))
        if not files:
            raise InputError(f"{path}: {_EXPECTED}")
        return [(file.stem, pose, lens) for file in files for _, pose, lens in _file_poses(file)[:1]]


_EXPECTED = "no poses in it; expected a trajectory.log, TUM's poses, a transforms.json, or a folder of 4 × 4 matrices"


def _file_poses(path: Path) -> list[PosedFrame]:
    if path.suffix.lower() == ".json" or path.name == "metadata":
        return _json_poses(path)
    text = decoded(path.read_bytes())
    w_first = re.search(r"\bq\w*w\b.*\bq\w*x\b", text, re.IGNORECASE) is not None  # in a comment on the columns
    text = re.sub(r"#.*", "", text).replace(",", " ")
    lines = [line.split() for line in text.splitlines() if line.strip()]
    try:
        rows = [[float(word) for word in words] for words in lines]
    except ValueError as error:
        raise InputError(f"{path}: {_EXPECTED} ({str(error)[:60]})") from error
    widths = [len(row) for row in rows]
    names: Sequence[str | None] = [None] * len(rows)
    if rows and widths == [3, 4, 4, 4, 4] * (len(rows) // 5):
        matrices = [rows[at + 1 : at + 5] for at in range(0, len(rows), 5)]
    elif widths == [4] * 4 or widths == [4] * 3:
        matrices = [rows]
    elif rows and set(widths) == {8}:
        matrices = [_from_quaternion(row[1:4], np.roll(row[4:], -1 if w_first else 0)) for row in rows]
        names = [words[0] for words in lines]
    elif rows and set(widths) in ({12}, {16}):
        matrices = [np.reshape(row, (-1, 4)) for row in rows]
    else:
        raise InputError(f"{path}: {len(rows)} lines of {sorted(set(widths))} numbers; {_EXPECTED}")
    poses = [rigid_pose(pose, f"{path}: frame {index}") for index, pose in enumerate(matrices)]
    return [(name, pose, None) for name, pose in zip(names, poses, strict=False)]


def _json_poses(path: Path) -> list[PosedFrame]:
    content = read_json(path)
    content = content if isinstance(content, dict) else {}
    if "frames" in content:
        return [
            (shot.name, np.full((4, 4), np.nan), None)
            if (camera := shot.placed) is None
            else (shot.name, camera.world_from_camera.numpy(), DepthCamera.from_camera(camera))
            for shot in read_shots(path)
        ]
    found: list[PosedFrame] = []
    if "t_00" in content:  # Polycam
        rows = [[content.get(f"t_{i}{j}") for j in range(4)] for i in range(3)]
        found.append((path.stem, rigid_pose(rows, f"{path}: t_00") @ OPENGL, read_intrinsics(path)))
    elif isinstance(content.get("poses"), list):  # Record3D; its lens is that of the pictures
        for index, pose in enumerate(content["poses"]):
            named = f"{path}: poses[{index}]"
            numbers = pose if isinstance(pose, list) and len(pose) == 7 else []
            if not all(isinstance(x, int | float) for x in numbers) or not numbers:
                raise InputError(f"{named}: expected qx, qy, qz, qw, tx, ty, tz")
            found.append((f"{index}", rigid_pose(_from_quaternion(numbers[4:], numbers[:4]), named) @ OPENGL, None))
    else:  # Open3D: from world to camera, by columns
        for index, item in enumerate(content.get("parameters", [content])):
            extrinsic = item.get("extrinsic") if isinstance(item, dict) else None
            if not isinstance(extrinsic, list) or len(extrinsic) != 16:
                raise InputError(f"{path}: {_EXPECTED}")
            pose = rigid_pose(np.reshape(extrinsic, (4, 4)).T, f"{path}: parameters[{index}].extrinsic")
            found.append((None, np.asarray(np.linalg.inv(pose), np.float64), None))
    return found


def _from_quaternion(place: Sequence[float], quaternion: ArrayLike) -> Float64:
    pose = np.eye(4)
    pose[:3, 3] = place
    if np.isfinite(quaternion).all() and np.any(quaternion):
        pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()  # x, y, z, w, of any length
    else:
        pose[:3, :3] = np.nan
    return pose
