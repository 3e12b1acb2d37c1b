"""Posed photographs: files → pictures, the cameras that took them, and where the object is."""

from .images import PosedImage, PosedImages, read_posed_images
from .reading import read_cameras
from .region import region_from_cameras, region_from_masks, region_from_points
from .writing import write_colmap, write_neus, write_transforms

__all__ = [
    "PosedImage",
    "PosedImages",
    "read_cameras",
    "read_posed_images",
    "region_from_cameras",
    "region_from_masks",
    "region_from_points",
    "write_colmap",
    "write_neus",
    "write_transforms",
]
