"""Point clouds: files → oriented points in the unit sphere, cleaned of strays and noise."""

from .ply import write_cloud_ply
from .point_cloud import PointCloud, spacing_of, thin
from .prepare import CleaningReport, OrientedCloud, prepare_cloud
from .reading import read_cloud

__all__ = [
    "CleaningReport",
    "OrientedCloud",
    "PointCloud",
    "prepare_cloud",
    "read_cloud",
    "spacing_of",
    "thin",
    "write_cloud_ply",
]
