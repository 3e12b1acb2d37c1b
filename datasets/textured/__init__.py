"""Meshes with colours: files → triangles, textures, and coloured points on them."""

from .mesh import TexturedMesh, colors_at
from .reading import read_textured, sample_textured

__all__ = ["TexturedMesh", "colors_at", "read_textured", "sample_textured"]
