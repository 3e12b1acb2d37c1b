"""What developers measure, beside peers in the same run: what things cost, and how near they come. Not in the wheel."""
