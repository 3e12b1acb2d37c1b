"""Outliers, noise and normals of point clouds."""
