"""``render`` and ``slice``: pictures of fields, meshes and clouds."""
