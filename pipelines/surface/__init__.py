"""Triangle surfaces: reading them, measuring them against a reference, and trimming them."""

from .measure import Metrics, evaluate_files, evaluate_surfaces
from .surface import read_surface

__all__ = ["Metrics", "evaluate_files", "evaluate_surfaces", "read_surface"]
