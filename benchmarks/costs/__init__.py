"""Times and counts: gradients, kernels, meshes and pictures."""
