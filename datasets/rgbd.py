"""``RgbdFrame``: a depth map, its lens, its colours and where it was seen from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..neural_fields import InputError
from .depth_camera import DepthCamera
from .depth_images import fit_color, read_color, read_depth

__all__ = ["RgbdFrame", "read_frame"]

Float64 = NDArray[np.float64]


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
        pose = self.world_from_camera
        if pose.shape != (4, 4) or not np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-6):
            raise ValueError(f"world_from_camera: {pose.tolist()}; expected a rigid (4, 4) pose")

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
