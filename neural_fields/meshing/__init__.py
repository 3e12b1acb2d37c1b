"""Marching cubes of fields, meshes, and the files that hold them."""
