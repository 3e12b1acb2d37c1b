"""Files and sensors → tensors: point clouds and exact synthetic scenes."""

from .ply import write_cloud_ply
from .point_cloud import PointCloud
from .prepare import CleaningReport, OrientedCloud, prepare_cloud
from .reading import read_cloud

__all__ = [
    "CleaningReport",
    "OrientedCloud",
    "PointCloud",
    "prepare_cloud",
    "read_cloud",
    "write_cloud_ply",
]
