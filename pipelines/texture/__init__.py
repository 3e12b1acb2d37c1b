"""``texture``: colours around a fitted surface."""
