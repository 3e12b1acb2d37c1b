"""``mesh``: from a fitted field to mesh files, with colours and baked textures."""
