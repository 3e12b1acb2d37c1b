"""Times and counts: gradients, kernels, meshes, pictures, and the time left."""
