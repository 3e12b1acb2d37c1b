"""Fits of clouds, scans and textures against the shapes that they were made from."""
