"""``fit``: from oriented point clouds to a multiscale SDF."""
