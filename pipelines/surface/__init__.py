"""Triangle surfaces: reading them, measuring them against a reference, and trimming them."""

from .measure import Metrics, evaluate_files, evaluate_surfaces
from .surface import Surface, from_mesh, read_surface

__all__ = ["Metrics", "Surface", "evaluate_files", "evaluate_surfaces", "from_mesh", "read_surface"]
