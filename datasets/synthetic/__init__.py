"""Shapes known in closed form: clouds, simulated scans and posed images with exact truth."""

from .samples import add_noise, add_outliers, sample_sphere, sample_surface, sample_torus
from .scanner import STATUE_PLACEMENT, simulate_scan, statue_scan
from .scenes import SCENES, Scene, render_scene, sample_scene, scene_mesh
from .statue import Statue

__all__ = [
    "SCENES",
    "STATUE_PLACEMENT",
    "Scene",
    "Statue",
    "add_noise",
    "add_outliers",
    "render_scene",
    "sample_scene",
    "sample_sphere",
    "sample_surface",
    "sample_torus",
    "scene_mesh",
    "simulate_scan",
    "statue_scan",
]
