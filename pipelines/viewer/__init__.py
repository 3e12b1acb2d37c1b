"""``view``: a field in the browser."""
