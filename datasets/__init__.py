"""Files and sensors → tensors: point clouds, synthetic ones whose exact surface is known, and cameras."""

from ..neural_fields.meshing.color_space import linear_to_srgb, srgb_to_linear
from .cameras import Camera, look_at, orbit, turntable
from .clouds.cleaning.prepare import CleaningReport, OrientedCloud, prepare_cloud
from .clouds.point_cloud import PointCloud, spacing_of, thin
from .clouds.readers.ply import write_cloud_ply
from .clouds.readers.reading import read_cloud
from .depth.camera import DepthCamera, read_intrinsics
from .depth.cloud import DepthReport, DepthSettings, frame_cloud, fuse_frames
from .depth.frame import RgbdFrame, read_frame, read_poses
from .depth.images import read_color, read_depth
from .files import is_depth_file
from .synthetic.samples import add_noise, add_outliers, sample_sphere, sample_surface, sample_torus
from .synthetic.scanner import STATUE_PLACEMENT, ScanFaults, SimulatedScan, scan_with_truth, simulate_scan, statue_scan
from .synthetic.scenes import SCENES, Scene, render_scene, scene_mesh
from .synthetic.statue import Statue
from .textured.reading import TexturedMesh, colors_at, read_textured, sample_textured
from .views.images import PosedImage, PosedImages, read_cameras, read_posed_images
from .views.region import region_from_cameras, region_from_masks, region_from_points
from .views.writing import write_colmap, write_neus, write_transforms

__all__ = [
    "SCENES", "STATUE_PLACEMENT", "Camera", "CleaningReport", "DepthCamera", "DepthReport", "DepthSettings",
    "OrientedCloud", "PointCloud", "PosedImage", "PosedImages", "RgbdFrame", "ScanFaults", "Scene", "SimulatedScan",
    "Statue", "TexturedMesh", "add_noise", "add_outliers", "colors_at", "frame_cloud",
    "fuse_frames", "is_depth_file", "linear_to_srgb", "look_at", "orbit", "prepare_cloud", "read_cameras",
    "read_cloud", "read_color", "read_depth", "read_frame", "read_intrinsics", "read_posed_images", "read_poses",
    "read_textured", "region_from_cameras", "region_from_masks", "region_from_points",
    "render_scene", "sample_sphere", "sample_surface", "sample_textured", "sample_torus",
    "scan_with_truth", "scene_mesh", "simulate_scan", "spacing_of", "srgb_to_linear", "statue_scan", "thin",
    "turntable", "write_cloud_ply", "write_colmap", "write_neus", "write_transforms",
]  # fmt: skip
