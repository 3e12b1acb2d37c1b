"""``bench …``: what things cost and how near they come, beside peers in the same run."""
