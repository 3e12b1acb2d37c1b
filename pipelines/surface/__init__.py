"""Triangle surfaces: reading, measuring and trimming them."""
