"""Files and sensors → tensors: point clouds, and synthetic ones whose exact surface is known."""

from .ply import write_cloud_ply
from .point_cloud import PointCloud
from .prepare import CleaningReport, OrientedCloud, prepare_cloud
from .reading import read_cloud
from .scanner import STATUE_PLACEMENT, simulate_scan, statue_scan
from .statue import Statue
from .synthetic import add_noise, add_outliers, sample_sphere, sample_surface, sample_torus

__all__ = [
    "STATUE_PLACEMENT",
    "CleaningReport",
    "OrientedCloud",
    "PointCloud",
    "Statue",
    "add_noise",
    "add_outliers",
    "prepare_cloud",
    "read_cloud",
    "sample_sphere",
    "sample_surface",
    "sample_torus",
    "simulate_scan",
    "statue_scan",
    "write_cloud_ply",
]
