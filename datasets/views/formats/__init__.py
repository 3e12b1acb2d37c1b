"""Files of cameras, sparse points and depth maps that belong to photographs."""
