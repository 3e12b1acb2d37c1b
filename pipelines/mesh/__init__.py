"""``mesh``: from a fitted field to mesh files, with colours and baked textures."""

from .extract import Exported, MeshOptions, export_run, mesh_run
from .files import write_mesh

__all__ = ["Exported", "MeshOptions", "export_run", "mesh_run", "write_mesh"]
