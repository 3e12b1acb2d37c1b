"""``mesh``: from a fitted field to mesh files, with colours and baked textures."""

from .extract import Exported, MeshOptions, export_run, mesh_run
from .files import write_mesh
from .scene import Scene, SceneOptions, scene_of_run

__all__ = [
    "Exported",
    "MeshOptions",
    "Scene",
    "SceneOptions",
    "export_run",
    "mesh_run",
    "scene_of_run",
    "write_mesh",
]
