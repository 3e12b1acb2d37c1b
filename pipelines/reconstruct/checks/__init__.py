"""Whether posed photographs can be right."""
