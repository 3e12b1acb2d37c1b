"""``mesh``: from a fitted field to mesh files, with colours and baked textures."""

from .extract import MeshOptions, mesh_run
from .files import write_mesh

__all__ = ["MeshOptions", "mesh_run", "write_mesh"]
