"""Meshes with colours: files → triangles, textures, and coloured points on them."""
