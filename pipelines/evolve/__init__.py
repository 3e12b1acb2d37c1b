"""``evolve`` and ``animate``: surfaces that move."""
