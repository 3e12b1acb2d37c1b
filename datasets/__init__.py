"""Files and sensors → tensors: point clouds, synthetic ones whose exact surface is known, and cameras."""

from .cameras import Camera, look_at, orbit, turntable
from .ply import write_cloud_ply
from .point_cloud import PointCloud
from .posed_cameras import read_cameras
from .prepare import CleaningReport, OrientedCloud, prepare_cloud
from .reading import read_cloud
from .scanner import STATUE_PLACEMENT, simulate_scan, statue_scan
from .statue import Statue
from .synthetic import add_noise, add_outliers, sample_sphere, sample_surface, sample_torus

__all__ = [
    "STATUE_PLACEMENT",
    "Camera",
    "CleaningReport",
    "OrientedCloud",
    "PointCloud",
    "Statue",
    "add_noise",
    "add_outliers",
    "look_at",
    "orbit",
    "prepare_cloud",
    "read_cameras",
    "read_cloud",
    "sample_sphere",
    "sample_surface",
    "sample_torus",
    "simulate_scan",
    "statue_scan",
    "turntable",
    "write_cloud_ply",
]
