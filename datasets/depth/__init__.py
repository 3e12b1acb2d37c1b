"""Depth maps: files of depth sensors → oriented, coloured clouds."""

from .camera import DepthCamera, read_intrinsics
from .cloud import DepthReport, DepthSettings, frame_cloud, fuse_frames
from .frame import RgbdFrame, read_frame, read_poses, read_trajectory
from .images import is_depth_file, read_color, read_depth

__all__ = [
    "DepthCamera",
    "DepthReport",
    "DepthSettings",
    "RgbdFrame",
    "frame_cloud",
    "fuse_frames",
    "is_depth_file",
    "read_color",
    "read_depth",
    "read_frame",
    "read_intrinsics",
    "read_poses",
    "read_trajectory",
]
