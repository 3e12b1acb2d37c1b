"""Files of points → ``PointCloud``, whole or in pieces."""
